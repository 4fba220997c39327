"""Tight random requests, every walk tried one by one, and a checker of walks; plain Python, no planner code."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.simulator.state import World, new_world
from nfv_torchrl.simulator.tables import Rules, Tables, build_tables

LOADS = {"S": 0.3, "M": 0.7, "L": 1.2}


class Case(NamedTuple):
    """One request in one state of one network."""

    tables: Tables
    rules: Rules
    vm_offered: np.ndarray
    link_offered: np.ndarray
    service: int
    ingress: int
    egress: int

    @property
    def world(self) -> World:
        """One environment at this request, on this network."""
        made = new_world(self.tables, self.rules, np.zeros(1, np.int64), 1, 0, False, False)
        made.ledger.vm_offered[0, :, :, 0], made.ledger.link_offered[0] = self.vm_offered, self.link_offered
        made.env["profile"] = self.service
        for name in ("service", "ingress", "egress"):
            made.env[name] = getattr(self, name)
        return made


def hop_delays(case: Case) -> list[float]:
    """ms of a hop over each link."""
    tables, rate = case.tables, case.tables.rate[case.service, 0]
    return (tables.link_delay[0] + 1000.0 * rate / tables.link_speed[0]).tolist()


def tight_case(seed: int, colocation: bool) -> Case:
    """4 to 6 nodes, a chain of 1 to 4 functions at 4 Mbit/s, links with room for 0, 1 or 2 crossings, VMs for few."""
    rng = np.random.default_rng(seed)
    nodes = int(rng.integers(4, 7))
    substrate = draw_random_substrate(
        nodes,
        seed,
        mean_degree=float(rng.uniform(1.8, 3.2)),
        vms=(1, 3),
        vm_capacity=(5, 30),
        link_capacity=(8, 12),
        link_delay=(0, 200),
        vm_unit_cost=(1, 40),
        link_unit_cost=(1, 20),
    )
    chain = tuple(rng.choice(list(LOADS), size=rng.integers(1, 5)).tolist())
    tolerable = float(rng.choice([1500.0, 2500.0, 4000.0, 8000.0]))
    tables = build_tables([substrate], ServiceCatalogue((ServiceType("tight", chain, 4.0, tolerable),), LOADS))
    exists = tables.vm_capacity[0, :, :, 0] > 0
    vm_offered = np.where(exists, rng.integers(0, 8_000_000, exists.shape), 0)
    vm_offered = np.minimum(vm_offered, tables.vm_capacity[0, :, :, 0])
    # 5 Mbit/s carry one crossing of 4, not two.
    link_offered = rng.choice([0, 5_000_000, 5_000_000, 8_000_000], size=substrate.num_links)
    ingress, egress = rng.choice(nodes, 2, replace=False).tolist()
    rules = Rules(colocation, False, False, int(rng.choice([4, 6, 8])))
    return Case(tables, rules, vm_offered, link_offered, 0, ingress, egress)


def cheapest_by_trying(case: Case, begin: tuple[tuple[int, int, bool], ...] = ()) -> float:
    """Cost of the cheapest walk the step checks let through, inf if there is none: depth first over all walks.

    ``begin``: (node, VM, whether a function is placed) of its first steps; of a step that only forwards the VM is
    nothing.
    """
    tables, rules = case.tables, case.rules
    rate_units, rate = int(tables.rate_units[case.service, 0]), float(tables.rate[case.service, 0])
    chain = int(tables.chain_length[case.service])
    load, load_units = tables.load[case.service, :, 0].tolist(), tables.load_units[case.service, :, 0].tolist()
    budget = float(tables.tolerable_delay[case.service]) + 1e-9
    hop_delay = hop_delays(case)
    around = [[] for _ in range(int(tables.num_nodes[0]))]
    for link, (u, v) in enumerate(tables.link_ends[0, : tables.num_links[0]].tolist()):
        around[u].append((v, link))
        around[v].append((u, link))
    vms = case.vm_offered.tolist()
    links = case.link_offered.tolist()
    best = math.inf

    def walk(node: int, i: int, delay: float, cost: float, steps: int) -> None:
        nonlocal best
        if cost >= best:
            return
        if node == case.egress and i == chain:
            best = cost
            return
        if steps == rules.max_steps:
            return
        if node == case.egress:
            moves = [(node, -1, (True,))]
        else:
            moves = [(there, link, (True, False)) for there, link in around[node]]
            if rules.colocation:
                moves.append((node, -1, (True,)))
        set_step = begin[steps] if steps < len(begin) else None
        for there, link, choices in moves:
            if set_step is not None and there != set_step[0]:
                continue
            hop_cost, hop = 0.0, 0.0
            if link >= 0:
                if links[link] < rate_units:
                    continue
                hop_cost, hop = float(tables.link_unit_cost[0, link]) * rate, hop_delay[link]
                links[link] -= rate_units
            for place in choices:
                if set_step is not None and place != set_step[2]:
                    continue
                if not place:
                    if delay + hop <= budget:
                        walk(there, i, delay + hop, cost + hop_cost, steps + 1)
                    continue
                for vm in range(int(tables.vm_count[0, there])) if i < chain else ():
                    if set_step is not None and vm != set_step[1]:
                        continue
                    took = 1000.0 * load[i] / float(tables.vm_speed[0, there, vm])
                    if vms[there][vm] < load_units[i] or delay + (hop + took) > budget:
                        continue
                    vms[there][vm] -= load_units[i]
                    price = float(tables.vm_unit_cost[0, there, vm, 0]) * load[i]
                    walk(there, i + 1, delay + (hop + took), cost + hop_cost + price, steps + 1)
                    vms[there][vm] += load_units[i]
            if link >= 0:
                links[link] += rate_units

    walk(case.ingress, 0, 0.0, 0.0, 0)
    return best


def checked_cost(case: Case, plan: list[int]) -> float:
    """Cost of a plan after asserting that every step of it is a possible action and passes its checks."""
    tables, rules = case.tables, case.rules
    vms, links = case.vm_offered.copy(), case.link_offered.copy()
    slots = vms.shape[1]
    ends = {}
    for link, (u, v) in enumerate(tables.link_ends[0, : tables.num_links[0]].tolist()):
        ends[u, v] = ends[v, u] = link
    chain = int(tables.chain_length[case.service])
    node, i, delay, cost = case.ingress, 0, 0.0, 0.0
    assert len(plan) <= rules.max_steps
    for action in plan:
        assert not (node == case.egress and i == chain), "steps after the end"
        there, vm, place = action // (2 * slots), action // 2 % slots, action % 2 == 1
        assert vm < tables.vm_count[0, there]
        step = 0.0
        if there == node:
            assert place, "a self-hop places"
            assert node == case.egress or rules.colocation
        else:
            assert node != case.egress, "the walk never leaves the egress"
            link = ends[node, there]
            links[link] -= tables.rate_units[case.service, 0]
            assert links[link] >= 0
            step += hop_delays(case)[link]
            cost += tables.link_unit_cost[0, link] * tables.rate[case.service, 0]
        if place:
            assert i < chain
            vms[there, vm] -= tables.load_units[case.service, i, 0]
            assert vms[there, vm] >= 0
            step += 1000.0 * tables.load[case.service, i, 0] / tables.vm_speed[0, there, vm]
            cost += tables.vm_unit_cost[0, there, vm, 0] * tables.load[case.service, i, 0]
            i += 1
        delay += step
        assert delay <= tables.tolerable_delay[case.service] + 1e-9
        node = there
    assert node == case.egress
    assert i == chain
    return cost


def plan_of(planner, case: Case) -> list[int]:
    """Actions of the planner's answer, none if it has no embedding."""
    plans, lengths = np.full((1, case.rules.max_steps), -1), np.zeros(1, np.int64)
    world = case.world
    planner.prepare(world)
    planner.plan_rows(world, np.zeros(1, np.int64), plans, lengths)
    assert lengths[0] == 0 or (plans[0, lengths[0] :] == -1).all()
    return plans[0, : lengths[0]].tolist()


def planned_cost(planner, case: Case) -> float:
    """Checked cost of the planner's answer, inf if it has none."""
    plan = plan_of(planner, case)
    return checked_cost(case, plan) if plan else math.inf
