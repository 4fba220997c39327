"""Fitness of whole horizons, and compiled play against the same policy step by step."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from nfv_torchrl.bounds.bound import blind_bound
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evolution import CandidatePolicy, FixedNetwork, PricePolicy
from nfv_torchrl.evolution.fitness import Arena, costs_of
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.networks import CandidateNetwork, MLPNetwork, Sizes
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.parallel import Joblib
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.planners.learned_prices import ADMIT
from nfv_torchrl.simulator import Simulator

SOURCE = FixedNetwork({"horizon": 120, "mean_lifetime": 100.0, "arrival_rate": 12.0, "colocation": True,
                       "substrate": {"nodes": 6, "vms_max": 2, "target_rho": 3.0}})  # fmt: skip


def price_policy(seed: int = 0) -> PricePolicy:
    torch.manual_seed(seed)
    policy = PricePolicy(functools.partial(PriceNetwork, hidden=2))
    policy.set_vector(np.random.default_rng(seed).normal(0, 0.5, policy.vector().size))
    return policy


def candidate_policy(activation: str = "ReLU") -> CandidatePolicy:
    sizes = Sizes.of(Simulator(SOURCE.scenario, 1))
    policy = CandidatePolicy(functools.partial(CandidateNetwork, hidden=[8, 4], activation=activation), sizes)
    policy.set_vector(np.random.default_rng(0).normal(0, 0.5, policy.vector().size))
    return policy


def test_fitness_by_its_definition():
    (task,) = SOURCE.draw(0, 0, 1)
    policy = price_policy(3)
    ((score,),) = Arena(cost_weight=2.0, saving_weight=0.1, spread=0.05).scores([policy], [task])
    ours, myopic = (
        run_method(task.scenario, method, [0], workloads=[task.workload])[0]
        for method in (policy.method("ours"), PlannerMethod(MyopicPlanner(), name="myopic_optimal"))
    )
    both = ours.accepted & myopic.accepted
    paired = ours.cost[both].sum() / myopic.cost[both].sum()
    gap = blind_bound(task.scenario, task.workload).aar - myopic.accepted.mean()
    gain = (ours.accepted.mean() - myopic.accepted.mean()) / (gap + 0.05)
    assert gap > 0
    assert (score.aar, score.myopic_aar) == (ours.accepted.mean(), myopic.accepted.mean()) and score.aar < 1
    assert score.paired_cost == pytest.approx(paired) and paired != 1
    assert score.fitness == pytest.approx(gain - 2.0 * max(0, paired - 1) - 0.1 * (paired - 1))


@pytest.mark.parametrize("workers", [Joblib(jobs=3, backend="threading"), Joblib(jobs=2)], ids=["threads", "loky"])
def test_workers_change_nothing(workers):
    tasks = SOURCE.draw(0, 0, 2)
    policies = [price_policy(seed) for seed in range(3)]
    with workers:
        alone, together = (Arena(each).scores(policies, tasks) for each in (None, workers))
    assert alone == together and len(alone) == 3 and len(alone[0]) == 2


@pytest.mark.parametrize("activation", ["ReLU", "Tanh"])
def test_compiled_candidates_are_the_torch_policy(activation):
    (task,) = SOURCE.draw(0, 0, 1)
    policy = candidate_policy(activation)
    costs = costs_of(policy.player(), task.__class__(policy.settings(task.scenario), *_rest(task)))
    (record,) = run_method(task.scenario, policy.method("candidate"), [0], workloads=[task.workload])
    assert 0 < record.accepted.mean() < 1
    np.testing.assert_array_equal(np.isfinite(costs), record.accepted)
    np.testing.assert_array_equal(costs, record.cost)


def _rest(task):
    return task.workload, task.timeline


def test_a_vector_sets_and_copies():
    policy = candidate_policy()
    before = policy.vector()
    other = policy.with_vector(before + 1)
    assert (policy.vector() == before).all() and (other.vector() == before + 1).all()
    assert torch.equal(next(other.parameters()), next(other.network.parameters()))


def test_another_network_is_refused():
    sizes = Sizes.of(Simulator(SOURCE.scenario, 1))
    with pytest.raises(ScenarioError, match="network=candidate"):
        CandidatePolicy(functools.partial(MLPNetwork, hidden=[4]), sizes)
    with pytest.raises(ScenarioError, match="ReLU or Tanh"):
        CandidatePolicy(functools.partial(CandidateNetwork, hidden=[4], activation="ELU"), sizes).player()


def test_without_the_bound_gains_are_divided_by_the_spread_alone():
    (task,) = SOURCE.draw(0, 0, 1)
    arena = Arena(cost_weight=0.0, saving_weight=0.0, spread=0.05, bound=False)
    ((score,),) = arena.scores([price_policy(3)], [task])
    assert [base.gap for base in arena.baselines([task])] == [0.0]
    assert score.fitness == pytest.approx((score.aar - score.myopic_aar) / 0.05) != 0


def test_refusal_alone_is_shaped_where_prices_are_not_learned():
    policy = PricePolicy(functools.partial(PriceNetwork, begin="priced", learn_prices=False))
    before = policy.network.weights()
    policy.set_vector(np.arange(policy.vector().size, dtype=np.float32))
    after = policy.network.weights()
    assert policy.vector().size == before.admit.linear.size == len(ADMIT) + 1
    np.testing.assert_array_equal(after.vm.linear, before.vm.linear)
    np.testing.assert_array_equal(after.link.linear, before.link.linear)
    assert before.vm.linear.any() and after.admit.linear.tolist() == list(range(len(ADMIT) + 1))
    everything = PricePolicy(functools.partial(PriceNetwork, begin="priced"))
    assert everything.state_dict().keys() == policy.state_dict().keys()  # so weights of one begin the other


def test_a_limit_on_the_search_is_that_of_the_planner():
    policy = PricePolicy(PriceNetwork, labels=7)
    assert policy.player().labels == policy.with_vector(policy.vector()).method("limited").planner.labels == 7
    assert PricePolicy(PriceNetwork).player().labels is None
    with pytest.raises(ScenarioError, match="labels is 0"):
        PricePolicy(PriceNetwork, labels=0)
