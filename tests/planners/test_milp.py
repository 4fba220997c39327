"""The integer programmes against the exact label search, against every walk tried one by one, and by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from exhaustive import Case, cheapest_by_trying, checked_cost, hop_delays, plan_of, planned_cost, tight_case
from tight_instances import tight_instance

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.milp import MilpPlanner, Request, embed_request, embed_slot
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.simulator.state import new_world
from nfv_torchrl.simulator.tables import Rules, build_tables

TIGHT_INSTANCES = 200


def solved(case: Case, form: str = "walk"):
    return embed_request(case.world, 0, form)


@pytest.mark.parametrize("colocation", [False, True])
def test_agrees_with_the_label_search_on_200_tight_instances(colocation):
    milp, labels = MilpPlanner(), MyopicPlanner()
    costs = []
    for seed in range(TIGHT_INSTANCES):
        case = tight_instance(seed, colocation)
        costs.append((planned_cost(milp, case), planned_cost(labels, case)))
    ours, theirs = np.array(costs).T
    feasible = np.isfinite(theirs)
    assert np.array_equal(np.isfinite(ours), feasible)
    assert 0.3 < feasible.mean() < 0.95, "the instances are tight, not hopeless"
    np.testing.assert_allclose(ours[feasible], theirs[feasible], rtol=0, atol=1e-6)


@pytest.mark.parametrize("colocation", [False, True])
def test_agrees_with_trying_every_walk(colocation):
    for seed in range(40):
        case = tight_case(seed, colocation)
        ours, best = planned_cost(MilpPlanner(), case), cheapest_by_trying(case)
        assert ours == pytest.approx(best, abs=1e-6), f"seed {seed}"


@pytest.mark.parametrize("colocation", [False, True])
def test_the_problem_is_never_costlier_than_a_walk_and_sometimes_cheaper(colocation):
    cheaper = 0
    for seed in range(60):
        case = tight_instance(seed, colocation)
        walk, free = solved(case), solved(case, "problem")
        if walk is not None:
            assert free is not None
            assert free.cost <= walk.cost + 1e-6
        cheaper += free is not None and (walk is None or free.cost < walk.cost - 1e-6)
    assert cheaper > 0


def test_what_is_late_by_less_than_the_solver_sees_is_not_taken():
    """HiGHS lets a row be exceeded by 1e-6; a walk that is 3e-7 ms late is still late."""
    checked = 0
    for seed in range(30):
        case = tight_instance(seed, True)
        found = solved(case)
        if found is None:
            continue
        late = case._replace(tables=case.tables._replace(tolerable_delay=np.array([found.delay - 3e-7])))
        again = solved(late)
        assert again is None or again.delay <= found.delay - 3e-7 + 1e-9
        expected = planned_cost(MyopicPlanner(), late)
        assert (math.inf if again is None else again.cost) == pytest.approx(expected, abs=1e-6)
        checked += 1
    assert checked > 5


def line_network(*, chain=("A", "B"), tau=1000.0, capacities=(5.0, 5.0, 100.0), link_capacity=10.0):
    """0 -- 1 -- 2, one VM a node of $1, $2, $3 per Mcycles/s; both links $1 per Mbit/s; 1 Mbit/s, A = 10, B = 20."""
    substrate = Substrate(
        name="line",
        labels=("0", "1", "2"),
        vm_count=np.array([1, 1, 1]),
        vm_capacity=np.array(capacities)[:, None],
        vm_unit_cost=np.array([[1.0], [2.0], [3.0]]),
        links=np.array([[0, 1], [1, 2]]),
        link_capacity=np.full(2, link_capacity),
        link_delay=np.full(2, 10.0),
        link_unit_cost=np.ones(2),
    )
    catalogue = ServiceCatalogue((ServiceType("s", chain, 1.0, tau),), {"A": 10.0, "B": 20.0})
    return build_tables([substrate], catalogue)


def case_of(tables, colocation: bool, request: tuple[int, int, int], max_steps: int = 100) -> Case:
    """A request on the empty network."""
    offered = tables.vm_capacity[0, :, :, 0].copy(), tables.link_capacity[0].copy()
    return Case(tables, Rules(colocation, False, False, max_steps), *offered, *request)


def test_a_chain_through_the_egress_and_back_by_hand():
    """From 0 to 1 with room at 2 alone: A and B cost 30 * $3, links 0-1, 1-2, 2-1 $1 each. No walk passes node 1."""
    tables = line_network()
    case = case_of(tables, True, (0, 0, 1))
    assert solved(case) is None
    found = solved(case, "problem")
    assert found.cost == pytest.approx(93.0)
    # Each link 10 + 100 ms; A 1000 * 10 / 100 = 100 ms, B 200 ms.
    assert found.delay == pytest.approx(630.0)
    assert found.placements == ((2, 0), (2, 0))
    assert found.steps == ((1, 0, None), (2, 0, None), (2, 0, 0), (2, 0, 1), (1, 0, None))


def test_a_walk_without_colocation_bounces_by_hand():
    """From 0 to 2, room at 0 and 1. One function a hop, so the cheap VM at 0 is visited twice, by way of node 1.

    A 10 + B 20 + 6 crossings = 36, of link 0-1 five; colocated at the ingress 10 + 20 + 2 = 32.
    """
    tables = line_network(capacities=(100.0, 100.0, 5.0))
    walk = solved(case_of(tables, False, (0, 0, 2)))
    assert walk.cost == pytest.approx(36.0)
    assert walk.steps == ((1, 0, None), (0, 0, 0), (1, 0, None), (0, 0, 1), (1, 0, None), (2, 0, None))
    assert walk.actions(1).tolist() == [2, 1, 2, 1, 2, 4]
    colocated = solved(case_of(tables, True, (0, 0, 2)))
    assert colocated.cost == pytest.approx(32.0)
    assert colocated.steps == ((0, 0, 0), (0, 0, 1), (1, 0, None), (2, 0, None))
    short = solved(case_of(tables, True, (0, 0, 2), max_steps=3))
    assert short.cost == pytest.approx(52.0)  # A at 0 ($10), hop to 1 with B ($40), on to 2: $2 of links
    assert solved(case_of(tables, False, (0, 0, 2), max_steps=3)) is None


@pytest.mark.parametrize(("room", "cost"), [(5_000_000, 36.0), (4_999_999, 44.0), (3_000_000, 44.0), (2_999_999, None)])
def test_every_crossing_of_a_link_takes_room(room, cost):
    """As above; with room for three crossings A goes to 1 ($20), B to 0 ($20), and 4 links are crossed in all."""
    tables = line_network(capacities=(100.0, 100.0, 5.0))
    case = case_of(tables, False, (0, 0, 2))
    case.link_offered[0] = room
    found = solved(case)
    assert (None if found is None else found.cost) == (None if cost is None else pytest.approx(cost))


def test_a_slot_is_admitted_together_by_hand():
    """Two of "A" from 0 to 2, and one from 1 to 2, where node 0 and 1 have room for one each.

    One by one the first two take the cheap VMs; the third can still use the egress, where room for one is left.
    """
    tables = line_network(chain=("A",), tau=2000.0, capacities=(10.0, 10.0, 10.0))
    case = case_of(tables, True, (0, 0, 2))
    requests = [Request(0, 0, 2), Request(0, 1, 2), Request(0, 0, 2)]
    found = embed_slot(case.world, 0, requests)
    # VMs 10 + 20 + 30, links 2 + 1 + 2: no other assignment is cheaper, as links cost the same for all.
    assert sum(e.cost for e in found) == pytest.approx(65.0)
    case.vm_offered[2] = 0
    found = embed_slot(case.world, 0, requests)
    assert sum(e is not None for e in found) == 2
    # The dearest to serve is left out: 10 + 20 of VMs, and the request from 1 crosses one link less.
    assert sum(e.cost for e in found if e) == pytest.approx(33.0)


def all_walks(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Cost [W] and use of every VM and link [W, resources], in ledger units, of every walk that passes its checks."""
    walks = []
    tables, slots = case.tables, case.vm_offered.shape[1]

    def go(node, i, delay, cost, use, steps):
        if node == case.egress and i == tables.chain_length[case.service]:
            walks.append((cost, use))
            return
        if steps == case.rules.max_steps:
            return
        moves = [(node, -1)] if node == case.egress or case.rules.colocation else []
        if node != case.egress:
            moves += [
                (int(tables.neighbour[0, node, d]), int(tables.neighbour_link[0, node, d]))
                for d in range(tables.degree[0, node])
            ]
        for there, link in moves:
            for vm in ([] if link < 0 else [-1]) + list(range(tables.vm_count[0, there])):
                new = use.copy()
                step, price = 0.0, 0.0
                if link >= 0:
                    new[case.vm_offered.size + link] += tables.rate_units[case.service, 0]
                    step += hop_delays(case)[link]
                    price += tables.link_unit_cost[0, link] * tables.rate[case.service, 0]
                if vm >= 0:
                    if i == tables.chain_length[case.service]:
                        continue
                    new[there * slots + vm] += tables.load_units[case.service, i, 0]
                    step += 1000.0 * tables.load[case.service, i, 0] / tables.vm_speed[0, there, vm]
                    price += tables.vm_unit_cost[0, there, vm, 0] * tables.load[case.service, i, 0]
                late = delay + step > tables.tolerable_delay[case.service] + 1e-9
                if not late and np.all(new <= room):
                    go(there, i + (vm >= 0), delay + step, cost + price, new, steps + 1)

    room = np.r_[case.vm_offered.ravel(), case.link_offered]
    go(case.ingress, 0, 0.0, 0.0, np.zeros(room.size, np.int64), 0)
    return np.array([cost for cost, _ in walks]), np.array([use for _, use in walks]).reshape(-1, room.size)


