"""Greedy embeddings of requests whose ingress or egress is free: there are no two nodes to look for paths between.

The chain goes from function to function: each to the node and VM where the route there and the placement cost least
together. It is begun at the nodes that are cheapest for the first function, or at the ingress if that is given.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.walks import (
    PlannedWalk,
    ends_at,
    hop_cost,
    make_walk,
    place_cost,
    walk_totals,
)
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import Tables

NOWHERE = -1


@by_reference
class Roaming(NamedTuple):
    """What ``roam`` writes to while it works; one for each thread."""

    starts: int  # nodes at which the first function is tried
    distance: np.ndarray  # float64 [N], $ from the current node
    via_node: np.ndarray  # int64 [N]
    via_link: np.ndarray  # int64 [N]
    closed: np.ndarray  # bool [N]
    tried: np.ndarray  # bool [N], nodes that the first function has been tried on
    walk: PlannedWalk
    best: PlannedWalk


def make_roaming(tables: Tables, starts: int) -> Roaming:
    """Scratch for walks on any network of ``tables``."""
    nodes, functions = tables.vm_count.shape[1], tables.load.shape[1]
    steps = (functions + 1) * nodes + functions
    return Roaming(
        starts=starts,
        distance=np.zeros(nodes),
        via_node=np.zeros(nodes, np.int64),
        via_link=np.zeros(nodes, np.int64),
        closed=np.zeros(nodes, np.bool_),
        tried=np.zeros(nodes, np.bool_),
        walk=make_walk(steps),
        best=make_walk(steps),
    )


@part
def roam(problem, prices, roaming):
    """Steps of the cheapest walk found, in ``roaming.best``; 0 if none was.

    Args:
        problem: the request.
        prices: ``Prices`` of the problem.
        roaming: scratch.
    """
    roaming.tried[:] = False
    least, best = np.inf, 0
    for _ in range(roaming.starts if problem.ingress < 0 else 1):
        steps = _follow_chain(problem, roaming)
        if steps == NOWHERE:
            break
        if steps == 0 or steps > problem.max_steps:
            continue
        cost, delay = walk_totals(problem, prices, roaming.walk, steps)
        if delay <= problem.budget and cost < least:
            least, best = cost, steps
            for j in range(steps):
                roaming.best.node[j] = roaming.walk.node[j]
                roaming.best.link[j] = roaming.walk.link[j]
                roaming.best.vm[j] = roaming.walk.vm[j]
    return best


@part
def _follow_chain(problem, roaming):
    """Steps of one walk, 0 if it comes to an end before its time, ``NOWHERE`` if there is no node left to begin at."""
    steps, first, node = 0, 0, problem.ingress
    if problem.ingress < 0:
        node, vm = _cheapest_start(problem, roaming)
        if node < 0:
            return NOWHERE
        roaming.tried[node] = True
        steps = write_step(roaming, 0, node, -1, vm)
        first = 1
    for i in range(first, problem.functions):
        _route(problem, roaming, steps, node, i)
        here = node
        node, vm = _nearest_place(problem, roaming, steps, here, i)
        if node < 0:
            return 0
        steps = write_route(roaming, steps, here, node, vm)
    if not ends_at(problem, node):
        _route(problem, roaming, steps, node, problem.functions)
        if roaming.distance[problem.egress] == np.inf:
            return 0
        steps = write_route(roaming, steps, node, problem.egress, -1)
    return steps


@part
def _cheapest_start(problem, roaming):
    """Node and VM that are cheapest for the first function, of the nodes not tried yet; -1 if there is none."""
    best, best_vm, least = -1, -1, np.inf
    for node in range(problem.nodes):
        if roaming.tried[node]:
            continue
        for vm in range(problem.vm_count[node]):
            if has_room(problem, roaming, 0, node, vm, 0) and place_cost(problem, node, vm, 0) < least:
                best, best_vm, least = node, vm, place_cost(problem, node, vm, 0)
    return best, best_vm


@part
def _nearest_place(problem, roaming, steps, here, i):
    """Node and VM where route and placement of function ``i`` cost least; -1 if there is none."""
    best, best_vm, least = -1, -1, np.inf
    for node in range(problem.nodes):
        if roaming.distance[node] == np.inf or not may_stand(problem, roaming, steps, here, node):
            continue
        for vm in range(problem.vm_count[node]):
            cost = roaming.distance[node] + place_cost(problem, node, vm, i)
            if cost < least and has_room(problem, roaming, steps, node, vm, i):
                best, best_vm, least = node, vm, cost
    return best, best_vm


@part
def may_stand(problem, roaming, steps, here, node):
    """Whether the rule of placement lets the next function stand on ``node`` after ``steps`` steps to ``here``."""
    if problem.distinct:
        taken = False
        for j in range(steps):
            taken = taken or (roaming.walk.vm[j] >= 0 and roaming.walk.node[j] == node)
        return not taken
    return node != here or problem.colocation or node == problem.egress


@part
def has_room(problem, roaming, steps, node, vm, i):
    """Whether a VM has room for function ``i`` beside those that the walk has placed there."""
    for kind in range(problem.kinds):
        taken, function = problem.load_units[i, kind], 0
        for j in range(steps):
            if roaming.walk.vm[j] >= 0:
                if roaming.walk.node[j] == node and roaming.walk.vm[j] == vm:
                    taken += problem.load_units[function, kind]
                function += 1
        if not fits(problem.vm_offered[node, vm, kind], taken):
            return False
    return True


@part
def _route(problem, roaming, steps, here, i):
    """Dijkstra from ``here`` by cost, over links with room for segment ``i`` beside what the walk has taken."""
    distance, closed = roaming.distance, roaming.closed
    distance[:] = np.inf
    closed[:] = False
    distance[here] = 0.0
    while True:
        node = close_nearest(problem, distance, closed)
        if node < 0:
            return
        if node == problem.egress and not problem.distinct:  # a walk stays there
            continue
        for k in range(problem.degree[node]):
            link, after = problem.neighbour_link[node, k], problem.neighbour[node, k]
            weight = distance[node] + hop_cost(problem, link, i)
            if weight < distance[after] and carries(problem, roaming, steps, link, i):
                distance[after] = weight
                roaming.via_node[after] = node
                roaming.via_link[after] = link


@part
def close_nearest(problem, distance, closed):
    """The nearest node that was not closed yet, which is closed now; -1 if none is left that can be reached."""
    node, least = -1, np.inf
    for n in range(problem.nodes):
        if not closed[n] and distance[n] < least:
            node, least = n, distance[n]
    if node >= 0:
        closed[node] = True
    return node


@part
def carries(problem, roaming, steps, link, i):
    """Whether a link has room for segment ``i`` beside what the walk has taken of it."""
    taken, segment = problem.rate_units[i], 0
    for j in range(steps):
        if roaming.walk.link[j] == link:
            taken += problem.rate_units[segment]
        segment += roaming.walk.vm[j] >= 0
    return fits(problem.link_offered[link], taken)


@part
def write_route(roaming, steps, here, node, vm):
    """Write the route from ``here`` to ``node``, with ``vm`` there (-1: only forwards); the new number of steps."""
    hops, at = 0, node
    while at != here:
        hops += 1
        at = roaming.via_node[at]
    if hops == 0:
        return write_step(roaming, steps, node, -1, vm)
    at = node
    for step in range(steps + hops - 1, steps - 1, -1):
        write_step(roaming, step, at, roaming.via_link[at], -1)
        at = roaming.via_node[at]
    roaming.walk.vm[steps + hops - 1] = vm
    return steps + hops


@part
def write_step(roaming, step, node, link, vm):
    roaming.walk.node[step] = node
    roaming.walk.link[step] = link
    roaming.walk.vm[step] = vm
    return step + 1
