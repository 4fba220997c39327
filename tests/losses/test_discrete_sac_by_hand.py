"""Soft actor-critic with three of four actions in play, worked out by hand."""

import math

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.losses import DiscreteSAC

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

JUNK = 1e4
# Policy: in state 0 actions 0 and 1 with 1/4 and 3/4; in state 1 actions 0 and 2 with 1/2 each.
POLICY = [[0.0, math.log(3), JUNK, JUNK], [1.0, JUNK, 1.0, JUNK]]
FIRST = [[1.0, 2.0, JUNK, JUNK], [0.0] * 4]
SECOND = [[3.0, 1.5, JUNK, JUNK], [0.0] * 4]
FIRST_TARGET = [[0.0] * 4, [0.4, JUNK, 0.8, JUNK]]
SECOND_TARGET = [[0.0] * 4, [0.6, JUNK, 0.2, JUNK]]
STEP = {"action": 1, "mask": [1, 1, 0, 0], "reward": 0.5, "next_mask": [1, 0, 1, 0]}
ALPHA = 0.5


def make_loss() -> DiscreteSAC:
    loss = DiscreteSAC(table_network(POLICY, FIRST, SECOND), SIZES, gamma=0.9, alpha=ALPHA, entropy_share=0.5)
    set_target(loss, "value_network", FIRST_TARGET, SECOND_TARGET)
    return loss


@pytest.mark.parametrize("done", [False, True])
def test_losses(done):
    values = make_loss()(transition(**STEP, done=done))
    # V(s') = 1/2 (min(0.4, 0.6) + min(0.8, 0.2)) + alpha log 2
    soft = 0.5 * (0.4 + 0.2) + ALPHA * math.log(2)
    goal = 0.5 + (0 if done else 0.9 * soft)
    assert values["loss_qvalue"].item() == pytest.approx((2 - goal) ** 2 + (1.5 - goal) ** 2)
    # sum of pi (alpha log pi - min Q): the lower values are 1 and 1.5
    regret = 0.25 * (ALPHA * math.log(0.25) - 1) + 0.75 * (ALPHA * math.log(0.75) - 1.5)
    assert values["loss_actor"].item() == pytest.approx(regret)
    entropy = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
    assert values["entropy"].item() == pytest.approx(entropy)
    assert values["loss_alpha"].item() == pytest.approx(math.log(ALPHA) * (entropy - 0.5 * math.log(2)))
    assert values["alpha"].item() == pytest.approx(ALPHA)


def test_each_loss_moves_its_own_parameters_and_valid_actions_only():
    loss = make_loss()
    total = sum(value for key, value in loss(transition(**STEP, done=False)).items() if key.startswith("loss"))
    total.backward()
    policy = loss.actor_network_params["table"].grad
    assert torch.isfinite(policy).all()
    assert (policy[0, :2] != 0).all() and (policy[0, 2:] == 0).all() and (policy[1] == 0).all()
    for critic in ("first", "second"):
        gradient = loss.value_network_params[critic, "table"].grad
        assert gradient[0, 1] != 0
        assert gradient.count_nonzero() == 1
    assert loss.log_alpha.grad != 0


def test_a_state_with_one_valid_action_is_no_hazard():
    step = STEP | {"mask": [0, 1, 0, 0], "next_mask": [0, 0, 0, 1]}
    loss = make_loss()
    values = loss(transition(**step, done=False))
    assert all(torch.isfinite(value) for value in values.values())
    assert values["entropy"].item() == 0
    sum(value for key, value in values.items() if key.startswith("loss")).backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters() if p.grad is not None)


def test_the_actor_draws_valid_actions_with_their_probabilities_and_evaluates_greedily():
    torch.manual_seed(0)
    loss = make_loss()
    data = transition(**STEP, done=False).expand(4000).contiguous()
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        drawn = loss.actor(data.clone())["action"]
    shares = drawn.bincount(minlength=4) / len(drawn)
    assert shares.tolist() == pytest.approx([0.25, 0.75, 0, 0], abs=0.03)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        assert (loss.actor(data.clone())["action"] == 1).all()


def test_the_temperature_can_be_kept():
    loss = DiscreteSAC(table_network(POLICY, FIRST, SECOND), SIZES, learn_alpha=False)
    assert not loss.log_alpha.requires_grad
    with pytest.raises(ValueError, match=r"loss\.alpha is 0"):
        DiscreteSAC(table_network(POLICY, FIRST, SECOND), SIZES, alpha=0)
