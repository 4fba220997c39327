"""The k least-cost simple paths between two nodes, compiled and remembered.

Yen's algorithm with Lawler's rule (a path is deviated from only behind the place where it left its parent, so no path
is found twice) and a goal-directed Dijkstra search. Costs are the links' unit costs; what is available plays no part,
so a path found once serves every later request between the same nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.walks import OVERFLOW
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.tables import Tables


@by_reference
class Paths(NamedTuple):
    """Paths of pairs asked for so far. Row r keeps k paths; path j of it has number r * k + j.

    ``node`` and ``link`` hold the hops of all paths one after the other: the node gone to and the link used.
    """

    row: np.ndarray  # int64 [S, N, N], -1: not computed yet
    size: np.ndarray  # int64 [2]: rows used, hops used
    found: np.ndarray  # int64 [R], paths of the row (fewer than k if the graph has no more)
    start: np.ndarray  # int64 [R * k], first hop
    hops: np.ndarray  # int64 [R * k]
    node: np.ndarray  # int32 [H]
    link: np.ndarray  # int32 [H]


class Pair(NamedTuple):
    """Two nodes of network ``net``, a row of the tables."""

    net: int
    ingress: int
    egress: int


@by_reference
class Candidates(NamedTuple):
    """The best deviations found so far (at most k) and the scratch of the search for one."""

    cost: np.ndarray  # float64 [k], inf: free
    hops: np.ndarray  # int64 [k]
    deviation: np.ndarray  # int64 [k], hop at which it leaves its parent
    node: np.ndarray  # int32 [k, N]
    link: np.ndarray  # int32 [k, N]
    distance: np.ndarray  # float64 [N]
    via_node: np.ndarray  # int64 [N]
    via_link: np.ndarray  # int64 [N]
    closed: np.ndarray  # bool [N]
    blocked_node: np.ndarray  # bool [N]
    blocked_link: np.ndarray  # bool [L]
    deviated_at: np.ndarray  # int64 [k], of the accepted paths


def make_paths(tables: Tables, paths: int, rows: int = 64) -> Paths:
    """Room for the paths of ``rows`` pairs of nodes, ``paths`` each."""
    count, nodes = tables.vm_count.shape
    hops = rows * paths * min(nodes, 12) + paths * nodes
    return Paths(
        row=np.full((count, nodes, nodes), -1),
        size=np.zeros(2, np.int64),
        found=np.zeros(rows, np.int64),
        start=np.zeros(rows * paths, np.int64),
        hops=np.zeros(rows * paths, np.int64),
        node=np.zeros(hops, np.int32),
        link=np.zeros(hops, np.int32),
    )


def grow_paths(paths: Paths) -> Paths:
    """Twice the room; what is known stays."""

    def twice(array: np.ndarray) -> np.ndarray:
        return np.concatenate([array, np.zeros_like(array)])

    return paths._replace(
        found=twice(paths.found),
        start=twice(paths.start),
        hops=twice(paths.hops),
        node=twice(paths.node),
        link=twice(paths.link),
    )


def make_candidates(tables: Tables, paths: int) -> Candidates:
    """Scratch to find ``paths`` paths on any network of ``tables``."""
    nodes = tables.vm_count.shape[1]
    links = tables.link_capacity.shape[1]
    return Candidates(
        cost=np.zeros(paths),
        hops=np.zeros(paths, np.int64),
        deviation=np.zeros(paths, np.int64),
        node=np.zeros((paths, nodes), np.int32),
        link=np.zeros((paths, nodes), np.int32),
        distance=np.zeros(nodes),
        via_node=np.zeros(nodes, np.int64),
        via_link=np.zeros(nodes, np.int64),
        closed=np.zeros(nodes, np.bool_),
        blocked_node=np.zeros(nodes, np.bool_),
        blocked_link=np.zeros(links, np.bool_),
        deviated_at=np.zeros(paths, np.int64),
    )


@kernel
def paths_between(tables, pair, paths, candidates):
    """Row of the k cheapest simple paths between the nodes of ``pair``, cheapest first.

    Returns:
        Row of ``paths``, OVERFLOW (-1) if there is no room: grow and call again.
    """
    row = _row_of(pair, paths)
    if row >= 0:
        return row
    count = candidates.cost.size
    row = paths.size[0]
    if row >= paths.found.size or paths.size[1] + count * tables.num_nodes[pair.net] > paths.node.size:
        return OVERFLOW
    paths.size[0] += 1
    paths.found[row] = 0
    paths.row[pair.net, pair.ingress, pair.egress] = row
    candidates.cost[:] = np.inf
    _deviate(tables, pair, paths, candidates, -1, 0)
    while paths.found[row] < count:
        best = np.argmin(candidates.cost)
        if candidates.cost[best] == np.inf:
            break
        accepted = _accept(paths, candidates, row, best)
        if accepted + 1 < count:
            number = row * count + accepted
            for hop in range(candidates.deviated_at[accepted], paths.hops[number]):
                _deviate(tables, pair, paths, candidates, number, hop)
    return row


@part
def _row_of(pair, paths):
    return paths.row[pair.net, pair.ingress, pair.egress]


@part
def _accept(paths, candidates, row, best):
    """Move a candidate into the row; returns its place there."""
    place = paths.found[row]
    number = row * candidates.cost.size + place
    start = paths.size[1]
    hops = candidates.hops[best]
    paths.start[number] = start
    paths.hops[number] = hops
    for hop in range(hops):
        paths.node[start + hop] = candidates.node[best, hop]
        paths.link[start + hop] = candidates.link[best, hop]
    paths.size[1] += hops
    paths.found[row] += 1
    candidates.deviated_at[place] = candidates.deviation[best]
    candidates.cost[best] = np.inf
    return place


@part
def _deviate(tables, pair, paths, candidates, number, hop):
    """Cheapest path that shares the first ``hop`` hops with path ``number`` (-1: any) but no accepted path's next."""
    row = _row_of(pair, paths)
    candidates.blocked_node[:] = False
    candidates.blocked_link[:] = False
    spur = pair.ingress
    root_cost = 0.0
    if number >= 0:
        start = paths.start[number]
        for h in range(hop):
            candidates.blocked_node[spur] = True
            spur = paths.node[start + h]
            root_cost += tables.link_unit_cost[pair.net, paths.link[start + h]]
        for place in range(paths.found[row]):
            other = paths.start[row * candidates.cost.size + place]
            shares = paths.hops[row * candidates.cost.size + place] > hop
            for h in range(hop):
                shares = shares and paths.link[other + h] == paths.link[start + h]
            if shares:
                candidates.blocked_link[paths.link[other + hop]] = True
    cost = root_cost + _search(tables, pair, spur, candidates)
    worst = np.argmax(candidates.cost)
    if not cost < candidates.cost[worst]:
        return
    candidates.cost[worst] = cost
    candidates.deviation[worst] = hop
    for h in range(hop):
        candidates.node[worst, h] = paths.node[paths.start[number] + h]
        candidates.link[worst, h] = paths.link[paths.start[number] + h]
    tail = 0
    node = pair.egress
    while node != spur:
        tail += 1
        node = candidates.via_node[node]
    candidates.hops[worst] = hop + tail
    node = pair.egress
    for h in range(hop + tail - 1, hop - 1, -1):
        candidates.node[worst, h] = node
        candidates.link[worst, h] = candidates.via_link[node]
        node = candidates.via_node[node]


@part
def _search(tables, pair, spur, candidates):
    """Cost of the cheapest path that keeps off the blocked nodes and links, inf if none."""
    net, egress = pair.net, pair.egress
    nodes = tables.num_nodes[net]
    for n in range(nodes):
        candidates.distance[n] = np.inf
        candidates.closed[n] = candidates.blocked_node[n]
    candidates.distance[spur] = 0.0
    while True:
        node = -1
        least = np.inf
        for n in range(nodes):
            if not candidates.closed[n]:
                bound = candidates.distance[n] + tables.link_cost_to[net, n, egress]
                if bound < least:
                    least = bound
                    node = n
        if node < 0 or node == egress:
            return candidates.distance[egress]
        candidates.closed[node] = True
        for k in range(tables.degree[net, node]):
            link = tables.neighbour_link[net, node, k]
            after = tables.neighbour[net, node, k]
            if candidates.closed[after] or candidates.blocked_link[link]:
                continue
            distance = candidates.distance[node] + tables.link_unit_cost[net, link]
            if distance < candidates.distance[after]:
                candidates.distance[after] = distance
                candidates.via_node[after] = node
                candidates.via_link[after] = link
