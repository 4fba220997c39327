"""What a policy sees of a request's menu: numbers of the network and the request, and a row for each walk offered.

Everything is a share, a ratio or a logarithm, so that one network with shared weights serves networks of any size.
Means over a whole network hide that all VMs one pair of nodes can reach are full. So the room left is also measured
where requests come from (``needs.py``): how many more of each of the latest requests fit, now and after each walk.
Of several kinds of resources the first is described.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.observations.needs import Needs, closeness, make_needs, measure_needs, taken_units, usable_units
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.steps import find_link, fits
from nfv_torchrl.simulator.tables import Tables

LONGEST_STAY = 5.0
"""Lifetimes are seen up to this multiple of their mean."""
AT_ONCE = 0.5
"""Share of what a request of mean lifetime is charged for coming, however short it stays, as bid prices are learned.
The rest is in proportion to its lifetime.

What follows a request hardly tells a short stay from a long one, so what is learned is the price of a usual stay. A
policy that acts (``MenuPlanner``) charges for the stay alone, since a walk holds its share of the
network just as long. It charges several bid prices for a stay of mean length: with short stays preferred, one long stay
displaces many of them."""
MOST_REGRET = 5.0
"""Costs are seen up to this multiple above the least."""


class StateFeatures(NamedTuple):
    """Numbers of the network and the request."""

    demand: int  # load of the chain over the mean over services
    stay: int  # what the lifetime makes of a bid price, see ``stay_of``; 1 where lifetimes are hidden
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
    close: int  # mean closeness to finding no room: 1 where nothing is left, 1/2 where FEW more requests fit


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
    closer: int  # by how much it raises the mean closeness to finding no room, see ServiceFeatures
    closer_most: int  # by how much that of the request that it raises most
    room_least: int  # room, in requests of the type, that it leaves the one with the least


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
    mean_cost: np.ndarray  # float64 [S], $ per Mcycles/s
    mean_units: np.ndarray  # float64 [S], ledger units of a VM
    needs: Needs
    cut: np.ndarray  # int64 [N], free on the links of the node
    ends: np.ndarray  # float64 [N], room on the links of the node if one of the latest requests ends there, else 1
    place: np.ndarray  # int64 [F, 3], node, VM and ledger units of each function of a walk
    at_once: float  # of ``stay_of``
    per_stay: float


def charges(per_stay: float | None) -> dict[str, float]:
    """How stays are charged, see ``stay_of``: in proportion by ``per_stay``, None: as bid prices are learned."""
    if per_stay is None:
        return {"at_once": AT_ONCE, "per_stay": 1.0 - AT_ONCE}
    return {"at_once": 0.0, "per_stay": float(per_stay)}


def make_menu_view(tables: Tables, per_stay: float | None) -> MenuView:
    """``MenuView`` for any network and service of ``tables``, with stays charged by ``charges(per_stay)``."""
    _, nodes, _, _ = tables.vm_capacity.shape
    services, functions = tables.services, tables.load.shape[1]
    counts = np.maximum(tables.vm_count.sum(axis=1), 1)
    chain = tables.load_units[:services, :, 0].sum(axis=1)
    rate = tables.rate_units[:services].max(axis=1)
    return MenuView(
        reference_load=float(chain.mean()),
        reference_rate=float(rate.mean()),
        rate_units=rate,
        mean_cost=tables.vm_unit_cost[..., 0].sum(axis=(1, 2)) / counts,
        mean_units=tables.vm_total[:, 0] / counts,
        needs=make_needs(tables),
        cut=np.zeros(nodes, np.int64),
        ends=np.zeros(nodes),
        place=np.zeros((functions, 3), np.int64),
        **charges(per_stay),
    )


@part
def _room(free, reference):
    return np.log(1.0 + free / reference) / SCALE


@part
def stay_of(world, b, at_once, per_stay):
    """What the lifetime of the request in hand makes of its bid price: ``at_once``, and ``per_stay`` for each mean
    lifetime that it stays. 1 where lifetimes are hidden."""
    mean = world.mean_lifetime[b]
    if mean <= 0.0:
        return 1.0
    return at_once + per_stay * min(world.env[b].lifetime / mean, LONGEST_STAY)


@part
def pow8(x):
    """x to the power of eight: near 0 but where a share is nearly 1."""
    x = x * x
    x = x * x
    return x * x


@part
def _measure_cuts(world, b, own):
    """Fill ``cut``; forget where the requests before ended."""
    tables, net = world.tables, world.env[b].net
    for node in range(tables.num_nodes[net]):
        own.ends[node] = 1.0
        own.cut[node] = 0
        for k in range(tables.degree[net, node]):
            own.cut[node] += world.ledger.link_offered[b, tables.neighbour_link[net, node, k]]


@part
def _describe_needs(own, state):
    """Fill the columns of each service, and ``ends``, from the latest requests."""
    needs = own.needs
    first = len(STATE)
    for q in range(needs.seen.size):
        at = first + q * len(SERVICE)
        state[at + SERVICE.vm_room] = 1.0
        state[at + SERVICE.vm_room_mean] = 0.0 if needs.seen[q] > 0 else 1.0
        state[at + SERVICE.link_room] = 1.0
    for i in range(needs.different[0]):
        q = needs.request[i, 0]
        at, share = first + q * len(SERVICE), needs.times[i] / needs.seen[q]
        room = _room(needs.free[i], own.reference_load)
        state[at + SERVICE.vm_room] = min(state[at + SERVICE.vm_room], room)
        state[at + SERVICE.vm_room_mean] += share * room
        state[at + SERVICE.close] += share * closeness(needs, i, needs.free[i])
        for end in (needs.request[i, 1], needs.request[i, 2]):
            own.ends[end] = _room(own.cut[end], own.reference_rate)
            state[at + SERVICE.link_room] = min(state[at + SERVICE.link_room], own.ends[end])


@part
def _describe_state(world, b, own, menu, state):
    """Fill the columns of the network and the request."""
    tables, e = world.tables, world.env[b]
    net, service = e.net, e.service
    demand = own.needs.chain_units[service] / own.reference_load
    used = world.ledger.vm_used[b, 0] / tables.vm_total[net, 0]
    state[STATE.demand] = demand
    state[STATE.stay] = stay_of(world, b, own.at_once, own.per_stay)
    state[STATE.log_demand] = 0.5 * np.log(demand)
    state[STATE.rate] = np.log(own.rate_units[service] / own.reference_rate) / 4.0
    near = tables.delay_to[net, tables.least_rate[service], e.ingress, e.egress]
    state[STATE.near] = near / tables.tolerable_delay[service]
    state[STATE.vm_used] = used
    state[STATE.vm_used_pow8] = pow8(used)
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
    """The columns of a walk's VMs; fills ``needs.drop``, too."""
    ledger, capacity, needs = world.ledger, world.tables.vm_capacity, own.needs
    net = world.env[b].net
    chain = needs.chain_units[world.env[b].service]
    row[ROW.vm_room_least] = 1.0
    for i in range(placed):
        node, vm = own.place[i, 0], own.place[i, 1]
        share = own.place[i, 2] / chain
        offered = ledger.vm_offered[b, node, vm, 0]
        used = 1.0 - offered / capacity[net, node, vm, 0]
        left, first = offered, True
        for j in range(placed):
            if own.place[j, 0] == node and own.place[j, 1] == vm:
                left -= own.place[j, 2]
                first = first and j >= i
        row[ROW.vm_used] += share * used
        row[ROW.vm_used_pow16] += share * pow8(used * used)
        room = _room(max(left, 0), own.reference_load)
        row[ROW.vm_room] += share * room
        row[ROW.vm_room_least] = min(row[ROW.vm_room_least], room)
        for q in range(needs.seen.size):
            if not fits(left, needs.largest_units[q]):
                row[len(ROW) + q * len(ROW_SERVICE) + ROW_SERVICE.closes] += share
            needs.drop[q, i] = usable_units(needs, q, offered) - usable_units(needs, q, left) if first else 0


