"""Algorithm 1: slots with their departures, repairs and failures, and the requests that arrive in them."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.simulator.books import end_record, set_failed
from nfv_torchrl.simulator.compiled import inlined, part
from nfv_torchrl.simulator.mask import write_mask
from nfv_torchrl.simulator.state import OUTCOME
from nfv_torchrl.simulator.view import show_request


@part
def _depart(world, b):
    """Every request whose departure slot has come leaves (Algorithm 1)."""
    slot = world.env[b].slot
    record = world.running.head[b, slot]
    while record != -1:
        record = end_record(world, b, record)
    world.running.head[b, slot] = -1


@part
def _depart_within(world, b):
    """Requests that leave in this slot, by the time that the next one comes, leave before it."""
    arrivals, running, e = world.arrivals, world.running, world.env[b]
    now = arrivals.time[b, e.cursor]
    before = -1
    record = running.head[b, e.slot + 1]  # a slot's departures are chained where all of them are over
    while record != -1:
        if arrivals.leaves[b, running.record_request[b, record]] > now:
            before = record
            record = running.record_next[b, record]
            continue
        record = end_record(world, b, record)
        if before == -1:
            running.head[b, e.slot + 1] = record
        else:
            running.record_next[b, before] = record


@part
def _uses(running, b, record, resource):
    entry = running.record_entry[b, record]
    while entry != -1:
        if running.entry_resource[b, entry] == resource:
            return True
        entry = running.entry_next[b, entry]
    return False


@part
def _interrupt(world, b, resource):
    """End every running request that uses a failed resource."""
    running, log, e = world.running, world.log, world.env[b]
    for slot in range(e.slot, e.horizon + 1):
        before = -1
        record = running.head[b, slot]
        while record != -1:
            if not _uses(running, b, record, resource):
                before = record
                record = running.record_next[b, record]
                continue
            if log.enabled:
                log.interrupted_at[b, running.record_request[b, record]] = e.slot
            world.outcome[b, OUTCOME.interrupted] += 1
            record = end_record(world, b, record)
            if before == -1:
                running.head[b, slot] = record
            else:
                running.record_next[b, before] = record


@inlined
def paper_service(e):
    """Index of the request's service among the paper's K, as the observation tells it."""
    return np.int64(np.rint(e.service_share * (e.services - 1)))


@part
def open_slot(world, b):
    """Start of a slot: departures, then this slot's repairs and failures in the timeline's order."""
    arrivals, e = world.arrivals, world.env[b]
    _depart(world, b)
    for service in range(e.services):
        world.walk.spent[b, service] = 0
    while e.event_cursor < e.num_events and arrivals.event_slot[b, e.event_cursor] <= e.slot:
        resource = arrivals.event_resource[b, e.event_cursor]
        up = arrivals.event_up[b, e.event_cursor]
        set_failed(world, b, resource, not up)
        if not up:
            _interrupt(world, b, resource)
        e.event_cursor += 1


@part
def used_vm_share(world, b):
    """Used share of all VM capacity, the mean over the kinds of resources."""
    total = 0.0
    kinds = world.ledger.vm_used.shape[1]
    for kind in range(kinds):
        total += world.ledger.vm_used[b, kind] / world.tables.vm_total[world.env[b].net, kind]
    return total / kinds


@part
def _close_slot(world, b):
    """End of a slot: its utilisation cost Phi_t and used shares count, unless it belongs to the warm-up."""
    tables, out, e = world.tables, world.outcome, world.env[b]
    if e.slot >= e.warmup:
        out[b, OUTCOME.slots_closed] += 1
        out[b, OUTCOME.slot_cost] += e.running_cost
        out[b, OUTCOME.slot_vm_use] += used_vm_share(world, b)
        out[b, OUTCOME.slot_link_use] += e.link_used / tables.link_total[e.net]
    e.slot += 1


@part
def next_request(world, b):
    """Move on to the request at the cursor, through as many slots as lie between, or to the end of the horizon."""
    e = world.env[b]
    due = np.int64(world.arrivals.slot[b, e.cursor]) if e.cursor < e.num_requests else e.horizon
    while e.slot < due:
        _close_slot(world, b)
        if e.slot < e.horizon:
            open_slot(world, b)
    if e.slot >= e.horizon:
        e.done = 1
        write_mask(world, b)
    else:
        if world.arrivals.time.shape[1] > 0:
            _depart_within(world, b)
        _begin_request(world, b)


@part
def _begin_request(world, b):
    arrivals, e = world.arrivals, world.env[b]
    e.profile = arrivals.profile[b, e.cursor]
    e.service = world.tables.service[e.profile]
    e.ingress = arrivals.ingress[b, e.cursor]
    e.egress = arrivals.egress[b, e.cursor]
    e.lifetime = arrivals.lifetime[b, e.cursor]
    e.service_share = arrivals.service_share[b, e.cursor]
    e.request_slot = e.slot
    e.node = e.ingress
    e.last_vm = 0
    e.function = 0
    e.steps = 0
    e.most_steps = world.rules.max_steps
    if world.rules.shared_steps:
        e.most_steps -= world.walk.spent[b, paper_service(e)]
    e.hops = 0
    e.elapsed = 0.0
    e.cost = 0.0
    e.entries = 0
    show_request(world, b)
    write_mask(world, b)
