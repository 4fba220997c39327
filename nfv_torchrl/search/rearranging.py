"""Chains of requests with a free ingress or egress, and the same with one function moved to another VM.

A chain is a walk that may break constraints. Routes between functions are the cheapest ones, where a link without room
costs ``PENALTY`` more. So first comes what is broken least, then what costs least.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.roaming import (
    NOWHERE,
    Roaming,
    carries,
    close_nearest,
    make_roaming,
    may_stand,
    write_route,
    write_step,
)
from nfv_torchrl.search.walks import (
    ends_at,
    hop_cost,
    hop_delay,
    link_fits,
    may_leave,
    place_cost,
    place_delay,
    with_excess,
)
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import Tables

PENALTY = 1e6
"""$ for one unit of violation: above any real cost, so infeasible embeddings are ranked by their violation first."""
AHEAD, BACK = 0, 1
"""Trees from the function before, and to the function after."""


class Tree(NamedTuple):
    """Cheapest routes of one segment between a node and all others."""

    distance: np.ndarray  # float64 [N], $ with penalties, inf: no route
    via_node: np.ndarray  # int64 [N], the next node towards that one
    via_link: np.ndarray  # int64 [N]
    back: bool  # whether the routes lead to that node


@by_reference
class Rearranging(NamedTuple):
    """What rearranging chains writes to; one for each thread. J steps, k starts.

    Chains k and k + 1 are the one in hand and the best feasible one. ``roaming.walk`` is what is tried.
    """

    roaming: Roaming
    node: np.ndarray  # int64 [k + 2, J], as in ``PlannedWalk``
    link: np.ndarray  # int64 [k + 2, J]
    vm: np.ndarray  # int64 [k + 2, J]
    steps: np.ndarray  # int64 [k + 2]
    at: np.ndarray  # int64 [F], of the chain in hand the step that places each function
    taken: np.ndarray  # int64 [L], of each link by the walk that is judged
    distance: np.ndarray  # float64 [2, F, N], trees of the chain in hand: AHEAD and BACK of each function
    via_node: np.ndarray  # int64 [2, F, N]
    via_link: np.ndarray  # int64 [2, F, N]
    stale: np.ndarray  # bool [2, F], trees that are of an earlier chain


def make_rearranging(tables: Tables, starts: int) -> Rearranging:
    """Scratch for chains on any network of ``tables``, begun at ``starts`` nodes."""
    roaming = make_roaming(tables, starts)
    walks, trees = (starts + 2, roaming.walk.node.size), (2, tables.load.shape[1], tables.vm_count.shape[1])
    return Rearranging(
        roaming=roaming,
        node=np.zeros(walks, np.int64),
        link=np.zeros(walks, np.int64),
        vm=np.zeros(walks, np.int64),
        steps=np.zeros(starts + 2, np.int64),
        at=np.zeros(trees[1], np.int64),
        taken=np.zeros(tables.link_capacity.shape[1], np.int64),
        distance=np.zeros(trees),
        via_node=np.zeros(trees, np.int64),
        via_link=np.zeros(trees, np.int64),
        stale=np.ones(trees[:2], np.bool_),
    )


@part
def lay_chains(problem, own):
    """Write the greedy chain of each start as chain 0, 1, ...; they are ``greedy``'s where these break nothing.

    Returns:
        (number of chains, the cheapest feasible one or -1, its cost in $).
    """
    own.roaming.tried[:] = False
    count, best, least = 0, -1, np.inf
    for _ in range(own.roaming.starts if problem.ingress < 0 else 1):
        steps = _lay_chain(problem, own.roaming)
        if steps == NOWHERE:
            break
        if steps == 0:
            continue
        cost, violation = judge_walk(problem, own, steps)
        keep_walk(own, count, steps)
        if violation == 0.0 and cost < least:
            best, least = count, cost
        count += 1
    return count, best, least


@part
def _lay_chain(problem, roaming):
    """Steps of the greedy chain, 0 if it comes to an end before its time, ``NOWHERE`` if every start was tried."""
    steps, node = 0, problem.ingress
    tree = Tree(roaming.distance, roaming.via_node, roaming.via_link, False)
    for i in range(problem.functions):
        here = node
        if here < 0:
            tree.distance[:] = 0.0
        else:
            _spread(problem, roaming, steps, here, i, tree)
        node, vm = _best_place(problem, roaming, steps, here, i)
        if node < 0:
            return NOWHERE if here < 0 else 0
        if here < 0:
            roaming.tried[node] = True
            steps = write_step(roaming, 0, node, -1, vm)
        else:
            steps = write_route(roaming, steps, here, node, vm)
    if not ends_at(problem, node):
        _spread(problem, roaming, steps, node, problem.functions, tree)
        if tree.distance[problem.egress] == np.inf:
            return 0
        steps = write_route(roaming, steps, node, problem.egress, -1)
    return steps


@part
def _best_place(problem, roaming, steps, here, i):
    """Node and VM where route and placement of function ``i`` break least and cost least; -1 if there is none."""
    best, best_vm, least = -1, -1, np.inf
    for node in range(problem.nodes):
        if roaming.distance[node] == np.inf:
            continue
        if roaming.tried[node] if here < 0 else not may_stand(problem, roaming, steps, here, node):
            continue
        for vm in range(problem.vm_count[node]):
            cost = roaming.distance[node] + place_cost(problem, node, vm, i)
            if cost < least:
                cost += PENALTY * _lacking_share(problem, roaming.walk, steps, node, vm, i)
                if cost < least:
                    best, best_vm, least = node, vm, cost
    return best, best_vm


@part
def _lacking_share(problem, walk, steps, node, vm, i):
    """Share of function ``i`` that a VM lacks beside the functions that ``steps`` steps of the walk have put there."""
    worst = 0.0
    for kind in range(problem.kinds):
        load = problem.load_units[i, kind]
        taken, function = load, 0
        for j in range(steps):
            if walk.vm[j] >= 0:
                if walk.node[j] == node and walk.vm[j] == vm:
                    taken += problem.load_units[function, kind]
                function += 1
        over = taken - problem.vm_offered[node, vm, kind]
        if over > 0 and load > 0:
            worst = max(worst, min(over, load) / load)
    return worst


@part
def _spread(problem, roaming, steps, source, i, tree):
    """Dijkstra by penalised cost for segment ``i``: from ``source``, or with ``tree.back`` to it, from all nodes.

    Links have to carry what the first ``steps`` steps of ``roaming.walk`` take of them, too.
    """
    closed = roaming.closed
    tree.distance[:] = np.inf
    closed[:] = False
    tree.distance[source] = 0.0
    while True:
        node = close_nearest(problem, tree.distance, closed)
        if node < 0:
            return
        if not tree.back and not may_leave(problem, node, i):
            continue
        for k in range(problem.degree[node]):
            link, after = problem.neighbour_link[node, k], problem.neighbour[node, k]
            if tree.back:
                if not may_leave(problem, after, i):
                    continue
                if problem.full_duplex:
                    link = link ^ 1
            distance = tree.distance[node] + hop_cost(problem, link, i)
            if distance < tree.distance[after]:
                if not carries(problem, roaming, steps, link, i):
                    distance += PENALTY
                if distance < tree.distance[after]:
                    tree.distance[after] = distance
                    tree.via_node[after] = node
                    tree.via_link[after] = link


@part
def judge_walk(problem, own, steps):
    """Cost ($) of the tried walk, and by how much it breaks the constraints (0: feasible).

    The violation counts crossings of links that lack room, lacking shares of VMs, the share of the delay and the steps
    in excess.
    """
    walk = own.roaming.walk
    cost, delay, violation, i = 0.0, 0.0, 0.0, 0
    for j in range(steps):
        link, step_delay = walk.link[j], 0.0
        if link >= 0:
            cost += hop_cost(problem, link, i)
            step_delay = hop_delay(problem, link, i)
            own.taken[link] += problem.rate_units[i]
            if not fits(problem.link_offered[link], own.taken[link]):
                violation += 1.0
        if walk.vm[j] >= 0:
            cost += place_cost(problem, walk.node[j], walk.vm[j], i)
            step_delay += place_delay(problem, walk.node[j], walk.vm[j], i)
            violation += _lacking_share(problem, walk, j, walk.node[j], walk.vm[j], i)
            i += 1
        delay += step_delay
    for j in range(steps):
        if walk.link[j] >= 0:
            own.taken[walk.link[j]] = 0
    return cost, with_excess(problem, violation, delay, steps)


@part
def keep_walk(own, chain, steps):
    """Copy the tried walk to ``chain``."""
    walk = own.roaming.walk
    for j in range(steps):
        own.node[chain, j], own.link[chain, j], own.vm[chain, j] = walk.node[j], walk.link[j], walk.vm[j]
    own.steps[chain] = steps


@part
def try_chain(own, chain):
    """Copy ``chain`` to the tried walk; returns its steps."""
    walk = own.roaming.walk
    for j in range(own.steps[chain]):
        walk.node[j], walk.link[j], walk.vm[j] = own.node[chain, j], own.link[chain, j], own.vm[chain, j]
    return own.steps[chain]


@part
def take_in_hand(own, steps, moved, functions):
    """Make the tried walk the chain in hand: function ``moved`` has moved, or all (-1)."""
    here = own.steps.size - 2
    keep_walk(own, here, steps)
    i = 0
    for j in range(steps):
        if own.vm[here, j] >= 0:
            own.at[i] = j
            i += 1
    for i in range(functions):
        own.stale[AHEAD, i] = own.stale[AHEAD, i] or moved < 0 or i == moved + 1
        own.stale[BACK, i] = own.stale[BACK, i] or moved < 0 or i == moved - 1


@part
def stand(problem, own, i):
    """Node of function ``i`` of the chain in hand; the ingress before the first, the egress after the last."""
    if i < 0:
        return problem.ingress
    if i == problem.functions:
        return problem.egress
    return own.node[own.steps.size - 2, own.at[i]]


@part
def refresh_trees(problem, own, i):
    """Trees of function ``i``: from the one before, to the one after; all zero next to an end that is free."""
    for side in (AHEAD, BACK):
        if not own.stale[side, i]:
            continue
        source = stand(problem, own, i - 1 if side == AHEAD else i + 1)
        tree = Tree(own.distance[side, i], own.via_node[side, i], own.via_link[side, i], side == BACK)
        if source < 0:
            tree.distance[:] = 0.0
        else:
            _spread(problem, own.roaming, 0, source, i if side == AHEAD else i + 1, tree)
        own.stale[side, i] = False


@part
def may_move(problem, own, i, node):
    """Whether the rule of placement lets function ``i`` of the chain in hand stand on ``node``; the others stay."""
    if problem.distinct:
        free = True
        for other in range(problem.functions):
            free = free and (other == i or stand(problem, own, other) != node)
        return free
    before, after = stand(problem, own, i - 1), stand(problem, own, i + 1)
    if node == problem.egress:  # a walk stays there
        return after == node
    if problem.egress >= 0 and before == problem.egress:
        return False
    return problem.colocation or (node != before and (node != after or i + 1 == problem.functions))


@part
def cost_without(problem, own, i):
    """Penalised cost ($) of the chain in hand without function ``i`` and the segments beside it, at least."""
    here, cost, function = own.steps.size - 2, 0.0, 0
    for j in range(own.steps[here]):
        node, link, vm = own.node[here, j], own.link[here, j], own.vm[here, j]
        if link >= 0 and function != i and function != i + 1:
            cost += hop_cost(problem, link, function)
            if not link_fits(problem, link, function):
                cost += PENALTY
        if vm >= 0:
            if function != i:
                cost += cost_on(problem, own, node, vm, function)
            function += 1
    return cost


@part
def cost_on(problem, own, node, vm, i):
    """Penalised cost ($) of function ``i`` alone on a VM."""
    share = _lacking_share(problem, own.roaming.walk, 0, node, vm, i)
    return place_cost(problem, node, vm, i) + PENALTY * share


@part
def try_move(problem, own, i, node, vm):
    """Write the chain in hand with function ``i`` on another VM as the tried walk; returns its steps."""
    roaming, here, steps = own.roaming, own.steps.size - 2, 0
    before, after = stand(problem, own, i - 1), stand(problem, own, i + 1)
    if i > 0:
        steps = _copy_steps(own, 0, own.at[i - 1] + 1, steps)
    steps = _write_ahead(own, i, steps, node if before < 0 else before, node)
    roaming.walk.vm[steps - 1] = vm
    if after < 0:
        return steps
    last = i + 1 == problem.functions
    if node == after and not last:
        steps = write_step(roaming, steps, node, -1, -1)
    while node != after:
        link, node = own.via_link[BACK, i, node], own.via_node[BACK, i, node]
        steps = write_step(roaming, steps, node, link, -1)
    if last:
        return steps
    roaming.walk.vm[steps - 1] = own.vm[here, own.at[i + 1]]
    return _copy_steps(own, own.at[i + 1] + 1, own.steps[here], steps)


@part
def _write_ahead(own, i, steps, before, node):
    """Write the route from ``before`` to ``node``, where function ``i`` is to stand; the new number of steps."""
    if before == node:
        return write_step(own.roaming, steps, node, -1, -1)
    hops, at = 0, node
    while at != before:
        hops, at = hops + 1, own.via_node[AHEAD, i, at]
    at = node
    for step in range(steps + hops - 1, steps - 1, -1):
        write_step(own.roaming, step, at, own.via_link[AHEAD, i, at], -1)
        at = own.via_node[AHEAD, i, at]
    return steps + hops


@part
def _copy_steps(own, first, end, steps):
    """Copy a part of the chain in hand to the tried walk, behind ``steps`` steps; the new number of steps."""
    here = own.steps.size - 2
    for j in range(first, end):
        steps = write_step(own.roaming, steps, own.node[here, j], own.link[here, j], own.vm[here, j])
    return steps
