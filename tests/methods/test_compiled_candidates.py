"""The compiled candidate network decides as the torch one does."""

import pytest
import torch

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import greedy_actor
from nfv_torchrl.methods import CompiledCandidates, PolicyMethod, acting_method
from nfv_torchrl.networks import CandidateNetwork, MLPNetwork, Sizes
from nfv_torchrl.observations import read_observation
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

SCENARIO = paper_scenario(
    nodes=5, seed=1, horizon=100, arrival_rate=25, mean_lifetime=1000, mask="feasible", admission_control=True
)


@pytest.mark.parametrize("activation", ["ReLU", "Tanh"])
@pytest.mark.parametrize("hidden", [[], [8], [16, 7]])
def test_it_takes_the_valid_action_of_the_highest_output(activation, hidden):
    torch.manual_seed(0)
    simulator = Simulator(SCENARIO, 4)
    for b in range(4):
        simulator.start(b, SCENARIO.workload(0, b))
    network = CandidateNetwork(Sizes.of(simulator), hidden=hidden, activation=activation)
    method = CompiledCandidates(network)
    method.prepare(simulator, range(4))
    for _ in range(300):
        seen = read_observation(simulator, network.observations())
        with torch.no_grad():
            values = network(*[seen.get(key) for key in network.in_keys])
        values = values.masked_fill(~seen["action_mask"], -torch.inf)
        actions = torch.from_numpy(method.act(simulator))
        chosen = values.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
        assert torch.isfinite(chosen).all()  # valid ones
        assert torch.allclose(chosen, values.amax(-1), atol=1e-5)
        simulator.step(torch.multinomial(seen["action_mask"].float(), 1).flatten().numpy())  # sees many states


def test_whole_runs_are_the_same():
    torch.manual_seed(1)
    sizes = Sizes.of(Simulator(SCENARIO, 1))
    network = CandidateNetwork(sizes, hidden=[8])
    actor = greedy_actor(network, sizes.actions)
    compiled = acting_method(actor, network, one_hot=True, mask="feasible")
    assert isinstance(compiled, CompiledCandidates)
    slow = PolicyMethod(actor, network.observations(), one_hot=True, mask="feasible")
    for a, b in zip(*(run_method(SCENARIO, method, [0, 1]) for method in (compiled, slow)), strict=True):
        assert (a.accepted == b.accepted).all() and (a.step_node == b.step_node).all() and 0 < a.accepted.mean() < 1


def test_what_cannot_be_compiled_acts_through_torch():
    sizes = Sizes.of(Simulator(SCENARIO, 1))
    for network in (
        CandidateNetwork(sizes, hidden=[8], noisy=True),
        CandidateNetwork(sizes, hidden=[8], activation="ELU"),
        MLPNetwork(sizes),
    ):
        method = acting_method(greedy_actor(network, sizes.actions), network, one_hot=True)
        assert isinstance(method, PolicyMethod)
