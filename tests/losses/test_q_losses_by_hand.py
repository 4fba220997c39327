"""DQN, double DQN, n-step and conservative Q-learning against numbers worked out on paper.

State 0: action 1 taken of the valid {0, 1}. State 1: actions {0, 2} are valid, 1 and 3 are not but have the highest
values.
"""

import math

import pytest
import torch
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.losses import CQL, DQN

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

ONLINE = [[0.5, 0.25, 7.0, 9.0], [0.1, 8.0, 0.3, 9.0]]
TARGET = [[0.0, 0.0, 0.0, 0.0], [0.6, 50.0, 0.2, 90.0]]
STEP = {"action": 1, "mask": [1, 1, 0, 0], "reward": 0.5, "next_mask": [1, 0, 1, 0]}


def value_of(loss, data) -> float:
    return loss(data)["loss"].item()


@pytest.mark.parametrize(
    ("double", "done", "goal"),
    [
        (False, False, 0.5 + 0.9 * 0.6),  # the target's highest valid value, at action 0
        (True, False, 0.5 + 0.9 * 0.2),  # the online network prefers action 2
        (False, True, 0.5),
        (True, True, 0.5),
    ],
)
def test_dqn(double, done, goal):
    loss = DQN(table_network(ONLINE), SIZES, gamma=0.9, double=double)
    set_target(loss, "value_network", TARGET)
    assert value_of(loss, transition(**STEP, done=done)) == pytest.approx((goal - 0.25) ** 2)


def test_dqn_looks_across_requests_when_asked_to():
    loss = DQN(table_network(ONLINE), SIZES, gamma=0.9, stop_at="done")
    set_target(loss, "value_network", TARGET)
    goal = 0.5 + 0.9 * 0.6
    assert value_of(loss, transition(**STEP, done=True)) == pytest.approx((goal - 0.25) ** 2)
    assert value_of(loss, transition(**STEP, done=True, end_of_horizon=True)) == pytest.approx(0.25**2)


def test_the_greedy_choice_is_a_valid_one():
    for loss in (DQN(table_network(ONLINE), SIZES), CQL(table_network(ONLINE), SIZES)):
        assert loss.actor(transition(**STEP, done=False))["action"].item() == 0


@pytest.mark.parametrize(("double", "goal"), [(False, 0.5 + 0.9 * 0.6), (True, 0.5 + 0.9 * 0.2)])
def test_cql(double, goal):
    loss = CQL(table_network(ONLINE), SIZES, alpha=2.0, gamma=0.9, double=double)
    set_target(loss, "value_network", TARGET)
    values = loss(transition(**STEP, done=False))
    assert values["loss_td"].item() == pytest.approx(0.5 * (goal - 0.25) ** 2)
    # Only the valid actions 0 and 1 of state 0 are in the sum.
    conservative = 2.0 * (math.log(math.exp(0.5) + math.exp(0.25)) - 0.25)
    assert values["loss_conservative"].item() == pytest.approx(conservative)
    assert values["agreement"].item() == 0  # the greedy one is action 0


def test_cql_teaches_nothing_about_invalid_actions():
    loss = CQL(table_network(ONLINE), SIZES)
    values = loss(transition(**STEP, done=False))
    (values["loss_td"] + values["loss_conservative"]).backward()
    gradient = loss.actor[0].module.table.grad
    assert (gradient[0, :2] != 0).all() and (gradient[0, 2:] == 0).all()
    assert (gradient[1] == 0).all()  # the next state's value is a target


def test_keys_can_be_renamed():
    loss = CQL(table_network(ONLINE), SIZES, gamma=0.9)
    loss.set_keys(reward="income")
    data = transition(**STEP, done=True)
    data.rename_key_(("next", "reward"), ("next", "income"))
    assert loss(data)["loss_td"].item() == pytest.approx(0.5 * 0.25**2)
    assert ("next", "income") in loss.in_keys
    assert torch.equal(loss.prepare(data)["next", "income"], data["next", "income"])
