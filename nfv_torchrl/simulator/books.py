"""The books: what walks and running requests hold, taken and given back to the bit."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import count_vms, link_resource, split_use, split_vm, use_of, vm_resource
from nfv_torchrl.simulator.compiled import inlined, part
from nfv_torchrl.simulator.view import show_share


@inlined
def change_vm(world, b, node, vm, use, sign):
    """Reserve what a function takes of a VM (give it back with ``sign`` -1); ``use``: its profile and place there."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    profile, function = use
    _, _, vms, kinds = ledger.vm_offered.shape
    for kind in range(kinds):
        amount = sign * tables.load_units[profile, function, kind]
        ledger.vm_reserved[b, node, vm, kind] += amount
        ledger.vm_used[b, kind] += amount
        if not ledger.vm_failed[b, node, vm]:
            ledger.vm_offered[b, node, vm, kind] -= amount
            place = kinds * vm_resource(node, vm, vms) + kind
            capacity = tables.vm_capacity[e.net, node, vm, kind]
            show_share(world.seen.flat, b, place, capacity, ledger.vm_offered[b, node, vm, kind])


@inlined
def change_link(world, b, link, use, sign):
    """Reserve what a segment takes of a link (give it back with ``sign`` -1); ``use``: its profile and place there."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    profile, segment = use
    amount = sign * tables.rate_units[profile, segment]
    ledger.link_reserved[b, link] += amount
    e.link_used += amount
    if not ledger.link_failed[b, link]:
        ledger.link_offered[b, link] -= amount
        _, nodes, vms, kinds = ledger.vm_offered.shape
        place = kinds * count_vms(nodes, vms) + link
        show_share(world.seen.flat, b, place, tables.link_capacity[e.net, link], ledger.link_offered[b, link])


@inlined
def _hold(world, b, resource):
    """Note what the walk has reserved with its next function, or on the way there, so that it can be given back."""
    walk, e = world.walk, world.env[b]
    walk.resource[b, e.entries] = resource
    walk.use[b, e.entries] = use_of(e.profile, e.function, world.tables.load_units.shape[1])
    e.entries += 1


@inlined
def reserve_step(world, b, step):
    """Reserve what a step takes of its link and, if it places a function, of its VM."""
    e = world.env[b]
    _, nodes, vms, _ = world.ledger.vm_offered.shape
    use = e.profile, e.function
    if step.link >= 0:
        change_link(world, b, step.link, use, 1)
        _hold(world, b, link_resource(step.link, nodes, vms))
    if step.places:
        change_vm(world, b, step.node, step.vm, use, 1)
        _hold(world, b, vm_resource(step.node, step.vm, vms))


@part
def set_failed(world, b, resource, failed):
    """A failed resource offers nothing; a repaired one offers what is not reserved."""
    ledger, tables, e = world.ledger, world.tables, world.env[b]
    _, nodes, vms, kinds = ledger.vm_offered.shape
    first_link = count_vms(nodes, vms)
    if resource < first_link:
        node, vm = split_vm(resource, vms)
        ledger.vm_failed[b, node, vm] = failed
        for kind in range(kinds):
            capacity = tables.vm_capacity[e.net, node, vm, kind]
            ledger.vm_offered[b, node, vm, kind] = 0 if failed else capacity - ledger.vm_reserved[b, node, vm, kind]
            place = kinds * resource + kind
            show_share(world.seen.flat, b, place, capacity, ledger.vm_offered[b, node, vm, kind])
    else:
        link = resource - first_link
        capacity = tables.link_capacity[e.net, link]
        ledger.link_failed[b, link] = failed
        ledger.link_offered[b, link] = 0 if failed else capacity - ledger.link_reserved[b, link]
        show_share(world.seen.flat, b, kinds * first_link + link, capacity, ledger.link_offered[b, link])


@inlined
def _give_back(world, b, resource, use):
    """Give back what a part of a request has reserved; ``use``: which, as ``use_of`` has it."""
    _, nodes, vms, _ = world.ledger.vm_offered.shape
    use = split_use(use, world.tables.load_units.shape[1])
    first_link = count_vms(nodes, vms)
    if resource < first_link:
        node, vm = split_vm(resource, vms)
        change_vm(world, b, node, vm, use, -1)
    else:
        change_link(world, b, resource - first_link, use, -1)


@part
def release_walk(world, b):
    """A rejected walk gives back at once all that it had reserved."""
    walk = world.walk
    for k in range(world.env[b].entries):
        _give_back(world, b, np.int64(walk.resource[b, k]), np.int64(walk.use[b, k]))


@part
def keep_running(world, b):
    """Keep an accepted walk's reservations until its departure."""
    running, walk, e = world.running, world.walk, world.env[b]
    record = e.free_record
    e.free_record = running.record_next[b, record]
    e.free_records -= 1
    first = -1
    for k in range(e.entries):
        entry = e.free_entry
        e.free_entry = running.entry_next[b, entry]
        running.entry_resource[b, entry] = walk.resource[b, k]
        running.entry_use[b, entry] = walk.use[b, k]
        running.entry_next[b, entry] = first
        first = entry
    e.free_entries -= e.entries
    leaves = min(np.int64(world.arrivals.departure[b, e.cursor]), e.horizon)
    running.record_entry[b, record] = first
    running.record_request[b, record] = e.cursor
    running.record_cost[b, record] = e.cost
    running.record_next[b, record] = running.head[b, leaves]
    running.head[b, leaves] = record
    e.running_cost += e.cost
    e.num_running += 1


