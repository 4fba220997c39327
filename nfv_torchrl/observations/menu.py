"""What a policy sees of a request's menu: numbers of the network and the request, and a row for each walk offered.

Everything is a share, a ratio or a logarithm, so that one network with shared weights serves networks of any size.
Means over a whole network hide that all VMs one pair of nodes can reach are full. So the room left is also measured
where requests come from (``needs.py``): how many more of each of the latest requests fit, now and after each walk.

Where the service type does not tell what a request asks for, or its ends are free, numbers of its own follow
(``asked.py``), and of several kinds of resources the scarcest is described. Else it is the first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.observations.asked import ASKED, LEAST_RATIO, describe_asked, scarcest, usual_cost
from nfv_torchrl.observations.menu_layout import (
    MOST_REGRET,
    ROW,
    ROW_SERVICE,
    SERVICE,
    STATE,
    least_room,
    pow8,
    room_of,
)
from nfv_torchrl.observations.menu_rows import describe_links, describe_vms, describe_what_is_left, read_places
from nfv_torchrl.observations.needs import Needs, make_needs, measure_needs
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.state import World

LONGEST_STAY = 5.0
"""Lifetimes are seen up to this multiple of their mean."""
AT_ONCE = 0.5
"""Share of what a request of mean lifetime is charged for coming, however short it stays, as bid prices are learned.
The rest is in proportion to its lifetime.

