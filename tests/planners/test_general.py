"""Requests of the general model: the exact search against the integer programme, other planners against both."""

import math

import numpy as np
import pytest
from general_cases import compare, general_case, plan_and_play

from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.planners.milp import embed_request
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.planners.priced import PricedPlanner
from nfv_torchrl.planners.tabu import TabuPlanner
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator


def test_the_search_costs_what_the_programme_does():
    assert 10 < sum(compare(seed) for seed in range(40)) < 30


@pytest.mark.parametrize("planner", [GreedyPlanner, TabuPlanner, PricedPlanner])
def test_plans_are_carried_out_and_no_cheaper_than_the_best(planner):
    found = 0
    for seed in range(40):
        simulator = general_case(seed)
        cost, best = plan_and_play(planner(), simulator), plan_and_play(MyopicPlanner(), general_case(seed))
        assert cost >= best - 1e-9
        assert planner is not PricedPlanner or math.isfinite(cost) == math.isfinite(best)
        found += bool(np.isfinite(cost))
    assert found > 3


def test_the_search_from_both_ends_costs_what_the_programme_does():
    """Nodes with room for one function and links for few crossings, so that the first round seldom finds the answer."""
    several = 0
    for seed in range(40, 400):
        simulator = general_case(seed)
        if not simulator.world.rules.distinct or simulator.tables.chain_length.max() < 4:
            continue
        embedding, planner = embed_request(simulator.world, 0), MyopicPlanner()
        best = math.inf if embedding is None else embedding.cost
        assert plan_and_play(planner, simulator) == pytest.approx(best, abs=1e-6), seed
        several += int(planner.own.rounds[2:].sum())
    assert several > 2


def large_large_small(cpu: list[float]) -> MyopicPlanner:
    """The planner after a request for 5, 5 and 1 cpu on three nodes of a ring of four."""
    substrate = Substrate(
        name="ring", labels=tuple("abcd"), vm_count=np.ones(4, np.int64), vm_capacity=np.array(cpu)[:, None],
        vm_unit_cost=np.ones((4, 1)), links=np.array([[0, 1], [0, 3], [1, 2], [2, 3]]), link_capacity=np.full(4, 9.0),
        link_delay=np.zeros(4), link_unit_cost=np.ones(4), coordinates=None,
    )  # fmt: skip
    chain = ServiceType("chain", ("L", "L", "S"), rate=4.0, tolerable_delay=None, ingress="any", egress="any")
    vnfs = {"L": {"cpu": 5.0}, "S": {"cpu": 1.0}}
    catalogue = ServiceCatalogue((chain,), vnfs, (Resource("cpu", False),))
    simulator = Simulator(
        Scenario("ring", 0, substrate, catalogue, horizon=1, endpoints="uniform", placement="distinct"), 1
    )
    one = np.ones(1, np.int64)
    simulator.start(0, Workload(0 * one, 0 * one, FREE * one, FREE * one, np.ones(1)))
    planner = MyopicPlanner()
    planner.cost = plan_and_play(planner, simulator)
    return planner


def test_the_few_nodes_that_hold_large_functions_are_not_for_small_ones():
    tight = large_large_small([5, 5, 1, 1])
    assert tight.own.hosting.barred.tolist() == [[False, False, True, True]] * 2 + [[True, True, False, False]]
    assert tight.cost == 5 + 5 + 1 + 2 * 4
    assert large_large_small([5, 1, 1, 1]).cost == math.inf
    assert not large_large_small([5, 5, 5, 1]).own.hosting.barred[2].any()  # one is left, whichever two are taken
