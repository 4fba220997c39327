"""Munchausen Q-learning, implicit quantiles, Rainbow and the paper's Algorithm 2, worked out by hand."""

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import IQN, MunchausenDQN, PaperLiteral, Rainbow
from nfv_torchrl.losses.base import has_target
from nfv_torchrl.networks import ImplicitQuantileNetwork, MLPNetwork, QNetwork

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

BIG = 100.0
STEP = {"action": 1, "mask": [1, 1, 0, 0], "reward": 0.5, "next_mask": [1, 0, 1, 0]}
ONLINE = [[0.0, 3.0, BIG, BIG], [BIG] * 4]
# In state 0 the target's policy has probabilities 1/4 and 3/4 at temperature 1, in state 1 it has 1/3 and 2/3.
TARGET = [[0.0, math.log(3), BIG, BIG], [1.0, BIG, 1.0 + math.log(2), BIG]]


def munchausen(**settings):
    loss = MunchausenDQN(table_network(ONLINE), SIZES, gamma=0.9, **settings)
    set_target(loss, "value_network", TARGET)
    return loss


@pytest.mark.parametrize("done", [False, True])
@pytest.mark.parametrize(("clip", "bonus"), [(1.0, math.log(3 / 4)), (0.1, -0.1)])
def test_munchausen(done, clip, bonus):
    values = munchausen(alpha=0.5, temperature=1.0, clip=clip)(transition(**STEP, done=done))
    soft = 1 / 3 * (1.0 - math.log(1 / 3)) + 2 / 3 * (1.0 + math.log(2) - math.log(2 / 3))
    assert soft == pytest.approx(math.log(math.exp(1) * 3))  # the soft value is tau times the log of a sum
    goal = 0.5 + 0.5 * bonus + (0 if done else 0.9 * soft)
    assert values["loss"].item() == pytest.approx((goal - 3.0) ** 2, rel=1e-5)
    assert values["log_policy"].item() == pytest.approx(bonus)
    assert values["entropy"].item() == pytest.approx(-0.25 * math.log(0.25) - 0.75 * math.log(0.75))


def test_munchausen_adds_nothing_where_there_is_no_choice():
    step = {**STEP, "mask": [0, 1, 0, 0], "next_mask": [1, 0, 0, 0]}
    values = munchausen(alpha=0.9, temperature=0.01)(transition(**step, done=False))
    assert values["loss"].item() == pytest.approx((0.5 + 0.9 * 1.0 - 3.0) ** 2)
    assert values["log_policy"].item() == 0 == values["entropy"].item()


def test_munchausen_of_temperature_near_zero_is_q_learning():
    values = munchausen(alpha=0.0, temperature=1e-4)(transition(**STEP, done=False))
    assert values["loss"].item() == pytest.approx((0.5 + 0.9 * (1 + math.log(2)) - 3.0) ** 2, rel=1e-5)


class Lines(QNetwork):
    """The quantile of a level is a straight line in it, from a table [2, A, 2] of its two ends."""

    in_keys = ("observation",)
    takes_levels = True

    def __init__(self, table) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.tensor(table))

    def forward(self, observation, levels=None):
        low, high = self.table[observation.squeeze(-1).long()].unbind(-1)
        at = torch.tensor([[0.25, 0.75]]) if levels is None else levels
        return low.unsqueeze(-1) + (high - low).unsqueeze(-1) * at.unsqueeze(-2)


FAR = [BIG, BIG]
LINES = [[[0.0, 1.0], [1.0, 3.0], FAR, FAR], [[3.0, 4.0], FAR, [0.0, 1.0], FAR]]
TARGET_LINES = [[[0.0, 0.0]] * 4, [[0.0, 1.0], FAR, [-1.0, 3.0], FAR]]


@pytest.mark.parametrize(
    ("double", "done", "ends"),
    [
        (False, False, (-1.0, 3.0)),  # mean 1 of action 2 against 1/2
        (True, False, (0.0, 1.0)),  # the online network prefers action 0
        (False, True, None),
    ],
)
def test_iqn(double, done, ends):
    loss = IQN(lambda sizes, outputs: Lines(LINES), SIZES, samples=3, target_samples=2, gamma=0.5, double=double)
    set_target(loss, "value_network", TARGET_LINES)
    torch.manual_seed(3)
    values = loss(transition(**STEP, done=done))
    torch.manual_seed(3)
    levels, others = torch.rand(1, 3)[0].tolist(), torch.rand(1, 2)[0].tolist()
    goal = [0.5 + (0.5 * (ends[0] + (ends[1] - ends[0]) * level) if ends else 0) for level in others]
    taken = [1 + 2 * level for level in levels]
    total = 0.0
    for level, theta in zip(levels, taken, strict=True):
        for sample in goal:
            u = sample - theta
            total += abs(level - (u < 0)) * (0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5) / len(goal)
    assert values["loss"].item() == pytest.approx(total, rel=1e-5)
    assert values["quantile_spread"].item() == pytest.approx(max(taken) - min(taken), rel=1e-5)


