"""Quantile regression with two quantiles, worked out by hand."""

import pytest
import torch
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.losses import QuantileDQN
from nfv_torchrl.losses.quantile import quantile_huber

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

BIG = [100.0, 100.0]
# State 0: action 1 is taken. State 1: action 2 has the higher mean of the valid ones, action 0 the higher quantile.
ONLINE = [[[0.0, 0.0], [1.0, 3.0], BIG, BIG], [[5.0, 1.0], BIG, [0.0, 2.0], BIG]]
TARGET = [[[0.0, 0.0]] * 4, [[-4.0, 5.0], BIG, [1.0, 2.0], BIG]]
STEP = {"action": 1, "mask": [1, 1, 0, 0], "reward": 1.0, "next_mask": [1, 0, 1, 0]}


def expected(goal) -> float:
    """theta = (1, 3) at levels 1/4 and 3/4; Huber with kappa 1, mean over the samples, sum over the quantiles."""
    total = 0.0
    for level, theta in ((0.25, 1.0), (0.75, 3.0)):
        for sample in goal:
            u = sample - theta
            huber = 0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5
            total += abs(level - (u < 0)) * huber / len(goal)
    return total


@pytest.mark.parametrize(
    ("double", "done", "goal"),
    [
        (False, False, (1 + 0.5 * 1, 1 + 0.5 * 2)),  # action 2, mean 1.5 against 0.5
        (True, False, (1 + 0.5 * -4, 1 + 0.5 * 5)),  # the online network prefers action 0, mean 3 against 1
        (False, True, (1.0, 1.0)),
    ],
)
def test_loss(double, done, goal):
    loss = QuantileDQN(table_network(ONLINE), SIZES, quantiles=2, gamma=0.5, double=double)
    set_target(loss, "value_network", TARGET)
    values = loss(transition(**STEP, done=done))
    assert values["loss"].item() == pytest.approx(expected(goal))
    assert values["quantile_spread"].item() == 2


def test_the_choice_is_by_the_mean_of_valid_actions():
    loss = QuantileDQN(table_network(ONLINE), SIZES, quantiles=2)
    after = transition(**STEP, done=False)["next"]
    acted = loss.actor(after)
    assert acted["action"].item() == 0 and acted["chosen_action_value"].item() == 3


def test_several_rows_keep_apart():
    loss = QuantileDQN(table_network(ONLINE), SIZES, quantiles=2, gamma=0.5)
    set_target(loss, "value_network", TARGET)
    both = torch.cat([transition(**STEP, done=False), transition(**STEP, done=True)])
    assert loss(both)["loss"].item() == pytest.approx((expected((1.5, 2.0)) + expected((1.0, 1.0))) / 2)


def test_quantiles_of_a_known_distribution_are_found():
    torch.manual_seed(0)
    theta = torch.zeros(1, 4, requires_grad=True)
    levels = (2 * torch.arange(4) + 1) / 8
    optimizer = torch.optim.Adam([theta], lr=0.02)
    for _ in range(600):
        optimizer.zero_grad()
        quantile_huber(theta, torch.rand(1, 256), levels, 0.01).sum().backward()
        optimizer.step()
    assert theta.detach()[0].tolist() == pytest.approx([0.125, 0.375, 0.625, 0.875], abs=0.05)
