"""What a policy sees of a request's menu: numbers of the network and the request, and a row for each walk offered.

Everything is a share, a ratio or a logarithm, so that one network with shared weights serves networks of any size.
Means over a whole network hide that all VMs one pair of nodes can reach are full. So the room left is also measured
where requests come from: for each of the latest requests, what is free on the VMs and links that it could have used.
Of several kinds of resources the first is described.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.steps import find_link, fits
from nfv_torchrl.simulator.tables import Tables

PROBES = 64
"""Latest requests, with the one in hand, that say where room is needed."""
LONGEST_STAY = 5.0
"""Lifetimes are seen up to this multiple of their mean."""
AT_ONCE = 0.5
"""Share of what a request of mean lifetime takes from others that it takes by coming, however short it stays: on a full
network even a short stay displaces the next requests. The rest is in proportion to its lifetime."""
MOST_REGRET = 5.0
"""Costs are seen up to this multiple above the least."""


class StateFeatures(NamedTuple):
    """Numbers of the network and the request."""

    demand: int  # load of the chain over the mean over services
    stay: int  # AT_ONCE, and the rest in proportion to the lifetime: see AT_ONCE; 1 where lifetimes are hidden
    log_demand: int
    rate: int  # log of the rate over the mean over services, over 4
    near: int  # least delay of hops from ingress to egress over the tolerable delay
    vm_used: int  # used share of all VMs
    vm_used_pow8: int
    link_used: int  # used share of all links
    colocation: int  # 1 where functions may share a node
    nodes: int  # log of their number, over 5
    vm_size: int  # log of the mean capacity of a VM over the reference load, over 5
    least_cost: int  # log of the cost of the cheapest walk over that of its load at mean prices, over 3
    offered_walks: int  # share of the walks that are offered
    ingress_room: int  # room on the links of the ingress
    egress_room: int  # and of the egress


class ServiceFeatures(NamedTuple):
    """Numbers of each service type, over those of its requests that are among the latest ones."""

    vm_room: int  # least room on VMs that a request can reach and that its largest function fits on
    vm_room_mean: int
    link_room: int  # least room on the links of one of its ends


class RowFeatures(NamedTuple):
    """Numbers of one walk. Means over its VMs are weighted by load."""

    regret: int  # cost over that of the cheapest walk, less 1, at most MOST_REGRET
    delay: int  # share of the tolerable delay
    hops: int  # a tenth of their number
    more_hops: int  # a tenth of those more than the cheapest walk has
    vm_used: int  # mean used share of its VMs
    vm_used_pow16: int
    vm_room: int  # mean room that it leaves on its VMs
    vm_room_least: int
    link_used: int  # mean used share of its links
    link_used_pow16: int
    link_room_least: int  # on its links
    ends_room: int  # least room on the links of a node that it passes and where one of the latest requests ends


class RowServiceFeatures(NamedTuple):
    """Numbers of one walk for each service type."""

    closes: int  # share of its load on VMs that it leaves too little of for the largest function of the type
    scarce: int  # mean, over its VMs, of the least room of a request of the type that can reach the VM


STATE = columns(StateFeatures)
SERVICE = columns(ServiceFeatures)
ROW = columns(RowFeatures)
ROW_SERVICE = columns(RowServiceFeatures)
FACTORS = 2
"""The first columns of the state, which a price is multiplied by; perceptrons see the others."""
SCALE = 8.0
"""Room is log(1 + what is free / reference) over this: 0 where nothing is left, 1 for 3000 references."""


class MenuShape(NamedTuple):
    """How a flat observation of a menu is laid out: ``state`` numbers, then ``row`` numbers for each of ``rows``."""

    state: int
    row: int
    rows: int

    @classmethod
    def of(cls, services: int, rows: int) -> MenuShape:
        """The layout for so many service types and walks."""
        state = len(STATE) + services * len(SERVICE)
        return cls(state, len(ROW) + services * len(ROW_SERVICE), rows)

    @property
    def size(self) -> int:
        """P, of the flat observation."""
        return self.state + self.rows * self.row


class MenuView(NamedTuple):
    """What describing menus reads and writes while it works; one for each thread."""

    reference_load: float  # ledger units: mean over services of the load of their chain
    reference_rate: float  # ledger units: mean over services
    rate_units: np.ndarray  # int64 [Q], of the segment with the highest rate
    chain_units: np.ndarray  # int64 [Q]
    largest_units: np.ndarray  # int64 [Q], of the largest function
    mean_cost: np.ndarray  # float64 [S], $ per Mcycles/s
    mean_units: np.ndarray  # float64 [S], ledger units of a VM
    side: np.ndarray  # int16 [S, N, N], by egress and node: which part the node is in when the egress is taken out
    usable: np.ndarray  # int64 [Q, N], free on VMs of the node that the largest function of a type fits on
    cut: np.ndarray  # int64 [N], free on the links of the node
    scarce: np.ndarray  # float64 [Q, N], least room of a request of the type that can reach the node
    ends: np.ndarray  # float64 [N], room on the links of the node if one of the latest requests ends there, else 1
    reached: np.ndarray  # bool [N], nodes that one of the latest requests could use
    place: np.ndarray  # int64 [F, 3], node, VM and ledger units of each function of a walk
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


def make_menu_view(tables: Tables) -> MenuView:
    """``MenuView`` for any network and service of ``tables``."""
    networks, nodes, _, _ = tables.vm_capacity.shape
    services, functions = tables.services, tables.load.shape[1]
    counts = np.maximum(tables.vm_count.sum(axis=1), 1)
    side = np.zeros((networks, nodes, nodes), np.int16)
    queue = np.zeros(nodes, np.int64)
    for net in range(networks):
        _fill_sides(tables, net, side[net], queue)
    chain = tables.load_units[:services, :, 0].sum(axis=1)
    rate = tables.rate_units[:services].max(axis=1)
    return MenuView(
        reference_load=float(chain.mean()),
        reference_rate=float(rate.mean()),
        rate_units=rate,
        chain_units=chain,
        largest_units=tables.load_units[:services, :, 0].max(axis=1),
        mean_cost=tables.vm_unit_cost[..., 0].sum(axis=(1, 2)) / counts,
        mean_units=tables.vm_total[:, 0] / counts,
        side=side,
        usable=np.zeros((services, nodes), np.int64),
        cut=np.zeros(nodes, np.int64),
        scarce=np.zeros((services, nodes)),
        ends=np.zeros(nodes),
        reached=np.zeros(nodes, np.bool_),
        place=np.zeros((functions, 3), np.int64),
        seen=np.zeros(services, np.int64),
    )


@part
def _room(free, reference):
    return np.log(1.0 + free / reference) / SCALE


@part
def _pow8(x):
    x = x * x
    x = x * x
    return x * x


@part
def _measure_nodes(world, b, own):
    """Fill ``usable`` and ``cut``; forget what requests needed before."""
    tables, ledger, net = world.tables, world.ledger, world.env[b].net
    for node in range(tables.num_nodes[net]):
        for q in range(own.largest_units.size):
            own.usable[q, node] = 0
            own.scarce[q, node] = 1.0
            for vm in range(tables.vm_count[net, node]):
                here = ledger.vm_offered[b, node, vm, 0]
                if fits(here, own.largest_units[q]):
                    own.usable[q, node] += here
        own.ends[node] = 1.0
        own.cut[node] = 0
        for k in range(tables.degree[net, node]):
            own.cut[node] += ledger.link_offered[b, tables.neighbour_link[net, node, k]]


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
def _measure_requests(world, b, own, state):
    """Fill the columns of each service, ``scarce`` and ``ends``, from the latest requests and the one in hand."""
    arrivals, e = world.arrivals, world.env[b]
    nodes = world.tables.num_nodes[e.net]
    first = len(STATE)
    for known in range(own.seen.size):
        own.seen[known] = 0
        state[first + known * len(SERVICE) + SERVICE.vm_room] = 1.0
        state[first + known * len(SERVICE) + SERVICE.vm_room_mean] = 0.0
        state[first + known * len(SERVICE) + SERVICE.link_room] = 1.0
    for r in range(max(0, e.cursor + 1 - PROBES), e.cursor + 1):
        q = np.int64(arrivals.profile[b, r])
        ingress, egress = np.int64(arrivals.ingress[b, r]), np.int64(arrivals.egress[b, r])
        request = (q, ingress, egress)
        free = 0
        for node in range(nodes):
            own.reached[node] = _can_reach(world, b, own, request, node)
            free += own.usable[q, node] * own.reached[node]
        room = _room(free, own.reference_load)
        for node in range(nodes):
            if own.reached[node]:
                own.scarce[q, node] = min(own.scarce[q, node], room)
        at = first + q * len(SERVICE)
        own.seen[q] += 1
        state[at + SERVICE.vm_room] = min(state[at + SERVICE.vm_room], room)
        state[at + SERVICE.vm_room_mean] += room
        for end in (ingress, egress):
            own.ends[end] = _room(own.cut[end], own.reference_rate)
            state[at + SERVICE.link_room] = min(state[at + SERVICE.link_room], own.ends[end])
    for q in range(own.seen.size):
        at = first + q * len(SERVICE) + SERVICE.vm_room_mean
        state[at] = state[at] / own.seen[q] if own.seen[q] > 0 else 1.0


@part
def _describe_state(world, b, own, menu, state):
    """Fill the columns of the network and the request."""
    tables, e = world.tables, world.env[b]
    net, service = e.net, e.service
    mean = world.mean_lifetime[b]
    stay = AT_ONCE + (1.0 - AT_ONCE) * min(e.lifetime / mean, LONGEST_STAY) if mean > 0.0 else 1.0
    demand = own.chain_units[service] / own.reference_load
    used = world.ledger.vm_used[b, 0] / tables.vm_total[net, 0]
    state[STATE.demand] = demand
    state[STATE.stay] = stay
    state[STATE.log_demand] = 0.5 * np.log(demand)
    state[STATE.rate] = np.log(own.rate_units[service] / own.reference_rate) / 4.0
    near = tables.delay_to[net, tables.least_rate[service], e.ingress, e.egress]
    state[STATE.near] = near / tables.tolerable_delay[service]
    state[STATE.vm_used] = used
    state[STATE.vm_used_pow8] = _pow8(used)
    state[STATE.link_used] = e.link_used / tables.link_total[net]
    state[STATE.colocation] = 1.0 if world.rules.colocation else 0.0
    state[STATE.nodes] = np.log(tables.num_nodes[net]) / 5.0
    state[STATE.vm_size] = np.log(own.mean_units[net] / own.reference_load) / 5.0
    if menu.mask[b, 0]:
        usual = own.mean_cost[net] * tables.load[service, :, 0].sum()
        state[STATE.least_cost] = np.log(max(menu.cost[b, 0], LEAST_COST) / usual) / 3.0
    state[STATE.ingress_room] = _room(own.cut[e.ingress], own.reference_rate)
    state[STATE.egress_room] = _room(own.cut[e.egress], own.reference_rate)


@part
def _read_places(world, b, own, plan, steps):
    """The placements of a walk into ``own.place``; how many."""
    vms = world.ledger.vm_offered.shape[2]
    count = 0
    for j in range(steps):
        node, vm, places = decode_action(plan[j], vms)
        if places:
            own.place[count, 0] = node
            own.place[count, 1] = vm
            own.place[count, 2] = world.tables.load_units[world.env[b].service, count, 0]
            count += 1
    return count


@part
def _describe_vms(world, b, own, placed, row):
    """The columns of a walk's VMs."""
    ledger, capacity, services = world.ledger, world.tables.vm_capacity, own.largest_units.size
    net = world.env[b].net
    chain = own.chain_units[world.env[b].service]
    row[ROW.vm_room_least] = 1.0
    for i in range(placed):
        node, vm = own.place[i, 0], own.place[i, 1]
        share = own.place[i, 2] / chain
        left = ledger.vm_offered[b, node, vm, 0]
        used = 1.0 - left / capacity[net, node, vm, 0]
        for j in range(placed):
            if own.place[j, 0] == node and own.place[j, 1] == vm:
                left -= own.place[j, 2]
        row[ROW.vm_used] += share * used
        row[ROW.vm_used_pow16] += share * _pow8(used * used)
        room = _room(max(left, 0), own.reference_load)
        row[ROW.vm_room] += share * room
        row[ROW.vm_room_least] = min(row[ROW.vm_room_least], room)
        for q in range(services):
            at = len(ROW) + q * len(ROW_SERVICE)
            row[at + ROW_SERVICE.scarce] += share * own.scarce[q, node]
            if not fits(left, own.largest_units[q]):
                row[at + ROW_SERVICE.closes] += share


