"""``first_fit``: each function on the first node that has room, nodes tried by their delay from the function before it.

The baseline of CN-UPB/NFVdeep (github.com/CN-UPB/NFVdeep, ``FirstFitPolicy3`` of ``nfvdeep/agent/baselines.py``), which
their result files call FirstFit_3. What it decides is never taken back: where no node will do for a function, or the
whole takes more than the tolerable delay, the request is refused. Of their rules two are read otherwise here:

- They count bandwidth on nodes, the simulator on links. So a node is passed over if a link on the route there is full,
  where theirs is passed over if the node has no bandwidth left.
- A node here may have several VMs: the first that has room is taken. An ingress and an egress that are given are kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.planners.base import CompiledPlanner, over_rows
from nfv_torchrl.search.roaming import Roaming, carries, has_room, make_roaming, may_stand, write_route, write_step
from nfv_torchrl.search.walks import encode_walk, ends_at, make_problem, unit_costs, walk_totals
from nfv_torchrl.settings.values import Seed
from nfv_torchrl.simulator.compiled import inlined, part
from nfv_torchrl.simulator.tables import Tables

LOW_32 = 0xFFFFFFFF
SPREAD = 0x9E3779B1
"""Odd and near 2^32 over the golden ratio: seeds that are close begin far apart."""


class FirstFitScratch(NamedTuple):
    """Scratch memory of ``first_fit``, one for each thread."""

    start: int  # of the numbers that stand for chance, 0 .. 2^32 - 1
    hops: np.ndarray  # int64 [N], from the current node
    roaming: Roaming  # whose ``distance`` is in ms here


@part
def plan_first_fit(world, b, own, plan):
    """Plan the request of environment b by first fit.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``FirstFitScratch``.
        plan: receives the actions, int64 [max_steps].

    Returns:
        Number of actions, 0 if the request is refused.
    """
    prices = unit_costs(world, b)
    problem = make_problem(world, b, prices)
    walk = own.roaming.walk
    steps, here = 0, problem.ingress
    for i in range(problem.functions):
        source = here if here >= 0 else _any_node(own.start + world.env[b].cursor, problem.nodes)
        node, vm = _first_fit(problem, own, steps, source, here < 0, i)
        if node < 0:
            return 0
        if here < 0:
            steps = write_step(own.roaming, 0, node, -1, vm)
        else:
            steps = write_route(own.roaming, steps, here, node, vm)
        here = node
    if not ends_at(problem, here):
        if not _find_egress(problem, own, steps, here):
            return 0
        steps = write_route(own.roaming, steps, here, problem.egress, -1)
    _, delay = walk_totals(problem, prices, walk, steps)
    if steps > problem.max_steps or delay > problem.budget:
        return 0
    encode_walk(walk, steps, problem.vm_offered.shape[1], plan)
    return steps


@part
def _first_fit(problem, own, steps, source, anywhere, i):
    """Node and VM of function ``i``, the first that will do by delay from ``source``; -1 if there is none.

    ``anywhere``: the walk begins at that node, with no route to it.
    """
    _start_route(problem, own, source)
    node = _next_nearest(problem, own)
    while node >= 0:
        if anywhere or (may_stand(problem, own.roaming, steps, source, node) and _fits(problem, own, steps, node, i)):
            for vm in range(problem.vm_count[node]):
                if has_room(problem, own.roaming, steps, node, vm, i):
                    return node, vm
        _relax(problem, own, node)
        node = _next_nearest(problem, own)
    return -1, -1


@part
def _find_egress(problem, own, steps, here):
    """Whether the route of least delay to the egress has room."""
    _start_route(problem, own, here)
    node = _next_nearest(problem, own)
    while node >= 0 and node != problem.egress:
        _relax(problem, own, node)
        node = _next_nearest(problem, own)
    return node >= 0 and _fits(problem, own, steps, node, problem.functions)


@part
def _start_route(problem, own, source):
    own.roaming.distance[:] = np.inf
    own.roaming.closed[:] = False
    own.roaming.distance[source] = 0.0
    own.roaming.via_node[source] = -1
    own.hops[source] = 0


@part
def _next_nearest(problem, own):
    """The nearest node not yet closed, which it now is; -1 if there is none. Ties: fewer hops, then lower number."""
    distance, closed, hops = own.roaming.distance, own.roaming.closed, own.hops
    best = -1
    for node in range(problem.nodes):
        if closed[node] or distance[node] == np.inf:
            continue
        further = best >= 0 and distance[node] > distance[best]
        as_near = best >= 0 and distance[node] == distance[best]
        if not further and not (as_near and hops[node] >= hops[best]):
            best = node
    if best >= 0:
        closed[best] = True
    return best


@part
def _relax(problem, own, node):
    """Routes over ``node`` to its neighbours by delay of propagation, whatever capacity is left."""
    roaming = own.roaming
    if node == problem.egress and not problem.distinct:  # a walk stays there
        return
    for k in range(problem.degree[node]):
        link, after = problem.neighbour_link[node, k], problem.neighbour[node, k]
        delay = roaming.distance[node] + problem.link_delay[link]
        nearer = delay < roaming.distance[after]
        if nearer or (delay == roaming.distance[after] and own.hops[node] + 1 < own.hops[after]):
            roaming.distance[after], own.hops[after] = delay, own.hops[node] + 1
            roaming.via_node[after], roaming.via_link[after] = node, link


@part
def _fits(problem, own, steps, node, i):
    """Whether the links of the route to ``node`` have room for segment ``i``."""
    while own.roaming.via_node[node] >= 0:
        if not carries(problem, own.roaming, steps, own.roaming.via_link[node], i):
            return False
        node = own.roaming.via_node[node]
    return True


@inlined
def _any_node(number, nodes):
    """A node that looks like chance but depends on ``number`` alone, each of ``nodes`` as likely."""
    mixed = number & LOW_32
    mixed = ((mixed >> 16) ^ mixed) * 0x45D9F3B & LOW_32
    mixed = ((mixed >> 16) ^ mixed) * 0x45D9F3B & LOW_32
    return ((mixed >> 16) ^ mixed) % nodes


class FirstFitPlanner(CompiledPlanner):
    """First fit as CN-UPB/NFVdeep defines it: the nearest node by delay on which each function fits.

    The search begins at the ingress. Where that is free it begins at a node drawn for the request, as theirs does; the
    draw depends on ``seed`` and on the request's number only, so that a run can be repeated.

    Args:
        seed: of these draws.
    """

    own: FirstFitScratch
    kernel = over_rows(plan_first_fit)

    def __init__(self, *, seed: Seed = 0) -> None:
        super().__init__()
        self.seed = int(seed)

    def make(self, tables: Tables) -> FirstFitScratch:
        """See ``CompiledPlanner``."""
        nodes = tables.vm_count.shape[1]
        return FirstFitScratch(self.seed * SPREAD & LOW_32, np.zeros(nodes, np.int64), make_roaming(tables, 1))