@pytest.mark.parametrize("colocation", [False, True])
def test_two_requests_together_against_all_pairs_of_walks(colocation):
    both = 0
    for seed in range(25):
        case = tight_case(1000 + seed, colocation)
        case = case._replace(rules=case.rules._replace(max_steps=4))
        other = case._replace(ingress=case.egress, egress=case.ingress)
        room = np.r_[case.vm_offered.ravel(), case.link_offered]
        (cost_a, use_a), (cost_b, use_b) = all_walks(case), all_walks(other)
        fits = [(a, b) for a, b in itertools.product(range(cost_a.size), range(cost_b.size))]
        pair_cost = min(
            (cost_a[a] + cost_b[b] for a, b in fits if np.all(use_a[a] + use_b[b] <= room)), default=math.inf
        )
        single = min([*cost_a, *cost_b], default=math.inf)
        requests = [Request(0, c.ingress, c.egress) for c in (case, other)]
        found = embed_slot(case.world, 0, requests)
        accepted = [e for e in found if e is not None]
        expected = 2 if math.isfinite(pair_cost) else int(math.isfinite(single))
        assert len(accepted) == expected
        if expected:
            assert sum(e.cost for e in accepted) == pytest.approx(pair_cost if expected == 2 else single, abs=1e-6)
        for one, embedding in zip((case, other), found, strict=True):
            if embedding is not None:
                assert checked_cost(one, embedding.actions(case.vm_offered.shape[1]).tolist()) == pytest.approx(
                    embedding.cost
                )
        both += expected == 2
    assert both > 3


