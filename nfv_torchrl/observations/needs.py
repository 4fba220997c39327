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
KEPT = 4093
"""So many requests of before keep the nodes that they reach, which are a matter of the network alone. A prime."""
FEW = 4.0
"""So many more requests are few: half of the way from plenty of room to none."""


class Needs(NamedTuple):
    """The different ones of the latest requests of an environment, and the room that each could use.

    What requests take is kept in D rows ("demands"): one for each service type, or, where requests bring profiles of
    their own, one for each different request of the latest. K kinds of resources are looked at.
    """

    apart: bool  # whether each different request is a demand of its own
    side: np.ndarray  # int16 [S, N, N], by egress and node: which part the node is in when the egress is taken out
    largest_units: np.ndarray  # int64 [P, K], ledger units of each kind that some function of the profile takes at most
    chain_units: np.ndarray  # int64 [P, K]
    different: np.ndarray  # int64 [1], how many different ones
    request: np.ndarray  # int64 [PROBES, 3], profile, ingress, egress
    code: np.ndarray  # int64 [PROBES], the same as one number
    times: np.ndarray  # int64 [PROBES], how often it came
    share: np.ndarray  # float64 [PROBES], of the latest requests of its type
    demand: np.ndarray  # int64 [PROBES], its row of what follows by demand
    reached: np.ndarray  # bool [PROBES, N], nodes that it could use, were nothing used
    kept_code: np.ndarray  # int64 [KEPT], of requests of before, with network and rules; -1: none
    kept: np.ndarray  # bool [KEPT, N], ``reached`` of these
    free: np.ndarray  # int64 [PROBES, K], ledger units on these nodes' VMs that its largest function fits on
    close: np.ndarray  # float64 [PROBES], ``closeness`` with that
    profile: np.ndarray  # int64 [D]
    usable: np.ndarray  # int64 [D, N, K], ledger units on the VMs of every node that the largest function fits on
    drop: np.ndarray  # int64 [D, F, K], what each function of a walk takes of the usable units; scratch
    seen: np.ndarray  # int64 [Q], how many of the latest requests are of each type


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


def make_needs(tables: Tables, kinds: int, apart: bool) -> Needs:
    """``Needs`` for any network and request of ``tables``.

    Args:
        tables: the simulator's tables.
        kinds: K, so many kinds of resources are looked at, the first ones.
        apart: whether each different request is a demand of its own, else each service type is one.
    """
    networks, nodes, _, _ = tables.vm_capacity.shape
    services, functions = tables.services, tables.load.shape[1]
    demands = PROBES if apart else services
    side = np.zeros((networks, nodes, nodes), np.int16)
    queue = np.zeros(nodes, np.int64)
    for net in range(networks):
        _fill_sides(tables, net, side[net], queue)
    return Needs(
        apart=apart,
        side=side,
        largest_units=tables.load_units[:, :, :kinds].max(axis=1),
        chain_units=tables.load_units[:, :, :kinds].sum(axis=1),
        different=np.zeros(1, np.int64),
        request=np.zeros((PROBES, 3), np.int64),
        code=np.zeros(PROBES, np.int64),
        times=np.zeros(PROBES, np.int64),
        share=np.zeros(PROBES),
        demand=np.zeros(PROBES, np.int64),
        reached=np.zeros((PROBES, nodes), np.bool_),
        kept_code=np.full(KEPT, -1),
        kept=np.zeros((KEPT, nodes), np.bool_),
        free=np.zeros((PROBES, kinds), np.int64),
        close=np.zeros(PROBES),
        profile=np.arange(demands),
        usable=np.zeros((demands, nodes, kinds), np.int64),
        drop=np.zeros((demands, functions, kinds), np.int64),
        seen=np.zeros(services, np.int64),
    )


@part
def measure_needs(world, b, own):
    """Fill ``own`` (``Needs``) from the latest requests of environment b, the one in hand among them."""
    _collect(world, b, own)
    _measure_usable(world, b, own)
    nodes = world.tables.num_nodes[world.env[b].net]
    for i in range(own.different[0]):
        _find_reached(world, b, own, i)
        own.free[i] = 0
        for node in range(nodes):
            for kind in range(own.free.shape[1]):
                own.free[i, kind] += own.usable[own.demand[i], node, kind] * own.reached[i, node]
        own.share[i] = own.times[i] / own.seen[world.tables.service[own.request[i, 0]]]
        own.close[i] = closeness(requests_left(own, own.request[i, 0], own.free[i]))


