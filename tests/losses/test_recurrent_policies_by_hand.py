"""Recurrent PPO and the recurrent deterministic policy gradient over three steps, worked out by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from two_states import SIZES

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import RDPG, RecurrentPPO
from nfv_torchrl.networks import MLPNetwork, QNetwork

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

JUNK = 1e4
ODDS = [0.0, math.log(3), JUNK, JUNK]
"""Log-odds of every state: actions 0 and 1 with 1/4 and 3/4 where they are valid."""
SCALE = [1.0, 3.0, 5.0, JUNK]
"""The second output is the memory after the step times this."""
MASK = [1, 1, 0, 0]


class SumNetwork(QNetwork):
    """Remembers the sum of the observations. Outputs: fixed log-odds, and the sum times a number for each action."""

    in_keys = ("observation", "memory")

    def __init__(self, sizes, outputs) -> None:
        super().__init__()
        assert outputs == 2
        self.odds, self.scale = nn.Parameter(torch.tensor(ODDS)), nn.Parameter(torch.tensor(SCALE))

    def forward(self, observation, memory):
        after = memory + observation
        return torch.stack((self.odds.expand(len(after), 4), after * self.scale), -1), after

    def unroll(self, observation, memory, restart):
        values = []
        for step, begins in zip(observation.unbind(1), restart.unbind(1), strict=True):
            value, memory = self(step, memory.masked_fill(begins.unsqueeze(-1), 0.0))
            values.append(value)
        return torch.stack(values, 1), memory


def collected(*, request_done=(False, False, False), done=(False, False, False)) -> TensorDict:
    """Three steps with observations 1, 2, 3 and 4 after them, from a memory of 10: sums 11, 13, 16, 20."""
    seen = torch.tensor([[[1.0], [2.0], [3.0], [4.0]]])
    masks = torch.tensor([[MASK] * 4], dtype=torch.bool)
    after = {
        "observation": seen[:, 1:],
        "action_mask": masks[:, 1:],
        "reward": torch.tensor([[[0.5], [0.25], [1.0]]]),
        "request_done": torch.tensor([request_done]).unsqueeze(-1),
        "done": torch.tensor([done]).unsqueeze(-1),
    }
    return TensorDict(
        {
            "observation": seen[:, :-1],
            "action_mask": masks[:, :-1],
            "memory": torch.tensor([[[10.0], [11.0], [13.0]]]),
            "action": torch.tensor([[0, 1, 1]]),
            "action_log_prob": torch.log(torch.tensor([[0.25, 0.5, 0.75]])),
            "next": TensorDict(after, batch_size=[1, 3]),
        },
        batch_size=[1, 3],
    )


def ppo(**settings):
    return RecurrentPPO(SumNetwork, SIZES, gamma=0.9, lmbda=0.5, normalize_advantage=False, **settings)


# V is the mean of 1 and 3 times the sum.
@pytest.mark.parametrize(
    ("ended", "deltas"),
    [
        ({}, [0.5 + 0.9 * 26 - 22, 0.25 + 0.9 * 32 - 26, 1 + 0.9 * 40 - 32]),
        ({"request_done": (False, True, False)}, [0.5 + 0.9 * 26 - 22, 0.25 - 26, 1 + 0.9 * 40 - 32]),
        # The memory ends with the horizon: 11, 13, 3, 7.
        ({"done": (False, True, False)}, [0.5 + 0.9 * 26 - 22, 0.25 - 26, 1 + 0.9 * 14 - 6]),
    ],
)
def test_advantages_along_a_sequence(ended, deltas):
    rows = ppo().prepare(collected(**ended))
    assert rows.shape == (1,) and rows["memory"].tolist() == [[10.0]]
    last = deltas[2]
    second = deltas[1] + (0 if ended else 0.45 * last)
    assert rows["advantage"].flatten().tolist() == pytest.approx([deltas[0] + 0.45 * second, second, last], rel=1e-4)


def test_recurrent_ppo():
    loss = ppo(clip_epsilon=0.2, entropy_coeff=0.1, critic_coeff=0.5)
    rows = loss.prepare(collected())
    rows["advantage"] = torch.tensor([[[1.0], [2.0], [-1.0]]])
    rows["value_target"] = torch.tensor([[[20.0], [26.0], [33.0]]])
    values = loss(rows)
    # Ratios 1, 1.5 (clipped to 1.2) and 1.
    assert values["loss_objective"].item() == pytest.approx(-(1 + 1.2 * 2 - 1) / 3, rel=1e-5)
    assert values["clip_fraction"].item() == pytest.approx(1 / 3)
    assert values["loss_critic"].item() == pytest.approx(0.5 * (4 + 0 + 1) / 3, rel=1e-5)
    entropy = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
    assert values["loss_entropy"].item() == pytest.approx(-0.1 * entropy, rel=1e-5)
    sum(value for key, value in values.items() if key.startswith("loss")).backward()
    gradients = [part.grad for part in loss.value_network_params.flatten_keys().values()]
    assert len(gradients) == 2
    for gradient in gradients:
        assert torch.isfinite(gradient).all() and (gradient[:2] != 0).all() and (gradient[2:] == 0).all()


def rdpg(**settings):
    loss = RDPG(SumNetwork, SIZES, gamma=0.9, **settings)
    loss.target_value_network_params["odds"].data.copy_(torch.tensor([1.0, 0.0, JUNK, JUNK]))
    loss.target_value_network_params["scale"].data.copy_(torch.tensor([2.0, 9.0, JUNK, JUNK]))
    return loss


@pytest.mark.parametrize(
    ("ended", "ahead"),
    [
        ({}, [26, 32, 40]),  # the target's policy takes action 0, though its critic thinks more of action 1
        ({"request_done": (False, True, False)}, [26, 0, 40]),
        ({"done": (False, True, False)}, [26, 0, 14]),
    ],
)
def test_the_critic_of_rdpg(ended, ahead):
    loss = rdpg()
    rows = loss.prepare(collected(**ended))
    values = loss(rows)
    sums = [11, 13, 3 if "done" in ended else 16]
    taken = [sums[0] * 1, sums[1] * 3, sums[2] * 3]
    goal = [reward + 0.9 * value for reward, value in zip((0.5, 0.25, 1.0), ahead, strict=True)]
    errors = [abs(a - b) for a, b in zip(goal, taken, strict=True)]
    assert values["loss_qvalue"].item() == pytest.approx(sum(e * e for e in errors) / 3, rel=1e-5)
    assert values["td_error"].item() == pytest.approx(sum(errors) / 3, rel=1e-5)
    assert rows["td_error"].item() == pytest.approx(0.9 * max(errors) + 0.1 * sum(errors) / 3, rel=1e-5)


def test_the_policy_of_rdpg_climbs_the_slope_of_the_softmax():
    loss = rdpg(decay=0.1, temperature=2.0, burn_in=2)
    rows = loss.prepare(collected())
    torch.manual_seed(5)
    values = loss(rows)
    torch.manual_seed(5)
    noise = (-torch.empty(1, 1, 4).exponential_().log())[0, 0, :2].tolist()
    noisy = [ODDS[0] + noise[0], ODDS[1] + noise[1]]
    worth = [16.0, 48.0]  # of the third step
    assert values["loss_actor"].item() == pytest.approx(
        0.1 * math.log(3) ** 2 / 2 - worth[noisy[1] > noisy[0]], rel=1e-5
    )
    values["loss_actor"].backward()
    gradient = loss.value_network_params["odds"].grad
    share = 1 / (1 + math.exp((noisy[0] - noisy[1]) / 2))  # of action 1 in the softmax
    slope = share * (1 - share) * (worth[1] - worth[0]) / 2
    assert gradient[1].item() == pytest.approx(0.1 * math.log(3) - slope, rel=1e-4)
    assert gradient[0].item() == pytest.approx(slope, rel=1e-4)
    assert gradient[2:].tolist() == [0, 0]
    assert loss.value_network_params["scale"].grad is None or not loss.value_network_params["scale"].grad.any()


@pytest.mark.parametrize("kind", [RDPG, RecurrentPPO])
def test_they_sample_while_they_explore_and_choose_otherwise(kind):
    actor = kind(SumNetwork, SIZES).actor
    seen = {"observation": torch.ones(4000, 1), "memory": torch.full((4000, 1), 2.0)}
    seen = TensorDict({**seen, "action_mask": torch.tensor(MASK, dtype=torch.bool).expand(4000, 4)}, [4000])
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        sampled = actor(seen.clone())
    assert (torch.bincount(sampled["action"], minlength=4) / 4000).tolist() == pytest.approx(
        [0.25, 0.75, 0, 0], abs=0.03
    )
    assert (sampled["next", "memory"] == 3).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        assert (actor(seen.clone())["action"] == 1).all()
    with pytest.raises(ScenarioError, match="network=gru"):
        kind(MLPNetwork, SIZES)
