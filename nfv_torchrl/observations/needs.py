"""Where room is needed: the latest requests stand for the next ones, and each says what is left for more of its kind.

Means over a whole network hide that all VMs one pair of nodes can reach are full. So for each different one of the
latest requests this counts what is free on the VMs that it could have used, and what a walk would take of that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import Tables

PROBES = 64
"""Latest requests, with the one in hand, that say where room is needed."""
FEW = 4.0
"""So many more requests are few: half of the way from plenty of room to none."""


class Needs(NamedTuple):
    """The different ones of the latest requests of an environment, and the room that each could use."""

    side: np.ndarray  # int16 [S, N, N], by egress and node: which part the node is in when the egress is taken out
    largest_units: np.ndarray  # int64 [Q], ledger units of the largest function
    chain_units: np.ndarray  # int64 [Q]
    different: np.ndarray  # int64 [1], how many different ones
    request: np.ndarray  # int64 [PROBES, 3], type, ingress, egress
    times: np.ndarray  # int64 [PROBES], how often it came
    reached: np.ndarray  # bool [PROBES, N], nodes that it could use, were nothing used
    free: np.ndarray  # int64 [PROBES], ledger units on these nodes' VMs that its largest function fits on
    usable: np.ndarray  # int64 [Q, N], the same of every node
    seen: np.ndarray  # int64 [Q], how many of the latest requests are of each type
    drop: np.ndarray  # int64 [Q, F], what each function of a walk takes of the usable units; scratch


@kernel
def _fill_sides(tables, net, side, queue):
    """Breadth-first search from every node in turn, over the network without one node."""
    nodes = tables.num_nodes[net]
    for egress in range(nodes):
        for node in range(nodes):
            side[egress, node] = -1
        for start in range(nodes):
            if start == egress or side[egress, start] >= 0:
                continue
            side[egress, start] = start
            queue[0] = start
            head, tail = 0, 1
            while head < tail:
                node = queue[head]
                head += 1
                for k in range(tables.degree[net, node]):
                    after = tables.neighbour[net, node, k]
                    if after != egress and side[egress, after] < 0:
                        side[egress, after] = start
                        queue[tail] = after
                        tail += 1


def make_needs(tables: Tables) -> Needs:
    """``Needs`` for any network and service of ``tables``."""
    networks, nodes, _, _ = tables.vm_capacity.shape
    services, functions = tables.services, tables.load.shape[1]
    side = np.zeros((networks, nodes, nodes), np.int16)
    queue = np.zeros(nodes, np.int64)
    for net in range(networks):
        _fill_sides(tables, net, side[net], queue)
    return Needs(
        side=side,
        largest_units=tables.load_units[:services, :, 0].max(axis=1),
        chain_units=tables.load_units[:services, :, 0].sum(axis=1),
        different=np.zeros(1, np.int64),
        request=np.zeros((PROBES, 3), np.int64),
        times=np.zeros(PROBES, np.int64),
        reached=np.zeros((PROBES, nodes), np.bool_),
        free=np.zeros(PROBES, np.int64),
        usable=np.zeros((services, nodes), np.int64),
        seen=np.zeros(services, np.int64),
        drop=np.zeros((services, functions), np.int64),
    )


@part
def measure_needs(world, b, own):
    """Fill ``own`` (``Needs``) from the latest requests of environment b, the one in hand among them."""
    _measure_usable(world, b, own)
    _collect(world, b, own)
    nodes = world.tables.num_nodes[world.env[b].net]
    for i in range(own.different[0]):
        request = (own.request[i, 0], own.request[i, 1], own.request[i, 2])
        own.free[i] = 0
        for node in range(nodes):
            own.reached[i, node] = _can_reach(world, b, own, request, node)
            own.free[i] += own.usable[request[0], node] * own.reached[i, node]


@part
def _measure_usable(world, b, own):
    tables, ledger, net = world.tables, world.ledger, world.env[b].net
    for node in range(tables.num_nodes[net]):
        for q in range(own.largest_units.size):
            own.usable[q, node] = 0
            for vm in range(tables.vm_count[net, node]):
                own.usable[q, node] += usable_units(own, q, ledger.vm_offered[b, node, vm, 0])


@part
def usable_units(own, q, free):
    """Ledger units of a VM with ``free`` of them that are of use for type q: all, or none."""
    return free if fits(free, own.largest_units[q]) else 0


@part
def _collect(world, b, own):
    """The latest requests, each different one once."""
    arrivals, cursor = world.arrivals, world.env[b].cursor
    own.seen[:] = 0
    count = 0
    for r in range(max(0, cursor + 1 - PROBES), cursor + 1):
        q = np.int64(arrivals.profile[b, r])
        ingress, egress = np.int64(arrivals.ingress[b, r]), np.int64(arrivals.egress[b, r])
        own.seen[q] += 1
        i = 0
        while i < count and not (
            own.request[i, 1] == ingress and own.request[i, 2] == egress and own.request[i, 0] == q
        ):
            i += 1
        if i == count:
            own.request[i, 0], own.request[i, 1], own.request[i, 2] = q, ingress, egress
            own.times[i] = 0
            count += 1
        own.times[i] += 1
    own.different[0] = count


@part
def _can_reach(world, b, own, request, node):
    """Whether a request (type, ingress, egress) could place a function on ``node``, were nothing used."""
    tables, net = world.tables, world.env[b].net
    service, ingress, egress = request
    if node == egress:
        return True
    if own.side[net, egress, node] != own.side[net, egress, ingress]:
        return False
    if node == ingress and not (world.rules.colocation or world.rules.distinct):
        return False
    rate = tables.least_rate[service]
    there = tables.delay_to[net, rate, ingress, node] + tables.delay_to[net, rate, node, egress]
    return there <= tables.tolerable_delay[service]


@part
def closeness(own, i, free):
    """How close request i is to finding no room, with ``free`` units where it can go: 1 if there is none, 0 if all."""
    return 1.0 / (1.0 + free / own.chain_units[own.request[i, 0]] / FEW)


@part
def taken_units(own, i, place, placed):
    """Ledger units that a walk takes of what request i could use, by ``own.drop`` and its ``place`` int64 [F, 3]."""
    taken = 0
    for j in range(placed):
        taken += own.drop[own.request[i, 0], j] * own.reached[i, place[j, 0]]
    return taken
