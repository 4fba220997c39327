"""Networks: the dueling sum, noise, and one output per action or several."""

import pytest
import torch

from nfv_torchrl.networks import CandidateNetwork, DuelingNetwork, MLPNetwork, NoisyLinear, Sizes
from nfv_torchrl.observations import read_observation
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

SIZES = Sizes(observation=6, actions=5, services=2, candidate_features=3)


def read_inputs(network, seen):
    return [seen.get(key) for key in network.in_keys]


@pytest.mark.parametrize("make", [MLPNetwork, DuelingNetwork, CandidateNetwork])
@pytest.mark.parametrize("noisy", [False, True])
def test_one_or_several_values_per_action_in_any_batch_shape(make, noisy):
    scenario = paper_scenario(nodes=4, seed=1, horizon=20)
    simulator = Simulator(scenario, 6, one_hot=True)
    for b in range(6):
        simulator.start(b, scenario.workload(0, b))
    sizes = Sizes.of(simulator)
    for outputs, shape in ((1, ()), (3, (3,))):
        network = make(sizes, outputs, hidden=[8, 8], noisy=noisy)
        seen = read_observation(simulator, network.observations())
        for batch in (seen, seen.reshape(2, 3), seen[0]):
            values = network(*read_inputs(network, batch))
            assert values.shape == (*batch.shape, sizes.actions, *shape)


def test_dueling_values_average_to_the_state_value_over_valid_actions():
    torch.manual_seed(0)
    network = DuelingNetwork(SIZES, hidden=[7])
    observation = torch.randn(3, 6)
    mask = torch.tensor([[1, 1, 0, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 1]], dtype=torch.bool)
    values = network(observation, mask)
    means = torch.stack([row[valid].mean() for row, valid in zip(values, mask, strict=True)])
    assert torch.allclose(means, network.value(observation).squeeze(-1), atol=1e-6)
    # Between actions the difference is that of their advantages.
    advantage = network.advantage(observation)
    assert torch.allclose(values[:, :1] - values, advantage[:, :1] - advantage, atol=1e-6)


def test_noise_is_factorised_and_zero_in_evaluation():
    torch.manual_seed(0)
    layer = NoisyLinear(3, 2)
    x = torch.randn(3).expand(200_000, 3)
    drawn = layer(x)
    layer.eval()
    assert torch.equal(layer(x[:1]), torch.nn.functional.linear(x[:1], layer.weight_mu, layer.bias_mu))
    # Entries of weights and bias have standard deviation sigma * E|eps| since f(eps)^2 = |eps|: E|eps| = sqrt(2 / pi),
    # for a product its square; zero covariance, for f is odd.
    e = (2 / torch.pi) ** 0.5
    variance = (layer.weight_sigma**2 * x[0] ** 2).sum(-1) * e * e + layer.bias_sigma**2 * e
    assert torch.allclose(drawn.mean(0), layer(x[:1])[0], atol=0.01)
    assert torch.allclose(drawn.var(0), variance, rtol=0.05)


def test_each_row_has_noise_of_its_own_and_shares_it_within():
    torch.manual_seed(0)
    layer = NoisyLinear(3, 2)
    rows = layer(torch.ones(4, 5, 3))
    assert torch.allclose(rows[:, :1].expand_as(rows), rows)
    assert len({tuple(row) for row in rows[:, 0].tolist()}) == 4
    assert not torch.equal(layer(torch.ones(3)), layer(torch.ones(3)))
    sum(layer(torch.ones(4, 3))).sum().backward()
    assert layer.weight_sigma.grad.abs().sum() > 0 and layer.bias_sigma.grad.abs().sum() > 0


def test_candidate_values_are_the_same_under_vmap():
    """TorchRL's value estimators map over states, where rows in use cannot be picked out."""
    torch.manual_seed(0)
    network = CandidateNetwork(Sizes(0, 6, 2, 3), hidden=[4])
    features, action = torch.randn(5, 4, 3), torch.tensor([3, 1, 0, 2]).expand(5, 4)
    used = torch.arange(4) < torch.tensor([[4], [1], [2], [3], [3]])
    mask = torch.ones(5, 6, dtype=torch.bool)
    values = network(features, action, used, mask)
    assert torch.allclose(torch.vmap(network)(features, action, used, mask), values)
    assert (values != 0).sum() == 13
