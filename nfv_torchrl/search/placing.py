"""Embeddings along one simple path: where functions may stand, what they cost, and the walk they make.

A place is a position of the path (0 the ingress, ``hops`` the egress) and a VM of the node there. Positions of a chain
never fall. Without colocation each node but the egress takes one function and the ingress none, because a function is
placed with the hop into a node. Where functions must not meet every node of the path takes one, the ends included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.paths import Candidates, Pair, Paths, grow_paths, make_candidates, make_paths, paths_between
from nfv_torchrl.search.walks import (
    OVERFLOW,
    PlannedWalk,
    Prices,
    encode_walk,
    hop_cost,
    hop_delay,
    link_fits,
    make_walk,
    place_cost,
    place_delay,
    walk_totals,
    with_excess,
)
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import Tables


@by_reference
class Placing(NamedTuple):
    """What ``greedy`` and ``tabu`` write to while they work; one for each thread."""

    paths: Paths
    candidates: Candidates
    link_cost: np.ndarray  # float64 [k], $, of each path for the request in hand
    link_delay: np.ndarray  # float64 [k], ms
    lacking: np.ndarray  # int64 [k], links that cannot carry the request
    position: np.ndarray  # int64 [k + 2, F], placement on each path; the last two rows are for callers
    vm: np.ndarray  # int64 [k + 2, F]
    used: np.ndarray  # int64 [V, R]
    hopeless: np.ndarray  # bool [k], paths that cannot hold the chain in order, however large their VMs
    walk: PlannedWalk


def make_placing(tables: Tables, paths: int) -> Placing:
    """Scratch for placements on ``paths`` paths a pair of nodes."""
    nodes, vms, kinds = tables.vm_capacity.shape[1:]
    functions = tables.load.shape[1]
    return Placing(
        paths=make_paths(tables, paths),
        candidates=make_candidates(tables, paths),
        link_cost=np.zeros(paths),
        link_delay=np.zeros(paths),
        lacking=np.zeros(paths, np.int64),
        position=np.zeros((paths + 2, functions), np.int64),
        vm=np.zeros((paths + 2, functions), np.int64),
        used=np.zeros((vms, kinds), np.int64),
        hopeless=np.zeros(paths, np.bool_),
        walk=make_walk(nodes + functions),
    )


def grow_placing(placing: Placing) -> Placing:
    """Twice the room for paths."""
    return placing._replace(paths=grow_paths(placing.paths))


@part
def node_at(problem, paths, number, position):
    """Node at ``position`` of path ``number``."""
    if position == 0:
        return problem.ingress
    return paths.node[paths.start[number] + position - 1]


@part
def first_position(problem, hops, before):
    """First position that may take the function after the one at ``before`` (-1: the chain's first function)."""
    if problem.colocation:
        return max(before, 0)
    if problem.distinct:
        return before + 1
    return min(max(before, 0) + 1, hops)


@part
def last_position(problem, hops, i):
    """Last position for function ``i`` that leaves room for those after it."""
    return hops - (problem.functions - 1 - i) if problem.distinct else hops


@part
def measure_path(problem, placing, number, j):
    """Fill cost, delay and lacking links of path ``number``, the request's ``j``-th, for requests of one rate."""
    paths = placing.paths
    placing.link_cost[j] = 0.0
    placing.link_delay[j] = 0.0
    placing.lacking[j] = 0
    for hop in range(paths.start[number], paths.start[number] + paths.hops[number]):
        link = paths.link[hop]
        placing.link_cost[j] += hop_cost(problem, link, 0)
        placing.link_delay[j] += hop_delay(problem, link, 0)
        if not link_fits(problem, link, 0):
            placing.lacking[j] += 1


@part
def _measure_segments(problem, placing, number, position):
    """Cost, delay and lacking links of path ``number`` with functions at ``position``, each segment at its own rate."""
    paths = placing.paths
    cost, delay, lacking = 0.0, 0.0, 0
    i = 0
    for hop in range(paths.hops[number]):
        while i < problem.functions and position[i] <= hop:
            i += 1
        link = paths.link[paths.start[number] + hop]
        cost += hop_cost(problem, link, i)
        delay += hop_delay(problem, link, i)
        if not link_fits(problem, link, i):
            lacking += 1
    return cost, delay, lacking


@part
def _fits_beside(problem, node, vm, i, used, same):
    """Whether a VM has room for function ``i`` beside what the functions before it took, if they took it here."""
    for kind in range(problem.kinds):
        own = used[vm, kind] if same else 0
        if not fits(problem.vm_offered[node, vm, kind] - own, problem.load_units[i, kind]):
            return False
    return True


@part
def _price(problem, node, vm, i):
    """What orders VMs by how dear function ``i`` is there."""
    if problem.kinds == 1:
        return problem.vm_price[node, vm, 0]
    return place_cost(problem, node, vm, i)


@part
def place_in_order(problem, placing, number, position, vm, heed_capacity):
    """Each function in order on the cheapest VM that fits, from the position of the one before it on.

    Args:
        number: the path.
        position: receives the positions, int64 [F].
        vm: receives the VMs, int64 [F].
        heed_capacity: False places as if every VM were empty and large.

    Returns:
        False if some function fits on no VM of the rest of the path.
    """
    paths, used = placing.paths, placing.used
    hops = paths.hops[number]
    before = -1
    for i in range(problem.functions):
        least = np.inf
        for at in range(first_position(problem, hops, before), last_position(problem, hops, i) + 1):
            node = node_at(problem, paths, number, at)
            for v in range(problem.vm_count[node]):
                if heed_capacity and not _fits_beside(problem, node, v, i, used, at == before):
                    continue
                price = _price(problem, node, v, i)
                if price < least:
                    least = price
                    position[i] = at
                    vm[i] = v
        if least == np.inf:
            return False
        if position[i] != before:
            used[:] = 0
        before = position[i]
        for kind in range(problem.kinds):
            used[vm[i], kind] += problem.load_units[i, kind]
    return True


@part
def judge(problem, placing, number, j, position, vm):
    """Cost ($) of a placement on the request's ``j``-th path, and by how much it breaks the constraints (0: feasible).

    The violation counts lacking links, overused shares of VMs, the share of the delay and the steps in excess.
    """
    paths = placing.paths
    hops = paths.hops[number]
    if placing.hopeless[j]:
        return 0.0, 1e6
    cost = placing.link_cost[j]
    delay = placing.link_delay[j]
    lacking = placing.lacking[j]
    if not problem.one_rate:
        cost, delay, lacking = _measure_segments(problem, placing, number, position)
    steps = hops
    violation = float(lacking)
    for i in range(problem.functions):
        node = node_at(problem, paths, number, position[i])
        cost += place_cost(problem, node, vm[i], i)
        delay += place_delay(problem, node, vm[i], i)
        if position[i] == (position[i - 1] if i > 0 else 0):
            steps += 1
        violation += _overuse(problem, node, position, vm, i)
    return cost, with_excess(problem, violation, delay, steps)


@part
def _overuse(problem, node, position, vm, i):
    """Share of function ``i`` that its VM on ``node`` lacks, with the functions before it that stand there."""
    worst = 0.0
    for kind in range(problem.kinds):
        taken = 0
        for other in range(i + 1):
            if position[other] == position[i] and vm[other] == vm[i]:
                taken += problem.load_units[other, kind]
        over = taken - problem.vm_offered[node, vm[i], kind]
        if over > 0 and problem.load_units[i, kind] > 0:
            worst = max(worst, min(over, problem.load_units[i, kind]) / problem.load_units[i, kind])
    return worst


@part
def lay_walk(problem, placing, number, position, vm):
    """Write the placement as a walk to ``placing.walk``; returns its steps."""
    paths, walk = placing.paths, placing.walk
    steps = 0
    i = 0
    for at in range(paths.hops[number] + 1):
        if at > 0:
            walk.node[steps] = node_at(problem, paths, number, at)
            walk.link[steps] = paths.link[paths.start[number] + at - 1]
            walk.vm[steps] = -1
            if i < problem.functions and position[i] == at:
                walk.vm[steps] = vm[i]
                i += 1
            steps += 1
        while i < problem.functions and position[i] == at:
            walk.node[steps] = node_at(problem, paths, number, at)
            walk.link[steps] = -1
            walk.vm[steps] = vm[i]
            i += 1
            steps += 1
    return steps


@part
def encode_placement(problem, placing, number, position, vm, plan):
    """Write a feasible placement on path ``number`` as actions; returns how many, 0 if it fails the step checks."""
    steps = lay_walk(problem, placing, number, position, vm)
    # Delays are summed once more step by step, as the step checks do.
    _, delay = walk_totals(problem, Prices(problem.vm_price, problem.link_price), placing.walk, steps)
    if delay > problem.budget:
        return 0
    encode_walk(placing.walk, steps, problem.vm_offered.shape[1], plan)
    return steps


@part
def place_greedily(problem, tables, placing):
    """Place the chain in order on each of the k paths.

    Paths where the functions do not fit get the placement that ignores capacities, so that every row is defined, but
    for those of ``placing.hopeless``.

    Returns:
        (row of ``paths``, the path with the cheapest feasible placement or -1); the row is OVERFLOW if there was no
        room for the paths.
    """
    paths = placing.paths
    pair = Pair(problem.net, problem.ingress, problem.egress)
    row = paths_between(tables, pair, paths, placing.candidates)
    if row == OVERFLOW:
        return row, -1
    best = -1
    least = np.inf
    for j in range(paths.found[row]):
        number = row * placing.lacking.size + j
        measure_path(problem, placing, number, j)
        position, vm = placing.position[j], placing.vm[j]
        placing.hopeless[j] = False
        if not place_in_order(problem, placing, number, position, vm, True):
            placing.hopeless[j] = not place_in_order(problem, placing, number, position, vm, False)
        cost, violation = judge(problem, placing, number, j, position, vm)
        if violation == 0.0 and cost < least:
            least = cost
            best = j
    return row, best