def test_a_batch_is_planned_row_by_row():
    case = tight_case(3, True)
    world = new_world(case.tables, case.rules, np.zeros(3, np.int64), 1, 0, False, False)
    world.ledger.vm_offered[..., 0], world.ledger.link_offered[:] = case.vm_offered, case.link_offered
    world.env["service"], world.env["ingress"], world.env["egress"] = case.service, case.ingress, case.egress
    plans, lengths = np.full((3, case.rules.max_steps), -1), np.full(3, -7)
    MilpPlanner().plan_rows(world, np.array([0, 2]), plans, lengths)
    alone = plan_of(MilpPlanner(), case)
    assert lengths.tolist() == [len(alone), -7, len(alone)]
    assert plans[2, : lengths[2]].tolist() == alone


def test_ingress_and_egress_may_be_one_node():
    """From 1 to 1: without leaving it, A and B stand on VMs of node 1, 10 and 20 Mcycles/s at $2."""
    tables = line_network(capacities=(100.0, 100.0, 5.0))
    for form in ("walk", "problem"):
        found = embed_slot(case_of(tables, False, (0, 1, 1)).world, 0, [Request(0, 1, 1)], form)[0]
        assert found.placements == ((1, 0), (1, 0)) or form == "problem"
        assert found.cost == pytest.approx(60.0 if form == "walk" else 32.0)  # on node 0, there and back


def test_bad_input_is_refused():
    world = case_of(line_network(), True, (0, 0, 1)).world
    with pytest.raises(ScenarioError, match="unknown form"):
        embed_request(world, 0, "paper")
    assert embed_slot(world, 0, []) == []
