"""``greedy`` and ``tabu`` on the worked network and on tight random requests."""

from __future__ import annotations

import math

import pytest
from exhaustive import Case, plan_of, planned_cost, tight_case
from toy import DUO, DUO_0_TO_3, action, toy_catalogue, toy_substrate

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, TabuPlanner
from nfv_torchrl.simulator.tables import Rules, build_tables


def duo_case(tolerable_delay: float, colocation: bool = False) -> Case:
    tables = build_tables([toy_substrate()], toy_catalogue(duo_delay=tolerable_delay))
    rules = Rules(colocation, False, False, 100)
    return Case(tables, rules, tables.vm_capacity[0, :, :, 0].copy(), tables.link_capacity[0].copy(), DUO, 0, 3)


def test_greedy_takes_the_cheapest_vm_ahead_and_never_takes_it_back():
    """Paths from 0 to 3 and where A and B go: each time B takes VM 3.0 at $1, which needs 1000 ms.

    0-2-3: A 3.0, then B no longer fits there and takes 3.1: $3 + 10 + 80, 1100 ms. 0-1-2-3: A 1.0, B 3.0: $5 + 10 + 20,
    1545 ms. 0-1-3: the same VMs for $36, 1660 ms. 0-2-1-3: $36, 1825 ms.
    """
    assert plan_of(GreedyPlanner(), duo_case(1050.0)) == []
    assert plan_of(GreedyPlanner(), duo_case(1100.0)) == [action(2), action(3, 0, True), action(3, 1, True)]
    assert plan_of(GreedyPlanner(), duo_case(1545.0)) == [action(1, 0, True), action(2), action(3, 0, True)]
    assert planned_cost(GreedyPlanner(), duo_case(1100.0)) == pytest.approx(93.0)
    assert planned_cost(GreedyPlanner(), duo_case(1545.0)) == pytest.approx(35.0)


def test_greedy_with_colocation_may_use_one_node_twice():
    """On 0-1-2-3 both go to VM 1.0: $5 + 10 + 20, 110 + 250 + 500 + 55 + 130 = 1045 ms."""
    expected = [action(1, 0, True), action(1, 0, True), action(2), action(3)]
    assert plan_of(GreedyPlanner(), duo_case(1050.0, colocation=True)) == expected


def test_greedy_looks_at_no_more_paths_than_it_may():
    assert plan_of(GreedyPlanner(paths=2), duo_case(1545.0)) == plan_of(GreedyPlanner(), duo_case(1545.0))
    assert len(plan_of(GreedyPlanner(paths=1), duo_case(1545.0))) == 3
    assert planned_cost(GreedyPlanner(paths=1), duo_case(1545.0)) == pytest.approx(93.0)


def test_tabu_starts_where_greedy_found_nothing():
    """Moving B from 3.0 to 2.0 on path 0-1-2-3 is one move from what greedy tried, and the optimum."""
    assert plan_of(TabuPlanner(), duo_case(1050.0)) == DUO_0_TO_3[2]
    assert plan_of(TabuPlanner(iterations=0), duo_case(1050.0)) == []
    assert planned_cost(TabuPlanner(iterations=0), duo_case(1100.0)) == pytest.approx(93.0)


@pytest.mark.parametrize("colocation", [False, True])
def test_order_of_costs_on_tight_requests(colocation):
    improved = found = greedy_found = optimal = 0
    for seed in range(300):
        case = tight_case(seed, colocation)
        best = planned_cost(MyopicPlanner(), case)
        greedy, tabu = planned_cost(GreedyPlanner(), case), planned_cost(TabuPlanner(), case)
        assert best - 1e-9 <= tabu <= greedy + 1e-9 or best == math.inf
        assert (best == math.inf) <= (tabu == math.inf) <= (greedy == math.inf)
        improved += tabu < greedy - 1e-9
        greedy_found += greedy < math.inf
        found += tabu < math.inf
        optimal += greedy < best + 1e-9 and best < math.inf
    assert greedy_found > 100
    assert found > greedy_found
    assert improved > 20
    assert optimal > 50


def test_planners_repeat_themselves():
    case = tight_case(3, True)
    for planner in (GreedyPlanner(), TabuPlanner()):
        assert plan_of(planner, case) == plan_of(planner, case)


@pytest.mark.parametrize(
    ("planner", "arguments"),
    [
        (GreedyPlanner, {"paths": 0}),
        (TabuPlanner, {"paths": 0}),
        (TabuPlanner, {"iterations": -1}),
        (TabuPlanner, {"tenure": 0}),
    ],
)
def test_bad_parameters(planner, arguments):
    with pytest.raises(ScenarioError, match=next(iter(arguments))):
        planner(**arguments)