What follows a request hardly tells a short stay from a long one, so what is learned is the price of a usual stay. A
policy that acts (``MenuPlanner``) charges for the stay alone, since a walk holds its share of the
network just as long. It charges several bid prices for a stay of mean length: with short stays preferred, one long stay
displaces many of them."""


class MenuView(NamedTuple):
    """What describing menus reads and writes while it works; one for each thread.

    K kinds of resources are looked at.
    """

    asked: bool  # whether requests are described by what they ask
    reference_load: np.ndarray  # float64 [K], ledger units: mean over profiles of the load of their chain
    reference_rate: float  # ledger units: mean over profiles
    rate_units: np.ndarray  # int64 [P], of the segment with the highest rate
    reference_traffic: float  # ledger units: mean over profiles of the sum over segments
    least_ratio: float  # of a demand to the mean, below which all are alike
    mean_cost: np.ndarray  # float64 [S, R], $ per Mcycles/s or unit of the kind
    mean_link_cost: np.ndarray  # float64 [S], $ per Mbit/s
    mean_units: np.ndarray  # float64 [S, K], ledger units of a VM
    needs: Needs
    cut: np.ndarray  # int64 [N], free on the links of the node
    ends: np.ndarray  # float64 [N], room on the links of the node if one of the latest requests ends there, else 1
    place: np.ndarray  # int64 [F, 2], node and VM of each function of a walk
    share: np.ndarray  # float64 [F], its share of the chain's load
    left: np.ndarray  # int64 [K]; scratch
    at_once: float  # of ``stay_of``
    per_stay: float
    most_nodes: int  # as so many a larger network is described


def describes_asked(world: World) -> bool:
    """Whether requests are described by what they ask: their type does not tell it, it is nothing of what is described
    of services (the first kind of resources, and links), or their ends are free."""
    tables = world.tables
    nothing = (tables.load[:, :, 0].sum(axis=1) == 0).any() or (tables.rate.max(axis=1) == 0).any()
    return bool(world.seen.demand or world.rules.free_ends or nothing)


def charges(per_stay: float | None) -> dict[str, float]:
    """How stays are charged, see ``stay_of``: in proportion by ``per_stay``, None: as bid prices are learned."""
    if per_stay is None:
        return {"at_once": AT_ONCE, "per_stay": 1.0 - AT_ONCE}
    return {"at_once": 0.0, "per_stay": float(per_stay)}


def make_menu_view(world: World, per_stay: float | None, most_nodes: int | None = None) -> MenuView:
    """``MenuView`` for any network and request of ``world``, with stays charged by ``charges(per_stay)``.

    Networks of more than ``most_nodes`` are described as having so many; None: all as they are.
    """
    tables, asked = world.tables, describes_asked(world)
    _, nodes, _, kinds = tables.vm_capacity.shape
    kinds = kinds if asked else 1
    functions = tables.load.shape[1]
    counts = np.maximum(tables.vm_count.sum(axis=1), 1)
    chain = tables.load_units[:, :, :kinds].sum(axis=1)
    rate = tables.rate_units.max(axis=1)
    return MenuView(
        asked=asked,
        reference_load=np.array([float(column.mean()) for column in chain.T]).clip(1.0),
        reference_rate=max(float(rate.mean()), 1.0),
        rate_units=rate,
        reference_traffic=max(float(tables.rate_units.sum(axis=1).mean()), 1.0),
        least_ratio=LEAST_RATIO if asked else 0.0,
        mean_cost=np.stack([each.sum(axis=(1, 2)) / counts for each in np.moveaxis(tables.vm_unit_cost, -1, 0)], -1),
        mean_link_cost=tables.link_unit_cost.sum(axis=1) / np.maximum(tables.num_links, 1),
        mean_units=tables.vm_total[:, :kinds] / counts[:, None],
        needs=make_needs(tables, kinds, asked),
        cut=np.zeros(nodes, np.int64),
        ends=np.zeros(nodes),
        place=np.zeros((functions, 2), np.int64),
        share=np.zeros(functions),
        left=np.zeros(kinds, np.int64),
        **charges(per_stay),
        most_nodes=nodes if most_nodes is None else most_nodes,
    )


@part
def stay_of(world, b, at_once, per_stay):
    """What the lifetime of the request in hand makes of its bid price: ``at_once``, and ``per_stay`` for each mean
    lifetime that it stays. 1 where lifetimes are hidden."""
    mean = world.mean_lifetime[b]
    if mean <= 0.0:
        return 1.0
    return at_once + per_stay * min(world.env[b].lifetime / mean, LONGEST_STAY)


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
def _describe_needs(world, own, state):
    """Fill the columns of each service, and ``ends``, from the latest requests."""
    needs = own.needs
    first = len(STATE)
    for q in range(needs.seen.size):
        at = first + q * len(SERVICE)
        state[at + SERVICE.vm_room] = 1.0
        state[at + SERVICE.vm_room_mean] = 0.0 if needs.seen[q] > 0 else 1.0
        state[at + SERVICE.link_room] = 1.0
    for i in range(needs.different[0]):
        q = world.tables.service[needs.request[i, 0]]
        at, share = first + q * len(SERVICE), needs.share[i]
        room = least_room(needs.free[i], own.reference_load)
        state[at + SERVICE.vm_room] = min(state[at + SERVICE.vm_room], room)
        state[at + SERVICE.vm_room_mean] += share * room
        state[at + SERVICE.close] += share * needs.close[i]
        for end in (needs.request[i, 1], needs.request[i, 2]):
            if end >= 0:
                own.ends[end] = room_of(own.cut[end], own.reference_rate)
                state[at + SERVICE.link_room] = min(state[at + SERVICE.link_room], own.ends[end])


@part
def _describe_state(world, b, own, menu, state):
    """Fill the columns of the network and the request."""
    tables, e = world.tables, world.env[b]
    net, profile = e.net, e.profile
    _, demand = scarcest(own, profile)
    used = 0.0
    for kind in range(own.reference_load.size):
        used = max(used, world.ledger.vm_used[b, kind] / max(tables.vm_total[net, kind], 1))
    state[STATE.demand] = demand
    state[STATE.stay] = stay_of(world, b, own.at_once, own.per_stay)
    state[STATE.log_demand] = 0.5 * np.log(demand)
    state[STATE.rate] = np.log(max(own.rate_units[profile] / own.reference_rate, own.least_ratio)) / 4.0
    if e.ingress >= 0 and e.egress >= 0:
        near = tables.delay_to[net, tables.least_rate[profile], e.ingress, e.egress]
        state[STATE.near] = near / tables.tolerable_delay[profile]
    state[STATE.vm_used] = used
    state[STATE.vm_used_pow8] = pow8(used)
    state[STATE.link_used] = e.link_used / tables.link_total[net]
    state[STATE.colocation] = 1.0 if world.rules.colocation else 0.0
    state[STATE.nodes] = np.log(min(tables.num_nodes[net], own.most_nodes)) / 5.0
    size = np.inf
    for kind in range(own.reference_load.size):
        size = min(size, max(own.mean_units[net, kind], 1.0) / own.reference_load[kind])
    state[STATE.vm_size] = np.log(size) / 5.0
    if menu.mask[b, 0]:
        state[STATE.least_cost] = np.log(max(menu.cost[b, 0], LEAST_COST) / usual_cost(world, b, own)) / 3.0
    state[STATE.ingress_room] = room_of(_cut_of(world, b, own, e.ingress), own.reference_rate)
    state[STATE.egress_room] = room_of(_cut_of(world, b, own, e.egress), own.reference_rate)
    if own.asked:
        describe_asked(world, b, own, state[state.size - len(ASKED) :])


@part
def _cut_of(world, b, own, node):
    """What is free on the links of a node; of a free end, on those of the node where it is most."""
    if node >= 0:
        return own.cut[node]
    most = np.int64(0)
    for other in range(world.tables.num_nodes[world.env[b].net]):
        most = max(most, own.cut[other])
    return most


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
    first = flat.size - levels * size
    for k in range(flat.size):
        flat[k] = 0.0
    e = world.env[b]
    if e.done == 1:
        return
    state = flat[:first]
    _measure_cuts(world, b, own)
    measure_needs(world, b, own.needs)
    _describe_needs(world, own, state)
    _describe_state(world, b, own, menu, state)
    fewest = 0
    for k in range(levels):
        if not menu.mask[b, k]:
            continue
        row = flat[first + k * size : first + (k + 1) * size]
        plan, steps = menu.action[b, k], menu.steps[b, k]
        placed = read_places(world, b, own, plan, steps)
        describe_vms(world, b, own, placed, row)
        describe_what_is_left(world, own, placed, row)
        hops = describe_links(world, b, own, plan, steps, row)
        if k == 0:
            fewest = hops
        state[STATE.offered_walks] += 1.0 / levels
        row[ROW.regret] = min(menu.cost[b, k] / max(menu.cost[b, 0], LEAST_COST) - 1.0, MOST_REGRET)
        row[ROW.delay] = menu.delay[b, k] / world.tables.tolerable_delay[e.profile]
        row[ROW.hops] = hops / 10.0
        row[ROW.more_hops] = (hops - fewest) / 10.0


@kernel
def describe_menus(world, rows, own, menu, flat):
    """``describe_menu`` for the environments ``rows`` int64 [R]; ``flat`` float32 [B, P]."""
    for k in range(rows.size):
        describe_menu(world, rows[k], own, menu, flat[rows[k]])
