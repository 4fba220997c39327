"""REINFORCE, A2C and PPO, ours and TorchRL's by itself, with two of four actions valid, worked out by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import A2CLoss, ClipPPOLoss, ReinforceLoss
from two_states import SIZES, table_network

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import request_loss
from nfv_torchrl.losses.a2c import A2C
from nfv_torchrl.losses.policy_gradient import masked_actor
from nfv_torchrl.losses.ppo import PPO
from nfv_torchrl.losses.reinforce import Reinforce
from nfv_torchrl.networks.layers import NoisyLinear

JUNK = 1e4
# In state 0 actions 0 and 1 with 1/4 and 3/4, in state 1 action 2 alone.
LOGITS = [[0.0, math.log(3), JUNK, JUNK], [JUNK, JUNK, 0.3, JUNK]]
MASKS = torch.tensor([[True, True, False, False], [False, False, True, False]])
# V is the mean over valid actions: 2 in state 0, 5 in state 1.
CRITIC = [[1.0, 3.0, JUNK, JUNK], [JUNK, JUNK, 5.0, JUNK]]
ENTROPY = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
GAMMA, LMBDA = 0.9, 0.5


def batch(states, actions, rewards, request_done, done=None) -> TensorDict:
    """[1, T] with ``states`` of T + 1 steps."""
    seen = torch.tensor([states], dtype=torch.float32).unsqueeze(-1)
    masks = MASKS[torch.tensor([states])]
    done = done or [False] * len(actions)
    return TensorDict(
        {
            "observation": seen[:, :-1],
            "action_mask": masks[:, :-1],
            "action": torch.tensor([actions]),
            "action_log_prob": torch.zeros(1, len(actions)),
            "next": TensorDict(
                {
                    "observation": seen[:, 1:],
                    "action_mask": masks[:, 1:],
                    "reward": torch.tensor([rewards]).unsqueeze(-1),
                    "request_done": torch.tensor([request_done]).unsqueeze(-1),
                    "done": torch.tensor([done]).unsqueeze(-1),
                },
                batch_size=[1, len(actions)],
            ),
        },
        batch_size=[1, len(actions)],
    )


def make(kind, **settings):
    """``kind`` without a discount where none is given, and with squared errors, as ours have it."""
    if kind.__module__.startswith("torchrl."):
        settings = {"gamma": 1.0, "lmbda": 1.0, "loss_critic_type": "l2", **settings}
    return request_loss(kind)(table_network(LOGITS, CRITIC), SIZES, **settings)


def test_sampling_and_choosing_keep_to_the_mask():
    actor = masked_actor(table_network(LOGITS)(SIZES), 4)
    seen = TensorDict({"observation": torch.zeros(4000, 1), "action_mask": MASKS[0].expand(4000, 4)}, [4000])
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        sampled = actor(seen.clone())
    shares = torch.bincount(sampled["action"], minlength=4) / 4000
    assert shares.tolist() == pytest.approx([0.25, 0.75, 0, 0], abs=0.03)
    assert sampled["action_log_prob"].exp().unique().tolist() == pytest.approx([0.25, 0.75])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        assert (actor(seen.clone())["action"] == 1).all()


@pytest.mark.parametrize("kind", [A2C, ClipPPOLoss])
def test_advantages_end_with_the_request(kind):
    loss = make(kind, gamma=GAMMA, lmbda=LMBDA)
    data = batch([0, 0, 1, 0], [0, 1, 2], [0.5, 1.0, -1.0], [False, True, False])
    rows = loss.prepare(data)
    # delta: 0.5 + 0.9 * 2 - 2, then 1 - 2 at the request's end, then -1 + 0.9 * 2 - 5
    deltas = [0.3, -1.0, -4.2]
    advantages = [deltas[0] + GAMMA * LMBDA * deltas[1], deltas[1], deltas[2]]
    assert rows["advantage"].flatten().tolist() == pytest.approx(advantages)
    values = [2.0, 2.0, 5.0]
    assert rows["value_target"].flatten().tolist() == pytest.approx(
        [a + v for a, v in zip(advantages, values, strict=True)]
    )


@pytest.mark.parametrize("kind", [A2C, ReinforceLoss])
def test_looking_across_requests_ends_with_the_horizon(kind):
    loss = make(kind, gamma=GAMMA, lmbda=1.0, stop_at="done")
    data = batch([0, 0, 0], [0, 1], [0.0, 1.0], [True, True], done=[False, True])
    deltas = [0.9 * 2 - 2, 1 - 2]
    assert loss.prepare(data)["advantage"].flatten().tolist() == pytest.approx([deltas[0] + GAMMA * deltas[1], -1.0])


def test_an_horizon_without_requests_ends_looking_ahead():
    loss = make(A2C, gamma=GAMMA, lmbda=LMBDA)
    data = batch([1, 0], [2], [0.0], [False], done=[True])
    assert loss.prepare(data)["advantage"].item() == pytest.approx(-5.0)


@pytest.mark.parametrize("kind", [Reinforce, ReinforceLoss])
def test_reinforce(kind):
    loss = make(kind)
    values = loss(loss.prepare(batch([0, 1], [1], [1.0], [True])))
    assert values["loss_actor"].item() == pytest.approx(-math.log(0.75) * (1 - 2))
    assert values["loss_value"].item() == pytest.approx((2 - 1) ** 2)


@pytest.mark.parametrize("kind", [A2C, A2CLoss])
def test_a2c(kind):
    loss = make(kind, entropy_coeff=0.1, critic_coeff=0.5)
    values = loss(loss.prepare(batch([0, 1], [1], [1.0], [True])))
    assert values["loss_objective"].item() == pytest.approx(-math.log(0.75) * (1 - 2))
    assert values["loss_critic"].item() == pytest.approx(0.5 * (2 - 1) ** 2)
    assert values["entropy"].item() == pytest.approx(ENTROPY)
    assert values["loss_entropy"].item() == pytest.approx(-0.1 * ENTROPY)


@pytest.mark.parametrize("kind", [PPO, ClipPPOLoss])
@pytest.mark.parametrize(("before", "clipped"), [(0.7, False), (0.5, True)])
def test_ppo_clips(before, clipped, kind):
    loss = make(kind, clip_epsilon=0.2, entropy_coeff=0.1, critic_coeff=0.5, normalize_advantage=False)
    data = batch([0, 1], [1], [5.0], [True])
    data["action_log_prob"] = torch.full((1, 1), math.log(before))
    values = loss(loss.prepare(data))
    ratio = 0.75 / before
    assert values["loss_objective"].item() == pytest.approx(-min(ratio, 1.2) * (5 - 2), rel=1e-5)
    assert values["clip_fraction"].item() == clipped
    assert values["loss_entropy"].item() == pytest.approx(-0.1 * ENTROPY)


@pytest.mark.parametrize("kind", [Reinforce, A2C, PPO, ReinforceLoss, A2CLoss, ClipPPOLoss])
def test_gradients_are_finite_and_move_valid_actions_only(kind):
    loss = make(kind)
    rows = loss.prepare(batch([0, 1, 0], [1, 2], [1.0, 0.5], [False, True]))
    total = sum(value for key, value in loss(rows).items() if key.startswith("loss"))
    total.backward()
    actor, critic = (next(iter(part.parameters())).grad for part in (loss.actor, loss.critic))
    for gradient in (actor, critic):
        assert torch.isfinite(gradient).all()
        assert (gradient[~MASKS] == 0).all()
    assert (critic[MASKS] != 0).any() and (actor[0, :2] != 0).all()
    assert actor[1, 2] == 0  # one valid action: nothing to learn, and no NaN


def test_each_has_its_own_parameters():
    loss = make(PPO)
    names = {name for name, _ in loss.named_parameters()}
    assert len(names) == 2 and len(list(loss.parameters())) == 2


@pytest.mark.parametrize("layer", [NoisyLinear(1, 4), torch.nn.Dropout()])
def test_layers_that_draw_random_numbers_are_refused(layer):
    def network(sizes):
        made = table_network(LOGITS)(sizes)
        made.extra = layer
        return made

    for kind in (PPO, A2CLoss):
        with pytest.raises(ScenarioError, match=rf"^network: its layers {type(layer).__name__} .* set network=mlp$"):
            request_loss(kind)(network, SIZES)
