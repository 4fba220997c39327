"""Prices that rise with use, and refusal of what is too dear."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exhaustive import Case, cheapest_by_trying, plan_of, planned_cost, tight_case
from toy import DUO, action, toy_catalogue, toy_substrate

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners import MyopicPlanner, PricedPlanner
from nfv_torchrl.planners.priced import PriceRule, fill_prices
from nfv_torchrl.search.walks import Prices
from nfv_torchrl.simulator.tables import Rules, build_tables


def test_price_of_a_resource():
    tables = build_tables([toy_substrate()], toy_catalogue())
    vm_offered, link_offered = tables.vm_capacity[0, :, :, 0].copy(), tables.link_capacity[0].copy()
    vm_offered[0, 0] //= 2
    link_offered[3] = 0
    vm_price, link_price = np.zeros((4, 2, 1)), np.zeros(5)
    case = Case(tables, Rules(False, False, False, 100), vm_offered, link_offered, DUO, 0, 3)
    fill_prices(case.world, 0, PriceRule(100.0, 3001.0, math.inf), Prices(vm_price, link_price))
    # Half used: 3 + 100 * (sqrt(3001) - 1) / 3000; empty: the unit cost; used up: the unit cost plus p.
    assert vm_price[0, 0, 0] == pytest.approx(3.0 + (math.sqrt(3001.0) - 1.0) / 30.0)
    assert vm_price[1, :, 0].tolist() == [1.0, 5.0]
    assert link_price == pytest.approx([2.0, 1.0, 1.0, 104.0, 2.0])


@pytest.mark.parametrize("colocation", [False, True])
def test_without_a_price_it_is_myopic(colocation):
    for seed in range(100):
        case = tight_case(seed, colocation)
        assert planned_cost(PricedPlanner(price=0.0), case) == planned_cost(MyopicPlanner(), case)


@pytest.mark.parametrize("colocation", [False, True])
def test_minimises_the_priced_cost(colocation):
    dearer = 0
    for seed in range(100):
        case = tight_case(seed, colocation)
        vm_price, link_price = np.zeros((*case.vm_offered.shape, 1)), np.zeros(case.link_offered.shape)
        fill_prices(case.world, 0, PriceRule(50.0, 20.0, math.inf), Prices(vm_price, link_price))
        priced = case.tables._replace(vm_unit_cost=vm_price[None], link_unit_cost=link_price[None])
        planner = PricedPlanner(price=50.0, steepness=20.0)
        cost = planned_cost(planner, case)
        assert planner.own.search.result[0] == pytest.approx(cheapest_by_trying(case._replace(tables=priced)), abs=1e-9)
        dearer += cost > planned_cost(MyopicPlanner(), case) + 1e-9
    assert dearer > 10


def test_refuses_what_is_too_dear():
    """Nothing is used, so the price of the cheapest walk is its cost, $55."""
    tables = build_tables([toy_substrate()], toy_catalogue())
    rules = Rules(False, False, False, 100)
    case = Case(tables, rules, tables.vm_capacity[0, :, :, 0].copy(), tables.link_capacity[0].copy(), DUO, 0, 3)
    assert plan_of(PricedPlanner(admit_threshold=54.9), case) == []
    assert plan_of(PricedPlanner(admit_threshold=55.1), case) == [action(1, 0, True), action(2, 0, True), action(3)]


@pytest.mark.parametrize(
    "arguments", [{"price": -1.0}, {"price": math.nan}, {"steepness": 1.0}, {"admit_threshold": -1.0}]
)
def test_bad_parameters(arguments):
    with pytest.raises(ScenarioError, match=next(iter(arguments))):
        PricedPlanner(**arguments)