def test_iqn_acts_by_fixed_levels_and_needs_a_network_that_takes_levels():
    loss = IQN(partial(ImplicitQuantileNetwork, hidden=(4, 4), cosines=3), SIZES, quantiles=4)
    seen = TensorDict({"observation": torch.zeros(1, 1), "action_mask": torch.ones(1, 4, dtype=torch.bool)}, [1])
    before = torch.get_rng_state()
    values = loss.actor(seen)["action_value"]
    assert torch.equal(torch.get_rng_state(), before)
    network = loss.actor[0].module.network
    torch.testing.assert_close(network(torch.zeros(1, 1), torch.tensor([1, 3, 5, 7]) / 8).mean(-1), values)
    with pytest.raises(ScenarioError, match="network=implicit"):
        IQN(MLPNetwork, SIZES)


def test_the_embedding_of_a_level():
    """ReLU of a weighted sum of cos 0, cos(pi tau), cos(2 pi tau), times the features of the state."""
    torch.manual_seed(0)
    network = ImplicitQuantileNetwork(SIZES, hidden=(2, 3), cosines=3)
    seen, level = torch.tensor([[0.7]]), 0.3
    weight, bias = network.level.weight.tolist(), network.level.bias.tolist()
    waves = [math.cos(math.pi * i * level) for i in range(3)]
    embedded = [max(0.0, sum(w * c for w, c in zip(weight[j], waves, strict=True)) + bias[j]) for j in range(2)]
    joined = network.state(seen)[0] * torch.tensor(embedded)
    torch.testing.assert_close(network(seen, torch.tensor([[level]]))[0, :, 0], network.quantiles(joined))


def test_quantiles_of_a_known_distribution_are_found_at_levels_never_fixed():
    torch.manual_seed(0)
    network = ImplicitQuantileNetwork(SIZES, 8, hidden=(16, 16), cosines=8)
    loss = IQN(lambda sizes, outputs: network, SIZES, kappa=0.01, samples=8, quantiles=2)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    rows = torch.cat([transition(**STEP, done=True)] * 128)
    for _ in range(200):
        rows["next", "reward"] = torch.rand(128, 1)
        optimizer.zero_grad()
        loss(rows)["loss"].backward()
        optimizer.step()
    levels = torch.tensor([[0.1, 0.35, 0.5, 0.9]])
    with torch.no_grad(), loss.value_network_params.to_module(network):
        found = network(torch.zeros(1, 1), levels)[0, 1]
    assert found.tolist() == pytest.approx(levels[0].tolist(), abs=0.1)


def test_rainbow_sums_discounted_rewards_within_the_request():
    table = [[[0.0, 0.0], [1.0, 3.0], FAR, FAR], [[5.0, 1.0], FAR, [0.0, 2.0], FAR]]
    target = [[[0.0, 0.0]] * 4, [[-4.0, 5.0], FAR, [1.0, 2.0], FAR]]
    loss = Rainbow(table_network(table), SIZES, quantiles=2, gamma=0.5, n=3)
    set_target(loss, "value_network", target)
    steps = [
        transition(**{**STEP, "reward": float(reward)}, done=done)
        for reward, done in ((1, False), (2, False), (4, True))
    ]
    steps = torch.stack(steps, 1)
    rows = loss.prepare(steps)
    assert rows["next", "reward"].flatten().tolist() == [1 + 0.5 * 2 + 0.25 * 4, 2 + 0.5 * 4, 4]
    assert rows["steps_to_next_obs"].flatten().tolist() == [3, 2, 1]
    rows = loss.prepare(steps[:, :2])  # the batch ends before the request: look ahead from there
    assert rows["next", "reward"].flatten().tolist() == [2, 2]
    # The online network chooses action 0 (mean 3 against 1), of which the target says (-4, 5).
    first = rows[:1]
    goal = [2 + 0.25 * -4, 2 + 0.25 * 5]
    total = 0.0
    for level, theta in ((0.25, 1.0), (0.75, 3.0)):
        for sample in goal:
            u = sample - theta
            total += abs(level - (u < 0)) * (0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5) / 2
    assert loss(first)["loss"].item() == pytest.approx(total)
    assert first["td_error"].item() == pytest.approx(abs(sum(goal) / 2 - 2))


def test_algorithm_2_of_the_paper():
    """Two steps; the second accepts a request and is not learned from."""
    loss = PaperLiteral(table_network(ONLINE), SIZES)
    assert not has_target(loss)
    rows = torch.stack([transition(**STEP, done=False), transition(**STEP, done=True)], 1)
    rows["next", "outcome"] = TensorDict({"accepted": torch.tensor([[[False], [True]]])}, [1, 2])
    rows = loss.prepare(rows)
    values = loss(rows)
    assert values["loss"].item() == pytest.approx((0.5 - 3.0) ** 2 / 2)
    assert values["accepting"].item() == 0.5
    assert rows["td_error"].flatten().tolist() == [2.5, 0]
    values["loss"].backward()
    gradient = loss.value_network_params.get("table").grad
    assert gradient[0, 1].item() == pytest.approx(-2 * (0.5 - 3.0) / 2)
    assert (gradient.flatten()[[0, 2, 3, 4, 5, 6, 7]] == 0).all()