@part
def _describe_what_is_left(own, placed, row):
    """The columns of a walk for each service: what it leaves the latest requests."""
    needs = own.needs
    for q in range(needs.seen.size):
        row[len(ROW) + q * len(ROW_SERVICE) + ROW_SERVICE.room_least] = 1.0
    for i in range(needs.different[0]):
        q = needs.request[i, 0]
        at = len(ROW) + q * len(ROW_SERVICE)
        left = needs.free[i] - taken_units(needs, i, own.place, placed)
        closer = closeness(needs, i, left) - closeness(needs, i, needs.free[i])
        row[at + ROW_SERVICE.closer] += needs.times[i] / needs.seen[q] * closer
        row[at + ROW_SERVICE.closer_most] = max(row[at + ROW_SERVICE.closer_most], closer)
        room = _room(left, needs.chain_units[q])
        row[at + ROW_SERVICE.room_least] = min(row[at + ROW_SERVICE.room_least], room)


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
        row[ROW.link_used_pow16] += pow8(used * used)
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
    services, levels = own.needs.seen.size, menu.steps.shape[1]
    size = len(ROW) + services * len(ROW_SERVICE)
    first = len(STATE) + services * len(SERVICE)
    for k in range(flat.size):
        flat[k] = 0.0
    e = world.env[b]
    if e.done == 1:
        return
    state = flat[:first]
    _measure_cuts(world, b, own)
    measure_needs(world, b, own.needs)
    _describe_needs(own, state)
    _describe_state(world, b, own, menu, state)
    fewest = 0
    for k in range(levels):
        if not menu.mask[b, k]:
            continue
        row = flat[first + k * size : first + (k + 1) * size]
        plan, steps = menu.action[b, k], menu.steps[b, k]
        placed = _read_places(world, b, own, plan, steps)
        _describe_vms(world, b, own, placed, row)
        _describe_what_is_left(own, placed, row)
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
