"""``tabu`` where an end of the request is free: by hand, and on random networks against the plain simulator."""

import math

import numpy as np
import pytest
from general_cases import general_case, plan_and_play
from hypothesis import given
from reference import ReferenceSimulator, _recall, _remember
from strategies import general_instances

from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, TabuPlanner
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator


def line(chain: str, cpu: list[float], cost: list[float], links: list[float], **changes) -> Simulator:
    """One request for ``chain`` of L (5 cpu) and S (1) at 4 Mbit/s on nodes in a line; a unit of a link costs $1."""
    count = len(cpu)
    substrate = Substrate(
        name="line", labels=tuple("abcdef"[:count]), vm_count=np.ones(count, np.int64),
        vm_capacity=np.array(cpu)[:, None], vm_unit_cost=np.array(cost)[:, None],
        links=np.array([[node, node + 1] for node in range(count - 1)]), link_capacity=np.array(links),
        link_delay=np.zeros(count - 1), link_unit_cost=np.ones(count - 1), coordinates=None,
    )  # fmt: skip
    ends = {"ingress": "any", "egress": "any"} | changes
    asked = {name: None if end != "any" else end for name, end in ends.items()}
    service = ServiceType("chain", tuple(chain), rate=4.0, tolerable_delay=None, **asked)
    catalogue = ServiceCatalogue((service,), {"L": {"cpu": 5.0}, "S": {"cpu": 1.0}}, (Resource("cpu", False),))
    scenario = Scenario("line", 0, substrate, catalogue, horizon=1, endpoints="uniform", placement="distinct")
    simulator, one = Simulator(scenario, 1), np.ones(1, np.int64)
    ingress, egress = (FREE if end == "any" else end for end in ends.values())
    simulator.start(0, Workload(0 * one, 0 * one, ingress * one, egress * one, np.ones(1)))
    return simulator


def test_only_another_start_helps():
    """a is cheapest for the first function, but its link is too narrow for any walk that begins there."""
    narrow = [5.0, 5, 5, 5], [1.0, 2, 3, 4], [3.0, 9, 9]
    assert plan_and_play(GreedyPlanner(paths=1), line("LL", *narrow)) == math.inf
    assert plan_and_play(TabuPlanner(paths=1, iterations=0), line("LL", *narrow)) == math.inf
    # From a-b the first function moves to c: 5 * $3, a hop 4 * $1, and b 5 * $2.
    assert plan_and_play(TabuPlanner(paths=1, iterations=1), line("LL", *narrow)) == 15 + 4 + 10


def test_a_worse_start_is_better_for_the_whole():
    """Greedy from a: S on a ($1), L on the only node that has room, d ($5), three hops ($12)."""
    far = [1.0, 1, 1, 5], [1.0, 2, 2, 1], [9.0, 9, 9]
    assert plan_and_play(GreedyPlanner(paths=1), line("SL", *far)) == 1 + 12 + 5
    assert plan_and_play(TabuPlanner(paths=1, iterations=1), line("SL", *far)) == 2 + 4 + 5
    assert plan_and_play(MyopicPlanner(), line("SL", *far)) == 2 + 4 + 5


def test_one_given_end_stays():
    dear = [5.0, 5, 5, 5], [1.0, 9, 2, 1], [9.0, 9, 9]
    # From a: it takes the first function, and the second goes to d for 12 + 5; b is 4 + 45 and c 8 + 10.
    assert plan_and_play(TabuPlanner(), line("LL", *dear, ingress=0)) == 5 + 12 + 5
    # To d: greedy begins on a; the start moves to c, the end stays on d.
    assert plan_and_play(GreedyPlanner(paths=1), line("LL", *dear, egress=3)) == 22
    assert plan_and_play(TabuPlanner(paths=1), line("LL", *dear, egress=3)) == 10 + 4 + 5
    assert plan_and_play(MyopicPlanner(), line("LL", *dear, egress=3)) == 10 + 4 + 5


def test_a_link_that_the_chain_itself_fills_is_seen():
    """Greedy puts b, a and then c, so that the link a-b, which has room for once, is crossed twice."""
    once = [5.0, 5, 5, 5], [2.0, 1, 3, 4], [5.0, 9, 9]
    assert plan_and_play(GreedyPlanner(paths=1), line("LLL", *once)) == math.inf
    # The only move of one function that helps is a to d: b, two hops, d, a hop, c.
    assert plan_and_play(TabuPlanner(paths=1, iterations=1), line("LLL", *once)) == 5 + 8 + 20 + 4 + 15
    # The best is a, b, c.
    assert 10 + 4 + 5 + 4 + 15 <= plan_and_play(TabuPlanner(paths=1), line("LLL", *once)) < 52
    assert plan_and_play(TabuPlanner(), line("LLLL", [5.0, 1, 5, 5], [1.0] * 4, [9.0, 9, 9])) == math.inf


def test_between_greedy_and_the_best_on_tight_requests():
    found = optimal = improved = feasible = 0
    for seed in range(400, 560):
        if not general_case(seed).world.rules.free_ends:
            continue
        tabu, greedy, best = (
            plan_and_play(planner(), general_case(seed)) for planner in (TabuPlanner, GreedyPlanner, MyopicPlanner)
        )
        assert best - 1e-9 <= tabu <= greedy + 1e-9
        feasible += best < math.inf
        found += tabu < math.inf
        optimal += tabu <= best + 1e-9 and best < math.inf
        improved += tabu < greedy - 1e-9
    assert 20 < optimal <= found <= feasible
    assert found > 0.9 * feasible and optimal > 0.7 * feasible and improved > 5


@given(general_instances(admission_control=True))
def test_the_plain_simulator_takes_every_plan(instance):
    """Request after request, each answered by ``tabu``: every step passes, and none is cheaper than the best."""
    reference = ReferenceSimulator(*instance)
    simulator = Simulator([instance.scenario], 1)
    simulator.start(0, instance.workload, instance.timeline)
    tabu, best = TabuPlanner(paths=3), MyopicPlanner()
    while not reference.done:
        plan, cheapest = actions_of(tabu, simulator), actions_of(best, simulator)
        assert bool(plan) <= bool(cheapest)
        least = cost_of(reference, cheapest)
        for action in plan or [reference.reject]:
            result = reference.step(action)
            simulator.step(np.array([action]))
            assert result["passed"] == bool(plan)
            assert simulator.outcome["accepted"][0] == result["accepted"]
        assert result["request_done"] and result["accepted"] == bool(plan)
        assert not plan or result["request_cost"] >= least - 1e-9


def actions_of(planner, simulator: Simulator) -> list[int]:
    """What a planner answers the request in hand with."""
    plans, lengths = np.zeros((1, simulator.world.rules.max_steps), np.int64), np.zeros(1, np.int64)
    planner.prepare(simulator.world)
    planner.plan_rows(simulator.world, np.zeros(1, np.int64), plans, lengths)
    return plans[0, : lengths[0]].tolist()


def cost_of(reference: ReferenceSimulator, actions: list[int]) -> float:
    """$ of a plan for the request that waits, which goes on waiting."""
    before = _remember(reference)
    for action in actions:
        reference._reserve(action)
    cost = reference.request.cost
    _recall(reference, before)
    return cost


def test_answers_repeat():
    for seed in (401, 404, 409):
        planner = TabuPlanner()
        first = plan_and_play(planner, general_case(seed))
        assert plan_and_play(planner, general_case(seed)) == pytest.approx(first, abs=0)
