"""Least cost, or least delay, from every (node, next function) to the end of the request.

The walk of a request is a path through F + 1 copies of the network, one for each number of functions already placed:
forwarding stays in a copy, placing goes on to the next. Bounds computed backwards through the copies ignore that a walk
may use a link or VM twice, so they never overestimate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.walks import (
    ends_at,
    hop_cost,
    hop_delay,
    link_fits,
    may_leave,
    may_stay,
    place_cost,
    place_delay,
    vm_fits,
)
from nfv_torchrl.simulator.compiled import inlined, part
from nfv_torchrl.simulator.references import by_reference


@by_reference
class ToGo(NamedTuple):
    """Bounds and the first step that attains them; rows are the number of functions placed."""

    value: np.ndarray  # float64 [F + 1, N]
    node: np.ndarray  # int64 [F + 1, N], next node
    link: np.ndarray  # int64 [F + 1, N], link to it, -1: the same node
    places: np.ndarray  # bool [F + 1, N], whether the next function is placed there
    link_weight: np.ndarray  # float64 [L], inf: cannot carry the request
    place_weight: np.ndarray  # float64 [F, N], best VM of the node, inf: none fits
    place_vm: np.ndarray  # int64 [F, N]
    barred: np.ndarray  # bool [F, N], functions that must not stand on a node; none unless the caller says so
    entering: np.ndarray  # float64 [N], least weight from having stepped into a node on
    queue: np.ndarray  # int64 [N]
    queued: np.ndarray  # bool [N]


def make_to_go(nodes: int, links: int, functions: int, barred: np.ndarray | None = None) -> ToGo:
    """Scratch for networks of at most ``nodes`` and ``links`` and chains of at most ``functions``.

    Args:
        barred: bool [F, N] that the caller fills; None: no function is barred from a node.
    """
    layers = (functions + 1, nodes)
    return ToGo(
        value=np.zeros(layers),
        node=np.zeros(layers, np.int64),
        link=np.zeros(layers, np.int64),
        places=np.zeros(layers, np.bool_),
        link_weight=np.zeros(links),
        place_weight=np.zeros((functions, nodes)),
        place_vm=np.zeros((functions, nodes), np.int64),
        barred=np.zeros((functions, nodes), np.bool_) if barred is None else barred,
        entering=np.zeros(nodes),
        queue=np.zeros(nodes, np.int64),
        queued=np.zeros(nodes, np.bool_),
    )


@inlined
def fill_cost_to_go(problem, to_go):
    """Least price ($) from every (function, node) to the end of the request."""
    _fill(problem, to_go, False)


@inlined
def fill_delay_to_go(problem, to_go):
    """Least delay (ms) from every (function, node) to the end of the request."""
    _fill(problem, to_go, True)


@part
def _fill(problem, to_go, by_delay):
    weigh_places(problem, to_go, by_delay)
    for i in range(problem.functions, -1, -1):
        if i == problem.functions or not problem.one_rate:
            weigh_links(problem, to_go, i, by_delay)
        seed_layer(problem, to_go, i)
        relax_layer(problem, to_go, i)


@inlined
def weigh_places(problem, to_go, by_delay):
    """The best VM of each node for each function."""
    for node in range(problem.nodes):
        for i in range(problem.functions):
            to_go.place_weight[i, node] = np.inf
        for vm in range(problem.vm_count[node]):
            for i in range(problem.functions):
                if vm_fits(problem, node, vm, i) and not to_go.barred[i, node]:
                    weight = place_delay(problem, node, vm, i) if by_delay else place_cost(problem, node, vm, i)
                    if weight < to_go.place_weight[i, node]:
                        to_go.place_weight[i, node] = weight
                        to_go.place_vm[i, node] = vm


@inlined
def weigh_links(problem, to_go, i, by_delay):
    """What segment ``i`` takes on each link."""
    for link in range(problem.links):
        weight = hop_delay(problem, link, i) if by_delay else hop_cost(problem, link, i)
        to_go.link_weight[link] = weight if link_fits(problem, link, i) else np.inf


@part
def best_start(problem, to_go):
    """Node on which the first function of a request with a free ingress is best placed, -1 if there is none."""
    best, least = -1, np.inf
    for node in range(problem.nodes):
        value = to_go.place_weight[0, node] + to_go.value[1, node]
        if value < least:
            best, least = node, value
    return best


@inlined
def seed_layer(problem, to_go, i):
    """Weights of walks that place function ``i`` with their very next step into (or on) a node."""
    for node in range(problem.nodes):
        to_go.value[i, node] = np.inf
        to_go.link[i, node] = 0
        to_go.entering[node] = np.inf
        if i < problem.functions:
            to_go.entering[node] = to_go.place_weight[i, node] + to_go.value[i + 1, node]
            if may_stay(problem, node, i):
                to_go.value[i, node] = to_go.entering[node]
                to_go.node[i, node] = node
                to_go.link[i, node] = -1
                to_go.places[i, node] = True
        elif ends_at(problem, node):
            to_go.value[i, node] = 0.0
            to_go.entering[node] = 0.0


@inlined
def relax_layer(problem, to_go, i):
    """Label-correcting search with a first-in first-out queue: most nodes enter it once."""
    nodes = problem.nodes
    head, waiting = 0, 0
    for node in range(nodes):
        to_go.queued[node] = to_go.entering[node] < np.inf
        if to_go.queued[node]:
            to_go.queue[waiting] = node
            waiting += 1
    while waiting > 0:
        node = to_go.queue[head]
        head = head + 1 if head + 1 < nodes else 0
        waiting -= 1
        to_go.queued[node] = False
        entering = to_go.entering[node]
        # Where staying to place is best (link -1), placing while entering weighs the same and takes a step less.
        places = i < problem.functions and (entering < to_go.value[i, node] or to_go.link[i, node] < 0)
        for k in range(problem.degree[node]):
            before = problem.neighbour[node, k]
            link = problem.neighbour_link[node, k]
            if problem.full_duplex:  # the direction from there to here
                link ^= 1
            weight = to_go.link_weight[link] + entering
            if not may_leave(problem, before, i) or not weight < to_go.value[i, before]:
                continue
            to_go.value[i, before] = weight
            to_go.node[i, before] = node
            to_go.link[i, before] = link
            to_go.places[i, before] = places
            if weight < to_go.entering[before]:
                to_go.entering[before] = weight
                if not to_go.queued[before]:
                    tail = head + waiting
                    to_go.queue[tail if tail < nodes else tail - nodes] = before
                    waiting += 1
                    to_go.queued[before] = True
