"""The books: what walks and running requests hold, taken and given back to the bit."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import count_vms, link_resource, split_vm, vm_resource
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.view import show_share


@part
def change_vm(world, b, node, vm, amount):
    """Reserve ``amount`` ledger units of a VM (give back when negative)."""
    ledger, e = world.ledger, world.env[b]
    ledger.vm_reserved[b, node, vm] += amount
    e.vm_used += amount
    if not ledger.vm_failed[b, node, vm]:
        ledger.vm_offered[b, node, vm] -= amount
        resource = vm_resource(node, vm, ledger.vm_offered.shape[2])
        capacity = world.tables.vm_capacity[e.net, node, vm]
        show_share(world.seen.flat, b, resource, capacity, ledger.vm_offered[b, node, vm])


@part
def change_link(world, b, link, amount):
    """Reserve ``amount`` ledger units of a link (give back when negative)."""
    ledger, e = world.ledger, world.env[b]
    ledger.link_reserved[b, link] += amount
    e.link_used += amount
    if not ledger.link_failed[b, link]:
        ledger.link_offered[b, link] -= amount
        resource = link_resource(link, ledger.vm_offered.shape[1], ledger.vm_offered.shape[2])
        capacity = world.tables.link_capacity[e.net, link]
        show_share(world.seen.flat, b, resource, capacity, ledger.link_offered[b, link])


@part
def _hold(world, b, resource, amount):
    """Note what the walk has reserved, so that it can be given back."""
    walk, e = world.walk, world.env[b]
    walk.resource[b, e.entries] = resource
    walk.amount[b, e.entries] = amount
    e.entries += 1


@part
def reserve_step(world, b, step):
    """Reserve what a step takes of its link and, if it places a function, of its VM."""
    tables, e = world.tables, world.env[b]
    _, nodes, vms = world.ledger.vm_offered.shape
    if step.link >= 0:
        units = tables.rate_units[e.service]
        change_link(world, b, step.link, units)
        _hold(world, b, link_resource(step.link, nodes, vms), units)
    if step.places:
        units = tables.load_units[e.service, e.function]
        change_vm(world, b, step.node, step.vm, units)
        _hold(world, b, vm_resource(step.node, step.vm, vms), units)


@part
def set_failed(world, b, resource, failed):
    """A failed resource offers nothing; a repaired one offers what is not reserved."""
    ledger, tables, e = world.ledger, world.tables, world.env[b]
    _, nodes, vms = ledger.vm_offered.shape
    first_link = count_vms(nodes, vms)
    if resource < first_link:
        node, vm = split_vm(resource, vms)
        capacity = tables.vm_capacity[e.net, node, vm]
        ledger.vm_failed[b, node, vm] = failed
        ledger.vm_offered[b, node, vm] = 0 if failed else capacity - ledger.vm_reserved[b, node, vm]
        show_share(world.seen.flat, b, resource, capacity, ledger.vm_offered[b, node, vm])
    else:
        link = resource - first_link
        capacity = tables.link_capacity[e.net, link]
        ledger.link_failed[b, link] = failed
        ledger.link_offered[b, link] = 0 if failed else capacity - ledger.link_reserved[b, link]
        show_share(world.seen.flat, b, resource, capacity, ledger.link_offered[b, link])


@part
def _give_back(world, b, resource, amount):
    _, nodes, vms = world.ledger.vm_offered.shape
    first_link = count_vms(nodes, vms)
    if resource < first_link:
        node, vm = split_vm(resource, vms)
        change_vm(world, b, node, vm, -amount)
    else:
        change_link(world, b, resource - first_link, -amount)


@part
def release_walk(world, b):
    """A rejected walk gives back at once all that it had reserved."""
    walk = world.walk
    for k in range(world.env[b].entries):
        _give_back(world, b, walk.resource[b, k], walk.amount[b, k])


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
        running.entry_amount[b, entry] = walk.amount[b, k]
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
        _give_back(world, b, running.entry_resource[b, entry], running.entry_amount[b, entry])
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
    _, nodes, vms = ledger.vm_offered.shape
    for node in range(nodes):
        for vm in range(vms):
            ledger.vm_reserved[b, node, vm] = 0
            ledger.vm_failed[b, node, vm] = False
            ledger.vm_offered[b, node, vm] = tables.vm_capacity[e.net, node, vm]
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
