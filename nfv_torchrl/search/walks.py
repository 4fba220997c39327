"""One request on one network as the compiled planners see it, and the walks they make of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.simulator.compiled import inlined
from nfv_torchrl.simulator.steps import link_cost, vm_cost, vm_delay
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

OVERFLOW = -1
"""What a search returns when its scratch arrays are too small: grow them and call again."""


class Problem(NamedTuple):
    """One request (section "Problem Formulation" of the paper) and what the network offers it.

    Arrays are views of the simulator's tables and of the caller's prices; ledger units are bit/s and cycles/s.
    """

    net: int  # row of the tables
    nodes: int
    links: int
    functions: int
    ingress: int
    egress: int
    colocation: bool
    budget: float  # ms, tolerable delay plus the tolerance of sums
    max_steps: int
    rate: float  # Mbit/s
    rate_units: int
    load: np.ndarray  # float64 [F], Mcycles/s
    load_units: np.ndarray  # int64 [F]
    degree: np.ndarray  # int64 [N]
    neighbour: np.ndarray  # int32 [N, D]
    neighbour_link: np.ndarray  # int32 [N, D]
    vm_count: np.ndarray  # int64 [N]
    vm_speed: np.ndarray  # float64 [N, V], Mcycles/s
    hop_delay: np.ndarray  # float64 [L], ms
    delay_to: np.ndarray  # float64 [N, N], ms: least sum of hop delays, capacities ignored
    vm_offered: np.ndarray  # int64 [N, V]
    link_offered: np.ndarray  # int64 [L]
    vm_price: np.ndarray  # float64 [N, V], $ per Mcycles/s
    link_price: np.ndarray  # float64 [L], $ per Mbit/s


class Prices(NamedTuple):
    """What an embedding is charged by: the unit costs of a network, or any other non-negative numbers."""

    vm: np.ndarray  # float64 [N, V], $ per Mcycles/s
    link: np.ndarray  # float64 [L], $ per Mbit/s


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
    net, service = e.net, e.service
    return Problem(
        net,
        tables.num_nodes[net],
        tables.num_links[net],
        tables.chain_length[service],
        e.ingress,
        e.egress,
        rules.colocation,
        tables.tolerable_delay[service] + DELAY_TOLERANCE,
        rules.max_steps,
        tables.rate[service],
        tables.rate_units[service],
        tables.load[service],
        tables.load_units[service],
        tables.degree[net],
        tables.neighbour[net],
        tables.neighbour_link[net],
        tables.vm_count[net],
        tables.vm_speed[net],
        tables.hop_delay[net, service],
        tables.delay_to[net, service],
        world.ledger.vm_offered[b],
        world.ledger.link_offered[b],
        prices.vm,
        prices.link,
    )


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
            cost += link_cost(prices.link[walk.link[j]], problem.rate)
            step_delay = problem.hop_delay[walk.link[j]]
        if walk.vm[j] >= 0:
            node, vm = walk.node[j], walk.vm[j]
            cost += vm_cost(prices.vm[node, vm], problem.load[i])
            step_delay += vm_delay(problem.load[i], problem.vm_speed[node, vm])
            i += 1
        delay += step_delay
    return cost, delay
