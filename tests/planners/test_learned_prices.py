"""Learned prices inside the exact search: the functions worked out by hand, and what they make of whole horizons."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from toy import DUO, toy_scenario, workload_of

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method, scenario_for
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.networks.prices import PriceHead, PriceNetwork
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.planners.learned_prices import (
    ADMIT_FEATURES,
    LINK_FEATURES,
    VM_FEATURES,
    LearnedPrices,
)
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator


def heavy(**changes):
    return paper_scenario(
        8, seed=1, arrival_rate=12.0, mean_lifetime=300.0, horizon=200, substrate={"target_rho": 2.0}, **changes
    )


def network(seed: int | None = None, hidden: int = 3) -> PriceNetwork:
    """All zero, or with random weights."""
    made = PriceNetwork(hidden=hidden)
    if seed is not None:
        torch.manual_seed(seed)
        for parameter in made.parameters():
            torch.nn.init.normal_(parameter, std=0.5)
    return made


def learned(made: PriceNetwork) -> PlannerMethod:
    return PlannerMethod(LearnedPrices(made.weights()), name="learned_prices")


def planned(made: PriceNetwork, *, observe_lifetime=False, use=()):
    """Plan one duo from 0 to 3 of the toy network, lifetime twice the mean; ``use`` [(node, vm, used units)]."""
    scenario = toy_scenario().replace(observe_lifetime=observe_lifetime, mean_lifetime=5.0, admission_control=True)
    simulator = Simulator(scenario, 1)
    simulator.start(0, workload_of((0, DUO, 0, 3, 10.0)))
    world = simulator.world
    for node, vm, units in use:
        world.ledger.vm_offered[0, node, vm] -= units
        world.ledger.vm_used[0, 0] += units
    planner = LearnedPrices(made.weights())
    lengths = np.zeros(1, np.int64)
    planner.plan_rows(world, np.zeros(1, np.int64), np.zeros((1, 100), np.int64), lengths)
    return lengths[0], planner.own.search


@torch.no_grad()
def test_price_of_a_vm_by_hand():
    made = network(hidden=1)
    made.vm.linear[VM_FEATURES.index("used")] = 0.5
    made.vm.linear[-1] = -0.1
    made.vm.out[0] = 0.2
    made.vm.hidden[0] = 0.0
    made.vm.hidden[0, VM_FEATURES.index("network_used")] = 1.0
    _, search = planned(made, use=[(0, 0, 30_000_000)])
    # VM 0.0: 30 of 40 Mcycles/s used; of the network 30 of 330. Mean unit cost (3 + 1 + 5 + 2 + 1 + 4) / 6, times 4.
    value = 0.5 * 0.75 - 0.1 + 0.2 * math.tanh(30 / 330)
    assert search.vm_price[0, 0, 0] == pytest.approx(3.0 + 0.75 * value * 4 * 16 / 6)
    assert search.vm_price[1, :, 0].tolist() == [1.0, 5.0]  # unused: what they cost
    assert search.link_price.tolist() == [2.0, 1.0, 1.0, 4.0, 2.0]


@torch.no_grad()
@pytest.mark.parametrize(
    ("feature", "value"),
    [
        ("used_pow4", 0.75**4),
        ("used_pow16", 0.75**16),
        ("short", 25 / 35),  # reference load: mean of 30 (duo) and 20 (solo); 10 Mcycles/s are free
        ("tight", 20 / 30),  # the duo's larger function needs 20
        ("node_used", 0.75),
        ("dear", 3 / (16 / 6) - 1),
        ("load", 0.5 * math.log(30 / 25)),
    ],
)
def test_features_of_a_vm_by_hand(feature, value):
    made = network(hidden=0)
    made.vm.linear[VM_FEATURES.index(feature)] = 1.0
    _, search = planned(made, use=[(0, 0, 30_000_000)])
    assert search.vm_price[0, 0, 0] == pytest.approx(3.0 + 0.75 * value * 4 * 16 / 6)


@torch.no_grad()
def test_a_request_above_the_threshold_is_refused():
    steps, search = planned(network())
    assert steps > 0
    cost = search.result[0]
    # priced cost over that of the reference load at the price unit
    value = math.log(cost / (4 * 16 / 6 * 25)) / 3
    for bias, refused in ((1.0 - value - 1e-6, False), (1.0 - value + 1e-6, True)):
        made = network()
        made.admit.linear[ADMIT_FEATURES.index("priced")] = 1.0
        made.admit.linear[-1] = bias
        assert (planned(made)[0] == 0) == refused


@torch.no_grad()
def test_lifetimes_count_only_where_they_are_seen():
    made = network()
    made.admit.linear[ADMIT_FEATURES.index("lifetime")] = 2.0  # the lifetime is twice the mean: 2 log 2 > 1
    assert planned(made)[0] > 0
    assert planned(made, observe_lifetime=True)[0] == 0


@pytest.mark.parametrize("colocation", [False, True])
def test_without_prices_it_is_myopic_optimal(colocation):
    scenario = heavy(colocation=colocation)
    ours, theirs = (
        run_method(scenario, method, [0, 1])
        for method in (learned(network()), PlannerMethod(MyopicPlanner(), name="myopic_optimal"))
    )
    for a, b in zip(ours, theirs, strict=True):
        assert (a.accepted == b.accepted).all() and not a.accepted.all()
        np.testing.assert_array_equal(a.cost, b.cost)


def test_whole_horizons_in_one_call_are_those_of_the_method():
    scenario = heavy(colocation=True)
    refused = 0
    for seed in range(5):
        method = learned(network(seed))
        (record,) = run_method(scenario, method, [0])
        simulator = Simulator(scenario_for(scenario, method), 1)
        workload = scenario.workload(0)
        simulator.start(0, workload)
        costs = np.full(len(workload), -1.0)
        method.planner.play(simulator, 0, costs)
        np.testing.assert_array_equal(costs, record.cost)
        refused += 0 < record.accepted.mean() < 1
    assert refused >= 3  # the weights matter


def test_the_compiled_functions_are_the_networks():
    torch.manual_seed(0)
    head = PriceHead(len(LINK_FEATURES), 3)
    with torch.no_grad():
        head.out += torch.randn(3)
        head.linear += torch.randn(len(LINK_FEATURES) + 1)
    x = torch.zeros(1, len(LINK_FEATURES))
    x[0, 0], x[0, 1], x[0, 2] = 0.5, 0.5**4, 0.5**16
    made = network()
    made.link.load_state_dict(head.state_dict())
    scenario = dataclasses.replace(toy_scenario(), admission_control=True)
    simulator = Simulator(scenario, 1)
    simulator.start(0, workload_of((0, DUO, 0, 3, 10.0)))
    simulator.world.ledger.link_offered[0, 4] //= 2
    x[0, 3] = 1 / (1 + 5)  # rate 1 of 5 that are free
    x[0, 5] = 0.5 * math.log(30 / 25)
    planner = LearnedPrices(made.weights())
    planner.plan_rows(simulator.world, np.zeros(1, np.int64), np.zeros((1, 100), np.int64), np.zeros(1, np.int64))
    expected = 2.0 + 0.5 * max(head(x).item(), 0.0) * 4 * 16 / 6
    assert head(x).item() > 0
    assert planner.own.search.link_price[4] == pytest.approx(expected, rel=1e-6)


@torch.no_grad()
@pytest.mark.parametrize(("rule", "highest"), [("priced", 4.0), ("priced_admit", 2.0)])
def test_it_may_begin_near_a_hand_tuned_rule(rule, highest):
    made = PriceNetwork(begin=rule, price_unit=16.0)
    used = torch.linspace(0, 1, 101)
    x = torch.zeros(101, len(VM_FEATURES))
    x[:, 0], x[:, 1], x[:, 2] = used, used**4, used**16
    price = used * made.vm(x).clamp(min=0)
    expected = highest * (3000.0**used - 1) / 2999
    assert (price - expected).abs().max() < 0.05 * highest


@torch.no_grad()
def test_only_one_of_the_rules_refuses():
    made = PriceNetwork(begin="priced_admit", price_unit=16.0)
    # Refusal above 75 mean unit costs, 4.69 price units, for the reference load.
    judged = torch.zeros(2, len(ADMIT_FEATURES))
    judged[:, 0] = torch.tensor([4.6, 4.7]).log() / 3
    assert (made.admit(judged) > 1).tolist() == [False, True]
    assert not PriceNetwork(begin="priced").admit.linear.any()


def test_bad_settings_are_named():
    with pytest.raises(ScenarioError, match=r"network\.begin: 'zero'"):
        PriceNetwork(begin="zero")
    with pytest.raises(ScenarioError, match=r"network\.price_unit: 0"):
        PriceNetwork(price_unit=0)
    with pytest.raises(ScenarioError, match=r"network\.hidden"):
        PriceNetwork(hidden=-1)
