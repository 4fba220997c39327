"""Plans of NFVdeep: every step check lets them through; backtracking, routes and limits by hand."""

from __future__ import annotations

import math

import pytest
import torch
from choosing import HASHED, LAST, actor_of
from exhaustive import Case, cheapest_by_trying, plan_of, planned_cost, tight_case
from toy import DUO, action, toy_scenario

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.nfvdeep import NFVdeepEnv, NFVdeepPlanner
from nfv_torchrl.simulator import Simulator


@pytest.mark.parametrize("colocation", [False, True])
@pytest.mark.parametrize("route", ["delay", "cost"])
def test_plans_pass_every_check(route, colocation):
    planner = NFVdeepPlanner(HASHED, route=route, backtracks=50)
    found = possible = 0
    for seed in range(120):
        case = tight_case(seed, colocation)
        cost, least = planned_cost(planner, case), cheapest_by_trying(case)
        assert cost >= least - 1e-9
        found += cost < math.inf
        possible += least < math.inf
    assert found > 0.6 * possible  # backtracking finds most of what there is


def offered(**vms: int):
    """What the toy network offers: capacities, but for the VMs given as n0v1=Mcycles/s."""
    tables = Simulator(toy_scenario(), 1).tables
    vm_offered = tables.vm_capacity[0, :, :, 0].copy()
    for name, value in vms.items():
        node, vm = name[1:].split("v")
        vm_offered[int(node), int(vm)] = value * 1_000_000
    return tables, vm_offered, tables.link_capacity[0].copy()


def plan(planner, *, colocation=False, max_steps=100, links=None, **vms):
    tables, vm_offered, link_offered = offered(**vms)
    for link, value in (links or {}).items():
        link_offered[link] = value * 1_000_000
    rules = Simulator(toy_scenario(colocation=colocation, max_steps=max_steps), 1).world.rules
    return plan_of(planner, Case(tables, rules, vm_offered, link_offered, DUO, 0, 3))


def test_backtracking_by_hand():
    # Node 3 has room for A (10 on 3.1) and then none for B (20): A on 3 is undone and 3 ruled out for it. Next is A
    # on 2, reached through 1 (110 + 55 ms); B on 1: its cheap VM would take 500 ms, too long, so 1.1.
    full = {"n3v0": 0, "n3v1": 10}
    expected = [action(1), action(2, 0, True), action(1, 1, True), action(2), action(3)]
    assert plan(NFVdeepPlanner(LAST, backtracks=1), **full) == expected
    assert plan(NFVdeepPlanner(LAST, backtracks=0), **full) == []


def test_the_egress_takes_the_rest():
    # 110 + 55 + 130 ms to the egress, A on its cheaper VM (500 ms), B where it is done in time (250 ms): 1045 of 1050.
    walk = [action(1), action(2)]
    assert plan(NFVdeepPlanner(LAST)) == [*walk, action(3, 0, True), action(3, 1, True)]


def test_a_route_avoids_full_links():
    # Without link 1-2 the way to 3 by delay is 0-2-3 (350 ms). Both functions there would take 350 + 500 + 250 ms, so A
    # is undone and goes to 2 (220 + 200 ms), B to 3.1 (130 + 250 ms).
    assert plan(NFVdeepPlanner(LAST), links={2: 0}) == [action(2, 0, True), action(3, 1, True)]


def test_steps_are_limited():
    assert plan(NFVdeepPlanner(LAST, backtracks=9), max_steps=4) != []
    assert plan(NFVdeepPlanner(LAST, backtracks=9), max_steps=1) == []


def test_colocation_allows_the_same_node_twice():
    here = actor_of(lambda seen, mask: mask[:, :-1].to(torch.int64).argmax(-1))
    assert plan(NFVdeepPlanner(here), colocation=True)[0] == action(0, 0, True)
    assert plan(NFVdeepPlanner(here))[0] != action(0, 0, True)


def test_refusing_is_the_planners_to_allow():
    refuse = actor_of(lambda seen, mask: torch.full((len(mask),), mask.shape[1] - 1))
    assert plan(NFVdeepPlanner(refuse, may_refuse=True)) == []
    env = NFVdeepEnv(toy_scenario(), 2)
    assert not env.reset()["action_mask"][:, -1].any()
    env = NFVdeepEnv(toy_scenario(), 2, planner=NFVdeepPlanner(may_refuse=True))
    assert env.reset()["action_mask"][:, -1].all()


def test_bad_options_are_named():
    with pytest.raises(ScenarioError, match="route"):
        NFVdeepPlanner(route="scenic")
    with pytest.raises(ScenarioError, match="backtracks"):
        NFVdeepPlanner(backtracks=-1)
    with pytest.raises(ScenarioError, match="follow"):
        plan(NFVdeepPlanner())
