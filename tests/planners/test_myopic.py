"""The exact planner against worked answers and against trying every walk."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from exhaustive import Case, cheapest_by_trying, checked_cost, plan_of, planned_cost, tight_case
from numba import njit
from toy import (
    DUO,
    DUO_0_TO_3,
    DUO_0_TO_3_COLOCATED,
    DUO_0_TO_3_THIRD,
    SOLO,
    SOLO_3_TO_0,
    toy_catalogue,
    toy_substrate,
)

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, PricedPlanner, TabuPlanner
from nfv_torchrl.search import cheapest
from nfv_torchrl.search.cheapest import grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.search.walks import Prices
from nfv_torchrl.simulator.state import new_world
from nfv_torchrl.simulator.tables import Rules, build_tables

INSTANCES = 300


def toy_case(service: int, ingress: int, egress: int, colocation: bool = False, max_steps: int = 100) -> Case:
    tables = build_tables([toy_substrate()], toy_catalogue())
    rules = Rules(colocation, False, False, max_steps)
    return Case(
        tables, rules, tables.vm_capacity[0, :, :, 0].copy(), tables.link_capacity[0].copy(), service, ingress, egress
    )


def assert_plans(case: Case, expected: tuple[float, float, list[int]]) -> None:
    cost, _, actions = expected
    assert plan_of(MyopicPlanner(), case) == actions
    assert checked_cost(case, actions) == pytest.approx(cost, abs=1e-9)


def test_worked_answers():
    assert_plans(toy_case(DUO, 0, 3), DUO_0_TO_3)
    assert_plans(toy_case(DUO, 0, 3, colocation=True), DUO_0_TO_3_COLOCATED)
    assert_plans(toy_case(SOLO, 3, 0), SOLO_3_TO_0)


def test_walk_bounces_between_two_nodes_when_that_is_cheapest():
    case = toy_case(DUO, 0, 3)
    case.vm_offered[1, 0] -= 20_000_000
    case.vm_offered[2, 0] -= 40_000_000
    assert_plans(case, DUO_0_TO_3_THIRD)


def test_results_tell_cost_and_delay():
    case = toy_case(DUO, 0, 3)
    scratch = make_scratch(case.tables)
    plan = np.zeros(100, np.int64)
    tables = case.tables
    doubled = Prices(2 * tables.vm_unit_cost[0], 2 * tables.link_unit_cost[0])
    steps = plan_cheapest(case.world, 0, doubled, scratch, plan)
    assert steps == 3
    assert scratch.result == pytest.approx([2 * DUO_0_TO_3[0], *DUO_0_TO_3[:2]], abs=1e-9)


@pytest.mark.parametrize("colocation", [False, True])
def test_agrees_with_trying_every_walk(colocation):
    tight = dict.fromkeys(("infeasible", "delay", "own use", "steps", "capacity"), 0)
    for seed in range(INSTANCES):
        case = tight_case(seed, colocation)
        expected = cheapest_by_trying(case)
        planner = MyopicPlanner()
        assert planned_cost(planner, case) == pytest.approx(expected, abs=1e-9), f"seed {seed}"
        tight["infeasible"] += expected == math.inf
        tight["own use"] += bool(planner.own.critical.tracked[0] > 0)
        tight["delay"] += _changes(case, expected, tables=case.tables._replace(tolerable_delay=np.array([1e9])))
        tight["steps"] += _changes(case, expected, rules=case.rules._replace(max_steps=100))
        free = case._replace(vm_offered=case.tables.vm_capacity[0, :, :, 0], link_offered=case.tables.link_capacity[0])
        tight["capacity"] += _changes(free, expected)
    # Agreement means little where nothing is scarce.
    assert min(tight.values()) >= INSTANCES // 40, tight
    assert tight["infeasible"] <= INSTANCES // 2, tight


def _changes(case: Case, cost: float, **loosened) -> bool:
    """Whether the request becomes cheaper, or feasible, when something is loosened."""
    return planned_cost(MyopicPlanner(), case._replace(**loosened)) < cost - 1e-9


@pytest.mark.parametrize("colocation", [False, True])
def test_any_prices(colocation):
    plan = np.zeros(100, np.int64)
    for seed in range(INSTANCES // 2):
        case = tight_case(seed, colocation)
        rng = np.random.default_rng(seed)
        shape = case.tables.vm_unit_cost[0].shape
        vm_price = rng.uniform(0, 30, shape).round() * rng.integers(0, 2, shape)
        link_price = rng.uniform(0, 30, case.link_offered.shape).round() * rng.integers(0, 2, case.link_offered.shape)
        # Trying every walk takes its costs from the tables.
        priced = case.tables._replace(vm_unit_cost=vm_price[None], link_unit_cost=link_price[None])
        scratch = make_scratch(case.tables)
        steps = plan_cheapest(case.world, 0, Prices(vm_price, link_price), scratch, plan)
        expected = cheapest_by_trying(case._replace(tables=priced))
        assert scratch.result[0] == pytest.approx(expected, abs=1e-9), f"seed {seed}"
        if steps:
            actions = plan[:steps].tolist()
            assert checked_cost(case._replace(tables=priced), actions) == pytest.approx(expected, abs=1e-9)
            assert scratch.result[1] == pytest.approx(checked_cost(case, actions), abs=1e-9)
        else:
            assert (scratch.result == math.inf).all()


@pytest.mark.parametrize("colocation", [False, True])
def test_scratch_grows(colocation):
    plan = np.zeros(100, np.int64)
    overflows = 0
    for seed in range(50):
        case = tight_case(seed, colocation)
        prices = Prices(case.tables.vm_unit_cost[0], case.tables.link_unit_cost[0])
        scratch = make_scratch(case.tables, pool=8, columns=1)
        while (steps := plan_cheapest(case.world, 0, prices, scratch, plan)) == -1:
            scratch = grow_scratch(case.tables, scratch)
            overflows += 1
        cost = checked_cost(case, plan[:steps].tolist()) if steps else math.inf
        assert cost == pytest.approx(planned_cost(MyopicPlanner(), case), abs=1e-9)
    assert overflows > 10


@pytest.mark.parametrize("planner", [MyopicPlanner, PricedPlanner, GreedyPlanner, TabuPlanner])
def test_batch_is_the_same_as_one_by_one(planner):
    case = tight_case(0, True)
    rng = np.random.default_rng(0)
    rows = np.array([0, 2, 3, 5, 6, 7])
    rules = case.rules._replace(max_steps=8)
    world = new_world(case.tables, rules, np.zeros(8, np.int64), 1, 0, False, False)
    world.ledger.vm_offered[..., 0] = (case.vm_offered * rng.random((8, 1, 1))).astype(np.int64)
    world.ledger.link_offered[:] = rng.choice([0, 5_000_000, 8_000_000], (8, case.link_offered.size))
    world.env["ingress"] = rng.integers(0, 3, 8)
    world.env["egress"] = world.env["ingress"] + 1
    plans, lengths = np.full((8, 8), -7), np.full(8, -7)
    planner().plan_rows(world, rows, plans, lengths)
    for b in range(8):
        if b not in rows:
            assert lengths[b] == -7 and (plans[b] == -7).all()
            continue
        ends = (int(world.env["ingress"][b]), int(world.env["egress"][b]))
        alone = Case(case.tables, rules, world.ledger.vm_offered[b, :, :, 0], world.ledger.link_offered[b], 0, *ends)
        assert plans[b, : lengths[b]].tolist() == plan_of(planner(), alone)
        assert (plans[b, lengths[b] :] == -7).all()
    assert 0 < np.sum(lengths > 0) < len(rows)


@njit
def _plan_often(world, prices, scratch, plan, times):
    total = 0
    for _ in range(times):
        total += plan_cheapest(world, 0, prices, scratch, plan)
    return total


def test_compiled_callers_keep_their_arrays():
    """Kernels count no references; code compiled the usual way must be able to call them all the same."""
    case = toy_case(DUO, 0, 3)
    scratch, plan = make_scratch(case.tables), np.zeros(100, np.int64)
    world, prices = case.world, Prices(case.tables.vm_unit_cost[0], case.tables.link_unit_cost[0])
    arguments = (world, prices, scratch, plan)
    assert _plan_often(*arguments, 2) == 6
    watched = [*scratch.labels, *scratch.cost, *case.tables, *world.ledger, world.env, plan]
    before = [sys.getrefcount(array) for array in watched]
    assert _plan_often(*arguments, 500) == 1500
    assert [sys.getrefcount(array) for array in watched] == before


def test_a_search_that_would_take_all_memory_says_so(monkeypatch):
    tables = toy_case(DUO, 0, 3).tables
    grown = grow_scratch(tables, make_scratch(tables))
    assert grown.labels.cost.size == 2 * make_scratch(tables).labels.cost.size
    monkeypatch.setattr(cheapest, "LARGEST", 1 << 20)
    with pytest.raises(ScenarioError, match=r"the exact search of a request needs more than .* use method=greedy"):
        grow_scratch(tables, grown)