@part
def end_record(world, b, record):
    """Give back what a running request holds and free its record. Returns the record that followed it."""
    running, e = world.running, world.env[b]
    entry = running.record_entry[b, record]
    while entry != -1:
        _give_back(world, b, np.int64(running.entry_resource[b, entry]), np.int64(running.entry_use[b, entry]))
        following = running.entry_next[b, entry]
        running.entry_next[b, entry] = e.free_entry
        e.free_entry = entry
        e.free_entries += 1
        entry = following
    e.num_running -= 1
    # Sums of floats drift; an empty network costs exactly nothing.
    e.running_cost = e.running_cost - running.record_cost[b, record] if e.num_running > 0 else 0.0
    after = running.record_next[b, record]
    running.record_next[b, record] = e.free_record
    e.free_record = record
    e.free_records += 1
    return after


@part
def empty_network(world, b):
    """Put the books, pools and counters of environment b back to an idle network."""
    tables, ledger, running, e = world.tables, world.ledger, world.running, world.env[b]
    _, nodes, vms, kinds = ledger.vm_offered.shape
    for node in range(nodes):
        for vm in range(vms):
            ledger.vm_failed[b, node, vm] = False
            for kind in range(kinds):
                ledger.vm_reserved[b, node, vm, kind] = 0
                ledger.vm_offered[b, node, vm, kind] = tables.vm_capacity[e.net, node, vm, kind]
    for kind in range(kinds):
        ledger.vm_used[b, kind] = 0
    for link in range(ledger.link_offered.shape[1]):
        ledger.link_reserved[b, link] = 0
        ledger.link_failed[b, link] = False
        ledger.link_offered[b, link] = tables.link_capacity[e.net, link]
    for k in range(world.seen.flat.shape[1]):
        world.seen.flat[b, k] = 0.0
    for slot in range(running.head.shape[1]):
        running.head[b, slot] = -1
    for pool in (running.record_next, running.entry_next):
        size = pool.shape[1]
        for k in range(size):
            pool[b, k] = k + 1 if k + 1 < size else -1
    e.free_record = 0
    e.free_entry = 0
    e.free_records = running.record_next.shape[1]
    e.free_entries = running.entry_next.shape[1]