@part
def _find_reached(world, b, own, i):
    """Fill ``reached`` of request i: as kept, or anew, and then it is kept in place of another."""
    rules, net = world.rules, world.env[b].net
    nodes = world.tables.num_nodes[net]
    code = (own.code[i] * world.tables.num_nodes.size + net) * 4 + rules.colocation * 2 + rules.distinct
    slot = code % own.kept_code.size
    if own.kept_code[slot] != code:
        request = (own.request[i, 0], own.request[i, 1], own.request[i, 2])
        for node in range(nodes):
            own.kept[slot, node] = _can_reach(world, b, own, request, node)
        own.kept_code[slot] = code
    for node in range(nodes):
        own.reached[i, node] = own.kept[slot, node]


@part
def count_demands(own):
    """How many demands there are now."""
    return own.different[0] if own.apart else own.profile.size


@part
def _measure_usable(world, b, own):
    tables, ledger, net = world.tables, world.ledger, world.env[b].net
    for node in range(tables.num_nodes[net]):
        for d in range(count_demands(own)):
            own.usable[d, node] = 0
            for vm in range(tables.vm_count[net, node]):
                if holds_largest(own, d, ledger.vm_offered[b, node, vm]):
                    for kind in range(own.usable.shape[2]):
                        own.usable[d, node, kind] += ledger.vm_offered[b, node, vm, kind]


@part
def holds_largest(own, d, free):
    """Whether a VM with ``free`` ledger units of each kind is of use for demand d: all of them, or none."""
    room = True
    for kind in range(own.largest_units.shape[1]):
        room = room and fits(free[kind], own.largest_units[own.profile[d], kind])
    return room


@part
def _collect(world, b, own):
    """The latest requests, each different one once."""
    arrivals, cursor = world.arrivals, world.env[b].cursor
    own.seen[:] = 0
    count = 0
    for r in range(max(0, cursor + 1 - PROBES), cursor + 1):
        profile = np.int64(arrivals.profile[b, r])
        ingress, egress = np.int64(arrivals.ingress[b, r]), np.int64(arrivals.egress[b, r])
        own.seen[world.tables.service[profile]] += 1
        ends = own.reached.shape[1] + 1
        code = (profile * ends + ingress + 1) * ends + egress + 1  # a free end is -1
        i = 0
        while i < count and own.code[i] != code:
            i += 1
        if i == count:
            own.code[i] = code
            own.request[i, 0], own.request[i, 1], own.request[i, 2] = profile, ingress, egress
            own.times[i] = 0
            own.demand[i] = i if own.apart else profile
            if own.apart:
                own.profile[i] = profile
            count += 1
        own.times[i] += 1
    own.different[0] = count


@part
def _can_reach(world, b, own, request, node):
    """Whether a request (profile, ingress, egress) could place a function on ``node``, were nothing used."""
    tables, net = world.tables, world.env[b].net
    profile, ingress, egress = request
    rate = tables.least_rate[profile]
    if ingress < 0 or egress < 0:  # it may begin or end there
        there = 0.0 if ingress < 0 else tables.delay_to[net, rate, ingress, node]
        there += 0.0 if egress < 0 else tables.delay_to[net, rate, node, egress]
        return there <= tables.tolerable_delay[profile]
    if node == egress:
        return True
    if not world.rules.distinct and own.side[net, egress, node] != own.side[net, egress, ingress]:
        return False
    if node == ingress and not (world.rules.colocation or world.rules.distinct):
        return False
    there = tables.delay_to[net, rate, ingress, node] + tables.delay_to[net, rate, node, egress]
    return there <= tables.tolerable_delay[profile]


@part
def requests_left(own, profile, free):
    """How many more requests of a profile fit into ``free`` ledger units of each kind; inf if it takes none."""
    room = np.inf
    for kind in range(own.chain_units.shape[1]):
        if own.chain_units[profile, kind] > 0:
            room = min(room, free[kind] / own.chain_units[profile, kind])
    return room


@part
def closeness(room):
    """How close a request is to finding no room, with room for so many more of it: 1 if there is none, 0 if all."""
    return 1.0 / (1.0 + room / FEW)


@part
def take_units(own, i, place, placed, left):
    """Ledger units of each kind, into ``left`` [K], that a walk leaves of what request i could use, by ``own.drop`` and
    its ``place`` int64 [F, 2]."""
    for kind in range(left.size):
        left[kind] = own.free[i, kind]
        for j in range(placed):
            left[kind] -= own.drop[own.demand[i], j, kind] * own.reached[i, place[j, 0]]
