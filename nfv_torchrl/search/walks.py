"""One request on one network as the compiled planners see it, and the walks they make of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.simulator.compiled import inlined
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits, link_cost, link_delay, vm_cost, vm_delay
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

OVERFLOW = -1
"""What a search returns when its scratch arrays are too small: grow them and call again."""
CUT_SHORT = -2
"""What a search returns when the request has used all the labels that it may."""


class Problem(NamedTuple):
    """One request (section "Problem Formulation" of the paper) and what the network offers it.

    Arrays are views of the simulator's tables and of the caller's prices; ledger units are bit/s and cycles/s. R kinds
    of resources, F functions; entries past the chain's end are unused.
    """

    net: int  # row of the tables
    nodes: int
    links: int
    functions: int
    kinds: int
    ingress: int  # -1: free
    egress: int  # -1: free
    colocation: bool
    distinct: bool
    full_duplex: bool  # directions of a link are links of their own, 2 l and 2 l + 1
    one_rate: bool  # whether all segments have the same rate
    budget: float  # ms, tolerable delay plus the tolerance of sums
    max_steps: int
    rate: np.ndarray  # float64 [F + 1], Mbit/s
    rate_units: np.ndarray  # int64 [F + 1]
    load: np.ndarray  # float64 [F, R], Mcycles/s or the unit of the kind
    load_units: np.ndarray  # int64 [F, R]
    work: np.ndarray  # float64 [F], Mcycles/s
    fixed_delay: np.ndarray  # float64 [F], ms
    degree: np.ndarray  # int64 [N]
    neighbour: np.ndarray  # int32 [N, D]
    neighbour_link: np.ndarray  # int32 [N, D]
    vm_count: np.ndarray  # int64 [N]
    vm_speed: np.ndarray  # float64 [N, V], Mcycles/s
    link_delay: np.ndarray  # float64 [L], ms, propagation
    link_speed: np.ndarray  # float64 [L], Mbit/s
    delay_to: np.ndarray  # float64 [N, N], ms: least sum of hop delays at the least rate, capacities ignored
    vm_offered: np.ndarray  # int64 [N, V, R]
    link_offered: np.ndarray  # int64 [L]
    vm_price: np.ndarray  # float64 [N, V, R], $ per unit
    link_price: np.ndarray  # float64 [L], $ per Mbit/s


class Prices(NamedTuple):
    """What an embedding is charged by: the unit costs of a network, or any other non-negative numbers."""

    vm: np.ndarray  # float64 [N, V, R], $ per unit of each kind
    link: np.ndarray  # float64 [L], $ per Mbit/s


@by_reference
class PlannedWalk(NamedTuple):
    """Steps of a walk, int64 [J] each: node gone to, link used (-1: none), VM placed on (-1: only forwarded)."""

    node: np.ndarray
    link: np.ndarray
    vm: np.ndarray


def make_walk(steps: int) -> PlannedWalk:
    """Room for a walk of ``steps`` steps."""
    return PlannedWalk(np.zeros(steps, np.int64), np.zeros(steps, np.int64), np.zeros(steps, np.int64))


@inlined
def unit_costs(world, b):
    """The unit costs of environment b's network."""
    net = world.env[b].net
    return Prices(world.tables.vm_unit_cost[net], world.tables.link_unit_cost[net])


@inlined
def make_problem(world, b, prices):
    """Collect the request of environment b, and what its network offers now, into a ``Problem``."""
    tables, rules, e = world.tables, world.rules, world.env[b]
    net, profile = e.net, e.profile
    functions = tables.chain_length[profile]
    one_rate = True
    for segment in range(functions):
        one_rate = one_rate and tables.rate[profile, segment] == tables.rate[profile, segment + 1]
    return Problem(
        net,
        tables.num_nodes[net],
        tables.num_links[net],
        functions,
        tables.load.shape[2],
        e.ingress,
        e.egress,
        rules.colocation,
        rules.distinct,
        tables.full_duplex,
        one_rate,
        tables.tolerable_delay[profile] + DELAY_TOLERANCE,
        e.most_steps,
        tables.rate[profile],
        tables.rate_units[profile],
        tables.load[profile],
        tables.load_units[profile],
        tables.work[profile],
        tables.fixed_delay[profile],
        tables.degree[net],
        tables.neighbour[net],
        tables.neighbour_link[net],
        tables.vm_count[net],
        tables.vm_speed[net],
        tables.link_delay[net],
        tables.link_speed[net],
        tables.delay_to[net, tables.least_rate[profile]],
        world.ledger.vm_offered[b],
        world.ledger.link_offered[b],
        prices.vm,
        prices.link,
    )