@part
def _describe_links(world, b, own, plan, steps, row):
    """The columns of a walk's links; how many hops it has."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    vms = ledger.vm_offered.shape[2]
    here = e.ingress
    hops = 0
    row[ROW.link_room_least] = 1.0
    row[ROW.ends_room] = min(own.ends[e.ingress], own.ends[e.egress])
    for j in range(steps):
        node, _, _ = decode_action(plan[j], vms)
        if node == here:
            continue
        link = find_link(tables, e.net, here, node)
        left = max(ledger.link_offered[b, link] - own.rate_units[e.service], 0)
        used = 1.0 - ledger.link_offered[b, link] / tables.link_capacity[e.net, link]
        row[ROW.link_used] += used
        row[ROW.link_used_pow16] += _pow8(used * used)
        row[ROW.link_room_least] = min(row[ROW.link_room_least], _room(left, own.reference_rate))
        row[ROW.ends_room] = min(row[ROW.ends_room], own.ends[node])
        hops += 1
        here = node
    row[ROW.link_used] /= max(hops, 1)
    row[ROW.link_used_pow16] /= max(hops, 1)
    return hops


@part
def describe_menu(world, b, own, menu, flat):
    """Describe the menu of environment b.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``MenuView`` of the world's tables.
        menu: ``Menu``, made of what the world is now.
        flat: receives the numbers, float32 [P] as ``MenuShape`` says; rows that are not offered are zeros.
    """
    services, levels = own.largest_units.size, menu.steps.shape[1]
    size = len(ROW) + services * len(ROW_SERVICE)
    first = len(STATE) + services * len(SERVICE)
    for k in range(flat.size):
        flat[k] = 0.0
    e = world.env[b]
    if e.done == 1:
        return
    state = flat[:first]
    _measure_nodes(world, b, own)
    _measure_requests(world, b, own, state)
    _describe_state(world, b, own, menu, state)
    fewest = 0
    for k in range(levels):
        if not menu.mask[b, k]:
            continue
        row = flat[first + k * size : first + (k + 1) * size]
        plan, steps = menu.action[b, k], menu.steps[b, k]
        placed = _read_places(world, b, own, plan, steps)
        _describe_vms(world, b, own, placed, row)
        hops = _describe_links(world, b, own, plan, steps, row)
        if k == 0:
            fewest = hops
        state[STATE.offered_walks] += 1.0 / levels
        row[ROW.regret] = min(menu.cost[b, k] / max(menu.cost[b, 0], LEAST_COST) - 1.0, MOST_REGRET)
        row[ROW.delay] = menu.delay[b, k] / world.tables.tolerable_delay[e.service]
        row[ROW.hops] = hops / 10.0
        row[ROW.more_hops] = (hops - fewest) / 10.0


@kernel
def describe_menus(world, rows, own, menu, flat):
    """``describe_menu`` for the environments ``rows`` int64 [R]; ``flat`` float32 [B, P]."""
    for k in range(rows.size):
        describe_menu(world, rows[k], own, menu, flat[rows[k]])
