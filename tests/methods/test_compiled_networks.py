"""Networks that score every action decide compiled as they do through torch, whichever loss they belong to."""

from functools import partial

import numpy as np
import pytest
import torch

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN, IQN, PPO, QuantileDQN, Rainbow, greedy_actor, q_network
from nfv_torchrl.losses.actors import scorer
from nfv_torchrl.losses.rdpg import RDPG
from nfv_torchrl.losses.recurrent_dqn import RecurrentDQN
from nfv_torchrl.methods import CompiledNetwork, PolicyMethod, fastest_method
from nfv_torchrl.networks import (
    CandidateNetwork,
    DuelingNetwork,
    GRUNetwork,
    ImplicitQuantileNetwork,
    MLPNetwork,
    Sizes,
)
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

SCENARIO = paper_scenario(
    nodes=5, seed=1, horizon=10, arrival_rate=25, mean_lifetime=1000, mask="feasible", admission_control=True
)
LOSSES = {
    "perceptron": (DQN, partial(MLPNetwork, hidden=[16, 7])),
    "tanh": (DQN, partial(MLPNetwork, hidden=[16], activation="Tanh")),
    "noisy": (DQN, partial(MLPNetwork, hidden=[16], noisy=True)),
    "dueling": (DQN, partial(DuelingNetwork, hidden=[16, 7])),
    "dueling without trunk": (DQN, partial(DuelingNetwork, hidden=[16])),
    "quantiles": (QuantileDQN, partial(MLPNetwork, hidden=[16])),
    "rainbow": (Rainbow, partial(DuelingNetwork, hidden=[16, 7], noisy=True)),
    "policy gradient": (PPO, partial(MLPNetwork, hidden=[16])),
    "implicit quantiles": (IQN, partial(ImplicitQuantileNetwork, hidden=[16, 7], noisy=True)),
    "their mean": (DQN, partial(ImplicitQuantileNetwork, hidden=[12, 16, 7], activation="Tanh")),
    "memory": (RecurrentDQN, partial(GRUNetwork, hidden=8)),
    "memory of a policy": (RDPG, partial(GRUNetwork, hidden=8)),
}


def both_methods(kind):
    torch.manual_seed(0)
    loss_class, network = LOSSES[kind]
    loss = loss_class(network, Sizes.of(Simulator(SCENARIO, 1)))
    loss.actor.eval()  # noise is left out
    made = q_network(loss)
    return fastest_method(loss.actor, made, one_hot=False), PolicyMethod(loss.actor, made.observations(), one_hot=False)


def started(method):
    simulator = Simulator(SCENARIO, 3)
    for b in range(3):
        simulator.start(b, SCENARIO.workload(0, b))
    method.prepare(simulator, range(3))
    return simulator


@pytest.mark.parametrize("kind", LOSSES)
def test_whole_runs_are_the_same(kind):
    compiled, slow = both_methods(kind)
    assert isinstance(compiled, CompiledNetwork)
    a, b = (run_method(SCENARIO, method, [0])[0] for method in (compiled, slow))
    assert (a.accepted == b.accepted).all() and (a.step_node == b.step_node).all()
    assert 0 < a.accepted.mean() < 1 and len(set(a.step_node)) > 2


@pytest.mark.parametrize("kind", [kind for kind in LOSSES if "memory" not in kind])
def test_the_values_that_decided_are_those_of_the_network(kind):
    compiled, slow = both_methods(kind)
    simulator = started(compiled)
    values_of = scorer(slow.actor).module
    keys = scorer(slow.actor).in_keys
    for _ in range(50):
        actions = compiled.act(simulator)
        seen = simulator.world.seen
        mask = torch.from_numpy(seen.mask)
        inputs = (torch.from_numpy(seen.flat), mask)[: len(keys)]
        with torch.no_grad():
            values = values_of(*inputs).masked_fill(~mask, -torch.inf)
        best = values.topk(2).values.numpy()
        best[np.isinf(best)] = np.nan
        assert np.allclose(compiled._values, best, atol=1e-5, equal_nan=True)
        simulator.step(actions)


@pytest.mark.parametrize("kind", ["memory", "memory of a policy"])
def test_environments_side_by_side_keep_memories_of_their_own(kind):
    compiled, slow = both_methods(kind)
    simulators = [started(method) for method in (compiled, slow)]
    assert not compiled._scorer.memory.any()  # preparing took a step
    for _ in range(100):
        actions = [method.act(simulator) for method, simulator in zip((compiled, slow), simulators, strict=True)]
        assert (actions[0] == actions[1]).all()
        assert np.allclose(compiled._scorer.memory, slow._carried.get("memory"), atol=1e-5)
        for simulator in simulators:
            simulator.step(actions[0])
    started(compiled)
    assert not compiled._scorer.memory.any()  # a run begins without that of the run before


class Twisted(MLPNetwork):
    def forward(self, observation):
        return -super().forward(observation)


class TwistedRows(CandidateNetwork):
    def forward(self, rows, valid):
        return -super().forward(rows, valid)


@pytest.mark.parametrize("network", [partial(MLPNetwork, activation="ELU"), Twisted, TwistedRows])
def test_what_may_compute_something_else_acts_through_torch(network):
    made = DQN(network, Sizes.of(Simulator(SCENARIO, 1)))
    assert isinstance(fastest_method(made.actor, q_network(made), one_hot=False), PolicyMethod)


@pytest.mark.parametrize("network", [MLPNetwork, CandidateNetwork])
def test_an_actor_that_changes_the_values_acts_through_torch(network):
    class Doubted(torch.nn.Module):
        def __init__(self, network):
            super().__init__()
            self.network = network

        def forward(self, *inputs):
            return -self.network(*inputs)

    made = network(sizes := Sizes.of(Simulator(SCENARIO, 1)))
    actor = greedy_actor(Doubted(made), sizes.actions, made.in_keys)
    assert isinstance(fastest_method(actor, made, one_hot=False), PolicyMethod)


def test_an_actor_that_reads_other_keys_acts_through_torch():
    made = MLPNetwork(sizes := Sizes.of(Simulator(SCENARIO, 1)))
    actor = greedy_actor(made, sizes.actions, ["features"])
    assert isinstance(fastest_method(actor, made, one_hot=False), PolicyMethod)
