"""Memory across requests: the sequence loss by hand, the carried state in the environment and in evaluations."""

from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from two_states import SIZES

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN
from nfv_torchrl.losses.ppo import PPO
from nfv_torchrl.losses.recurrent_dqn import RecurrentDQN
from nfv_torchrl.methods import PolicyMethod
from nfv_torchrl.networks import MLPNetwork, QNetwork, Sizes
from nfv_torchrl.networks.gru import GRUNetwork
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


class SumNetwork(QNetwork):
    """Remembers the sum of the observations; the value of action a is ``scale[a]`` times it."""

    in_keys = ("observation", "memory")

    def __init__(self, sizes: Sizes, outputs: int = 1) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor([1.0, 2.0, 3.0, 100.0]))

    def forward(self, observation, memory):
        after = memory + observation
        return after * self.scale, after

    def unroll(self, observation, memory, restart):
        values = []
        for step, begins in zip(observation.unbind(1), restart.unbind(1), strict=True):
            value, memory = self(step, memory.masked_fill(begins.unsqueeze(-1), 0.0))
            values.append(value)
        return torch.stack(values, 1), memory


def collected(*, masks, request_done=(False, False, False), done=(False, False, False)) -> TensorDict:
    """Three steps with observations 1, 2, 3 and 4 after them, from a memory of 10."""
    seen = torch.tensor([[[1.0], [2.0], [3.0], [4.0]]])
    masks = torch.tensor([masks], dtype=torch.bool)
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
            "action": torch.tensor([[0, 1, 0]]),
            "next": TensorDict(after, batch_size=[1, 3]),
        },
        batch_size=[1, 3],
    )


ALL_BUT_LAST = [1, 1, 1, 0]
MASKS = [ALL_BUT_LAST, ALL_BUT_LAST, [1, 0, 0, 0], [0, 1, 0, 0]]


def make(**settings):
    loss = RecurrentDQN(SumNetwork, SIZES, gamma=0.9, **settings)
    for _, leaf in loss.target_value_network_params.items(True, True):
        leaf.data.copy_(torch.tensor([2.0, 1.0, 0.5, 1000.0]))
    return loss


@pytest.mark.parametrize("double", [False, True])
def test_the_loss_by_hand(double):
    loss = make(double=double)
    out = loss(loss.prepare(collected(masks=MASKS)))
    # The memory is 11, 13, 16, 20. Chosen: 11 * 1, 13 * 2, 16 * 1.
    # Next: of 0, 1, 2 online prefers action 2 (target value 13 * 0.5), the target action 0 (13 * 2); then 16 * 2, 20.
    first = 13 * (0.5 if double else 2)
    errors = [11 - (0.5 + 0.9 * first), 26 - (0.25 + 0.9 * 32), 16 - (1 + 0.9 * 20)]
    assert out["loss"].item() == pytest.approx(np.square(errors).mean())
    assert out["td_error"].item() == pytest.approx(np.abs(errors).mean())


def test_looking_ahead_ends_with_the_request_and_the_memory_does_not():
    loss = make(double=False)
    out = loss(loss.prepare(collected(masks=MASKS, request_done=(False, True, False))))
    errors = [11 - (0.5 + 0.9 * 26), 26 - 0.25, 16 - (1 + 0.9 * 20)]
    assert out["loss"].item() == pytest.approx(np.square(errors).mean())


def test_the_memory_ends_with_the_horizon():
    loss = make(double=False)
    out = loss(loss.prepare(collected(masks=MASKS, done=(False, True, False))))
    # After the second step the memory starts again: 11, 13, 3, 7.
    errors = [11 - (0.5 + 0.9 * 26), 26 - 0.25, 3 - (1 + 0.9 * 7)]
    assert out["loss"].item() == pytest.approx(np.square(errors).mean())


def test_burn_in_is_not_learned_from():
    loss = make(double=False, burn_in=2)
    rows = loss.prepare(collected(masks=MASKS))
    out = loss(rows)
    assert out["loss"].item() == pytest.approx((16 - (1 + 0.9 * 20)) ** 2)
    with pytest.raises(ScenarioError, match="burn_in"):
        make(burn_in=3).prepare(collected(masks=MASKS))


