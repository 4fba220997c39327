"""What a policy sees of one walk of a menu: what it takes and passes, and what it leaves to the latest requests."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.observations.asked import scarcest
from nfv_torchrl.observations.menu_layout import ROW, ROW_SERVICE, least_room, pow8, room_of
from nfv_torchrl.observations.needs import closeness, count_demands, holds_largest, requests_left, take_units
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.steps import find_link


@part
def read_places(world, b, own, plan, steps):
    """The placements of a walk into ``own.place``, and their shares of the load; how many."""
    vms = world.ledger.vm_offered.shape[2]
    profile = world.env[b].profile
    kind, _ = scarcest(own, profile)
    chain, functions = own.needs.chain_units[profile, kind], world.tables.chain_length[profile]
    count = 0
    for j in range(steps):
        node, vm, places = decode_action(plan[j], vms)
        if places:
            own.place[count, 0] = node
            own.place[count, 1] = vm
            own.share[count] = world.tables.load_units[profile, count, kind] / chain if chain > 0 else 1.0 / functions
            count += 1
    return count


@part
def _leave_units(world, b, own, i, placed):
    """Ledger units of each kind, into ``own.left``, that the walk leaves of the VM of its function ``i``; whether no
    function before stands there."""
    tables, profile = world.tables, world.env[b].profile
    node, vm = own.place[i, 0], own.place[i, 1]
    first = True
    for kind in range(own.left.size):
        own.left[kind] = world.ledger.vm_offered[b, node, vm, kind]
    for j in range(placed):
        if own.place[j, 0] == node and own.place[j, 1] == vm:
            first = first and j >= i
            for kind in range(own.left.size):
                own.left[kind] -= tables.load_units[profile, j, kind]
    return first


@part
def describe_vms(world, b, own, placed, row):
    """The columns of a walk's VMs; fills ``needs.drop``, too."""
    capacity, needs = world.tables.vm_capacity[world.env[b].net], own.needs
    row[ROW.vm_room_least] = 1.0
    for i in range(placed):
        node, vm, share = own.place[i, 0], own.place[i, 1], own.share[i]
        offered = world.ledger.vm_offered[b, node, vm]
        used = 0.0
        for kind in range(own.left.size):
            if capacity[node, vm, kind] > 0:
                used = max(used, 1.0 - offered[kind] / capacity[node, vm, kind])
        first = _leave_units(world, b, own, i, placed)
        row[ROW.vm_used] += share * used
        row[ROW.vm_used_pow16] += share * pow8(used * used)
        for d in range(count_demands(needs)):
            q = world.tables.service[needs.profile[d]]
            fitted, fit = holds_largest(needs, d, offered), holds_largest(needs, d, own.left)
            if not fit:
                weight = needs.times[d] / needs.seen[q] if needs.apart else 1.0
                row[len(ROW) + q * len(ROW_SERVICE) + ROW_SERVICE.closes] += share * weight
            for kind in range(own.left.size):
                now, then = offered[kind] if fitted else 0, own.left[kind] if fit else 0
                needs.drop[d, i, kind] = now - then if first else 0
        for kind in range(own.left.size):
            own.left[kind] = max(own.left[kind], 0)
        room = least_room(own.left, own.reference_load)
        row[ROW.vm_room] += share * room
        row[ROW.vm_room_least] = min(row[ROW.vm_room_least], room)


@part
def describe_what_is_left(world, own, placed, row):
    """The columns of a walk for each service: what it leaves the latest requests."""
    needs = own.needs
    for q in range(needs.seen.size):
        row[len(ROW) + q * len(ROW_SERVICE) + ROW_SERVICE.room_least] = 1.0
    for i in range(needs.different[0]):
        profile = needs.request[i, 0]
        q = world.tables.service[profile]
        at = len(ROW) + q * len(ROW_SERVICE)
        take_units(needs, i, own.place, placed, own.left)
        left = requests_left(needs, profile, own.left)
        closer = closeness(left) - needs.close[i]
        row[at + ROW_SERVICE.closer] += needs.share[i] * closer
        row[at + ROW_SERVICE.closer_most] = max(row[at + ROW_SERVICE.closer_most], closer)
        room = room_of(left, 1.0)
        row[at + ROW_SERVICE.room_least] = min(row[at + ROW_SERVICE.room_least], room)


@part
def describe_links(world, b, own, plan, steps, row):
    """The columns of a walk's links; how many hops it has."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    vms = ledger.vm_offered.shape[2]
    here = e.ingress
    hops, function = 0, 0
    row[ROW.link_room_least] = 1.0
    row[ROW.ends_room] = np.inf
    for end in (e.ingress, e.egress):
        if end >= 0:
            row[ROW.ends_room] = min(row[ROW.ends_room], own.ends[end])
    for j in range(steps):
        node, _, places = decode_action(plan[j], vms)
        if node != here and here >= 0:
            link = find_link(tables, e.net, here, node)
            rate = tables.rate_units[e.profile, function] if own.asked else own.rate_units[e.profile]
            left = max(ledger.link_offered[b, link] - rate, 0)
            used = 1.0 - ledger.link_offered[b, link] / tables.link_capacity[e.net, link]
            row[ROW.link_used] += used
            row[ROW.link_used_pow16] += pow8(used * used)
            row[ROW.link_room_least] = min(row[ROW.link_room_least], room_of(left, own.reference_rate))
            hops += 1
        if node != here:
            row[ROW.ends_room] = min(row[ROW.ends_room], own.ends[node])
        here = node
        function += places
    row[ROW.link_used] /= max(hops, 1)
    row[ROW.link_used_pow16] /= max(hops, 1)
    return hops