@inlined
def link_fits(problem, link, i):
    """Whether a link has room for segment ``i`` once."""
    return fits(problem.link_offered[link], problem.rate_units[i])


@inlined
def hop_cost(problem, link, i):
    """$ of a hop with segment ``i``, at the problem's prices."""
    return link_cost(problem.link_price[link], problem.rate[i])


@inlined
def hop_delay(problem, link, i):
    """ms of a hop with segment ``i``."""
    return link_delay(problem.link_delay[link], problem.rate[i], problem.link_speed[link])


@inlined
def vm_fits(problem, node, vm, i):
    """Whether a VM has room for function ``i`` once."""
    room = True
    for kind in range(problem.kinds):
        room = room and fits(problem.vm_offered[node, vm, kind], problem.load_units[i, kind])
    return room


@inlined
def place_cost(problem, node, vm, i):
    """$ of function ``i`` on a VM, at the problem's prices."""
    cost = vm_cost(problem.vm_price[node, vm, 0], problem.load[i, 0])
    for kind in range(1, problem.kinds):
        cost += vm_cost(problem.vm_price[node, vm, kind], problem.load[i, kind])
    return cost


@inlined
def cheaper(problem, node, vm, other, i):
    """Whether function ``i`` is cheaper on ``vm`` than on ``other``, both of ``node``."""
    if problem.kinds == 1:
        return problem.vm_price[node, vm, 0] < problem.vm_price[node, other, 0]
    return place_cost(problem, node, vm, i) < place_cost(problem, node, other, i)


@inlined
def place_delay(problem, node, vm, i):
    """ms that function ``i`` takes on a VM."""
    return problem.fixed_delay[i] + vm_delay(problem.work[i], problem.vm_speed[node, vm])


@inlined
def ends_at(problem, node):
    """Whether a walk whose functions are all placed is complete on ``node``."""
    return problem.egress < 0 or node == problem.egress


@inlined
def may_stay(problem, node, i):
    """Whether function ``i`` may be placed on ``node`` without a hop, by a search that misses nothing better.

    With ``distinct`` only the first may: to stay for a later one is to have come by a hop that could have placed it.
    """
    if problem.distinct:
        return i == 0
    return problem.colocation or node == problem.egress


@inlined
def may_leave(problem, node, i):
    """Whether a walk with ``i`` functions placed may go on from ``node``: with ``distinct`` also through the egress."""
    return node != problem.egress or (problem.distinct and i < problem.functions)


@inlined
def with_excess(problem, violation, delay, steps):
    """``violation`` and what a walk of that delay (ms) and so many steps has of each beyond what it may have."""
    if delay > problem.budget:
        violation += delay / problem.budget - 1.0
    if steps > problem.max_steps:
        violation += steps - problem.max_steps
    return violation


@inlined
def encode_walk(walk, steps, vms, plan):
    """Write the actions of ``walk`` into ``plan``; a forwarding hop names VM 0."""
    for j in range(steps):
        places = walk.vm[j] >= 0
        plan[j] = encode_action(walk.node[j], walk.vm[j] if places else 0, places, vms)


@inlined
def walk_totals(problem, prices, walk, steps):
    """Cost ($, at the given prices) and delay (ms) of a walk, summed in the order of its steps."""
    cost = 0.0
    delay = 0.0
    i = 0
    for j in range(steps):
        step_delay = 0.0
        if walk.link[j] >= 0:
            cost += link_cost(prices.link[walk.link[j]], problem.rate[i])
            step_delay = hop_delay(problem, walk.link[j], i)
        if walk.vm[j] >= 0:
            node, vm = walk.node[j], walk.vm[j]
            for kind in range(problem.kinds):
                cost += vm_cost(prices.vm[node, vm, kind], problem.load[i, kind])
            step_delay += place_delay(problem, node, vm, i)
            i += 1
        delay += step_delay
    return cost, delay