@pytest.mark.parametrize("kind", [DQN, PPO])
def test_a_memory_needs_sequences(kind):
    with pytest.raises(ScenarioError, match="memory"):
        kind(GRUNetwork, SIZES)


def test_a_network_without_memory_is_refused():
    with pytest.raises(ScenarioError, match="network=gru"):
        RecurrentDQN(MLPNetwork, SIZES)


def test_unrolling_is_stepping():
    torch.manual_seed(0)
    network = GRUNetwork(Sizes(5, 7, 1, 0), hidden=6)
    seen, memory = torch.randn(3, 4, 5), torch.randn(3, 6)
    restart = torch.zeros(3, 4, dtype=torch.bool)
    restart[1, 2] = True
    values, last = network.unroll(seen, memory, restart)
    for t in range(4):
        memory = memory.masked_fill(restart[:, t, None], 0.0)
        expected, memory = network(seen[:, t], memory)
        torch.testing.assert_close(values[:, t], expected)
    torch.testing.assert_close(last, memory)


@pytest.fixture(scope="module")
def small():
    """Eight slots on four nodes, and a recurrent policy for it."""
    scenario = paper_scenario(nodes=4, seed=1, horizon=8, arrival_rate=2)
    torch.manual_seed(0)
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=True))
    loss = RecurrentDQN(partial(GRUNetwork, hidden=8), sizes)
    return scenario, loss


def make_env(scenario, loss, batch):
    return NFVEnv(scenario, batch, observations=loss.actor[0].module.observations(), seed=3)


def test_the_memory_goes_across_requests_and_ends_with_the_horizon(small):
    scenario, loss = small
    with torch.no_grad():
        data = make_env(scenario, loss, 3).rollout(200, loss.actor, break_when_any_done=False)
    done, ended = (data["next", key].squeeze(-1) for key in ("done", "request_done"))
    assert done.any() and (ended & ~done).any()
    assert (data["memory"][:, 0] == 0).all()
    begins = torch.cat([torch.ones_like(done[:, :1]), done[:, :-1]], 1)
    assert (data["memory"][begins] == 0).all()
    assert (data["memory"][:, 1:][(ended & ~done)[:, :-1]] != 0).any()
    # The sequence loss sees the same values that the policy acted by.
    rows = loss.prepare(data[:, 5:40])
    network = loss.actor[0].module
    with torch.no_grad():
        values, _ = network.unroll(rows["observation"], rows["memory"], rows["restart"])
    chosen = values[:, :-1].gather(-1, rows["action"].unsqueeze(-1))
    torch.testing.assert_close(chosen, data["chosen_action_value"][:, 5:40], atol=1e-5, rtol=1e-4)


def test_the_memory_is_part_of_the_environments_state(small):
    scenario, loss = small
    whole, stopped, resumed = (make_env(scenario, loss, 3) for _ in range(3))
    with torch.no_grad():
        expected = whole.rollout(60, loss.actor, break_when_any_done=False)
        stopped.rollout(25, loss.actor, break_when_any_done=False)
        resumed.load_state_dict(stopped.state_dict())
        rest = resumed.rollout(35, loss.actor, break_when_any_done=False)
    for key in ("memory", "action", "observation"):
        assert torch.equal(rest[key], expected[:, 25:][key]), key


def test_an_evaluation_carries_the_memory(small):
    scenario, loss = small
    workload = scenario.workload(3, 0, 0)
    method = PolicyMethod(loss.actor, loss.actor[0].module.observations())
    records = [run_method(scenario, method, [0], workloads=[workload])[0] for _ in range(2)]
    with torch.no_grad():
        data = make_env(scenario, loss, 1).rollout(10_000, loss.actor)
    accepted = data["next", "outcome", "accepted"][data["next", "request_done"]]
    for record in records:
        assert accepted.tolist() == record.accepted.tolist()
        assert data["next", "outcome", "request_cost"].sum().item() == pytest.approx(np.nansum(record.cost), rel=1e-5)
