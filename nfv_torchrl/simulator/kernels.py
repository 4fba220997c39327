"""The rules of the model, compiled: Algorithm 1 (departures, failures) and Algorithm 3 (one request, step by step).

Plain loops over arrays, one environment at a time; no randomness and no allocation inside. A step touches one VM, one
link, the mask of one node and a few numbers of the observation, so its cost hardly depends on the network's size.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from nfv_torchrl.simulator.reasons import NO_REASON, Reason
from nfv_torchrl.simulator.state import (
    ACCEPTED,
    DONE,
    INTERRUPTED,
    PASSED,
    REASON,
    REQUEST_COST,
    REQUEST_DELAY,
    REQUEST_DONE,
    REQUEST_HOPS,
    REQUEST_SLOT,
    SERVICE,
    SLOT_COST,
    SLOT_LINK_USE,
    SLOT_VM_USE,
    SLOTS_CLOSED,
    STEP_COST,
)
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

SHARE_LEVELS = 1000
"""I: levels of the used share in the observation (section "Network States")."""

LINK_CAPACITY = int(Reason.LINK_CAPACITY)
VM_CAPACITY = int(Reason.VM_CAPACITY)
DELAY = int(Reason.DELAY)
STEP_LIMIT = int(Reason.STEP_LIMIT)
NO_FEASIBLE_ACTION = int(Reason.NO_FEASIBLE_ACTION)
REJECTED_BY_POLICY = int(Reason.REJECTED_BY_POLICY)
INVALID_ACTION = int(Reason.INVALID_ACTION)
PASSES = -1


# ---------------------------------------------------------------------------------------------------- the books


@njit(cache=True, _nrt=False)
def _show_share(flat, b, resource, capacity, offered):
    """Used share of a resource in the observation: floor(I (capacity - offered) / capacity) / I."""
    flat[b, resource] = ((capacity - offered) * SHARE_LEVELS // capacity) / SHARE_LEVELS


@njit(cache=True, _nrt=False)
def _change_vm(tables, ledger, env, flat, b, node, vm, amount):
    """Reserve ``amount`` ledger units of a VM (give back when negative)."""
    e = env[b]
    ledger.vm_reserved[b, node, vm] += amount
    e.vm_used += amount
    if not ledger.vm_failed[b, node, vm]:
        ledger.vm_offered[b, node, vm] -= amount
        vms = ledger.vm_offered.shape[2]
        capacity = tables.vm_capacity[e.net, node, vm]
        _show_share(flat, b, node * vms + vm, capacity, ledger.vm_offered[b, node, vm])


@njit(cache=True, _nrt=False)
def _change_link(tables, ledger, env, flat, b, link, amount):
    """Reserve ``amount`` ledger units of a link (give back when negative)."""
    e = env[b]
    ledger.link_reserved[b, link] += amount
    e.link_used += amount
    if not ledger.link_failed[b, link]:
        ledger.link_offered[b, link] -= amount
        first = ledger.vm_offered.shape[1] * ledger.vm_offered.shape[2]
        _show_share(flat, b, first + link, tables.link_capacity[e.net, link], ledger.link_offered[b, link])


@njit(cache=True, _nrt=False)
def _give_back(tables, ledger, env, flat, b, resource, amount):
    vms = ledger.vm_offered.shape[2]
    first_link = ledger.vm_offered.shape[1] * vms
    if resource < first_link:
        _change_vm(tables, ledger, env, flat, b, resource // vms, resource % vms, -amount)
    else:
        _change_link(tables, ledger, env, flat, b, resource - first_link, -amount)


@njit(cache=True, _nrt=False)
def _release_walk(world, b):
    """A rejected walk gives back at once all that it had reserved."""
    walk = world.walk
    for k in range(world.env[b].entries):
        _give_back(world.tables, world.ledger, world.env, world.seen.flat, b, walk.resource[b, k], walk.amount[b, k])


@njit(cache=True, _nrt=False)
def _keep_running(world, b):
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


@njit(cache=True, _nrt=False)
def _end_record(world, b, record):
    """Give back what a running request holds and free its record. Returns the record that followed it."""
    running, e = world.running, world.env[b]
    entry = running.record_entry[b, record]
    while entry != -1:
        _give_back(
            world.tables,
            world.ledger,
            world.env,
            world.seen.flat,
            b,
            running.entry_resource[b, entry],
            running.entry_amount[b, entry],
        )
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


# ------------------------------------------------------------------------------------------------- slots, failures


@njit(cache=True, _nrt=False)
def _depart(world, b):
    """Every request whose departure slot has come leaves (Algorithm 1)."""
    slot = world.env[b].slot
    record = world.running.head[b, slot]
    while record != -1:
        record = _end_record(world, b, record)
    world.running.head[b, slot] = -1


@njit(cache=True, _nrt=False)
def _uses(running, b, record, resource):
    entry = running.record_entry[b, record]
    while entry != -1:
        if running.entry_resource[b, entry] == resource:
            return True
        entry = running.entry_next[b, entry]
    return False


@njit(cache=True, _nrt=False)
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
            world.outcome[b, INTERRUPTED] += 1
            record = _end_record(world, b, record)
            if before == -1:
                running.head[b, slot] = record
            else:
                running.record_next[b, before] = record


@njit(cache=True, _nrt=False)
def _set_failed(world, b, resource, failed):
    """A failed resource offers nothing; a repaired one offers what is not reserved."""
    ledger, tables, e = world.ledger, world.tables, world.env[b]
    vms = ledger.vm_offered.shape[2]
    first_link = ledger.vm_offered.shape[1] * vms
    if resource < first_link:
        node, vm = resource // vms, resource % vms
        capacity = tables.vm_capacity[e.net, node, vm]
        ledger.vm_failed[b, node, vm] = failed
        ledger.vm_offered[b, node, vm] = 0 if failed else capacity - ledger.vm_reserved[b, node, vm]
        _show_share(world.seen.flat, b, resource, capacity, ledger.vm_offered[b, node, vm])
    else:
        link = resource - first_link
        capacity = tables.link_capacity[e.net, link]
        ledger.link_failed[b, link] = failed
        ledger.link_offered[b, link] = 0 if failed else capacity - ledger.link_reserved[b, link]
        _show_share(world.seen.flat, b, resource, capacity, ledger.link_offered[b, link])


@njit(cache=True, _nrt=False)
def _open_slot(world, b):
    """Start of a slot: departures, then this slot's repairs and failures in the timeline's order."""
    arrivals, e = world.arrivals, world.env[b]
    _depart(world, b)
    while e.event_cursor < e.num_events and arrivals.event_slot[b, e.event_cursor] <= e.slot:
        resource = arrivals.event_resource[b, e.event_cursor]
        up = arrivals.event_up[b, e.event_cursor]
        _set_failed(world, b, resource, not up)
        if not up:
            _interrupt(world, b, resource)
        e.event_cursor += 1


@njit(cache=True, _nrt=False)
def _close_slot(world, b):
    """End of a slot: its utilisation cost Phi_t and used shares count, unless it belongs to the warm-up."""
    tables, out, e = world.tables, world.outcome, world.env[b]
    if e.slot >= e.warmup:
        out[b, SLOTS_CLOSED] += 1
        out[b, SLOT_COST] += e.running_cost
        out[b, SLOT_VM_USE] += e.vm_used / tables.vm_total[e.net]
        out[b, SLOT_LINK_USE] += e.link_used / tables.link_total[e.net]
    e.slot += 1


@njit(cache=True, _nrt=False)
def _next_request(world, b):
    """Move on to the request at the cursor, through as many slots as lie between, or to the end of the horizon."""
    e = world.env[b]
    due = np.int64(world.arrivals.slot[b, e.cursor]) if e.cursor < e.num_requests else e.horizon
    while e.slot < due:
        _close_slot(world, b)
        if e.slot < e.horizon:
            _open_slot(world, b)
    if e.slot >= e.horizon:
        e.done = 1
        _write_mask(world, b)
    else:
        _begin_request(world, b)


@njit(cache=True, _nrt=False)
def _begin_request(world, b):
    arrivals, e = world.arrivals, world.env[b]
    e.service = arrivals.service[b, e.cursor]
    e.ingress = arrivals.ingress[b, e.cursor]
    e.egress = arrivals.egress[b, e.cursor]
    e.lifetime = arrivals.lifetime[b, e.cursor]
    e.service_share = arrivals.service_share[b, e.cursor]
    e.request_slot = e.slot
    e.node = e.ingress
    e.last_vm = 0
    e.function = 0
    e.steps = 0
    e.hops = 0
    e.elapsed = 0.0
    e.cost = 0.0
    e.entries = 0
    _show_request(world, b)
    _write_mask(world, b)


# -------------------------------------------------------------------------------------------------- what is seen


@njit(cache=True, _nrt=False)
def _move_one(flat, b, old, new):
    if old >= 0:
        flat[b, old] = 0.0
    flat[b, new] = 1.0
    return new


@njit(cache=True, _nrt=False)
def _show_request(world, b):
    """The five numbers of the request in the flat observation and, when on, the one-hot features after them."""
    tables, e = world.tables, world.env[b]
    flat = world.seen.flat
    _, nodes, vms = world.ledger.vm_offered.shape
    services, functions = tables.load.shape
    base = nodes * vms + world.ledger.link_offered.shape[1]
    service = e.service
    flat[b, base] = e.service_share
    flat[b, base + 1] = e.node / max(nodes - 1, 1)
    flat[b, base + 2] = e.last_vm / max(vms - 1, 1)
    flat[b, base + 3] = e.function / functions
    flat[b, base + 4] = e.elapsed / tables.tolerable_delay[service]
    if world.seen.one_hot:
        base += 5
        e.hot_service = _move_one(flat, b, e.hot_service, base + service)
        e.hot_node = _move_one(flat, b, e.hot_node, base + services + e.node)
        e.hot_egress = _move_one(flat, b, e.hot_egress, base + services + nodes + e.egress)
        e.hot_function = _move_one(flat, b, e.hot_function, base + services + 2 * nodes + e.function)


@njit(cache=True, _nrt=False)
def check_step(tables, rules, ledger, b, net, service, function, elapsed, steps, link, node, vm, place):
    """The step checks of Algorithm 3 in their order; link -1 is a self-hop. Returns ``PASSES`` or a reason's code."""
    delay = 0.0
    if link >= 0:
        if ledger.link_offered[b, link] < tables.rate_units[service]:
            return LINK_CAPACITY
        delay += tables.hop_delay[net, service, link]
    if place:
        if ledger.vm_offered[b, node, vm] < tables.load_units[service, function]:
            return VM_CAPACITY
        delay += 1000.0 * tables.load[service, function] / tables.vm_speed[net, node, vm]
    if elapsed + delay > tables.tolerable_delay[service] + DELAY_TOLERANCE:
        return DELAY
    if steps + 1 > rules.max_steps:
        return STEP_LIMIT
    return PASSES


@njit(cache=True, _nrt=False)
def _is_feasible(world, b, service, egress, link, node, vm, place):
    """Whether a step passes every check and leaves enough delay to reach the egress at all."""
    tables, e = world.tables, world.env[b]
    passes = check_step(
        tables, world.rules, world.ledger, b, e.net, service, e.function, e.elapsed, e.steps, link, node, vm, place
    )
    if passes != PASSES:
        return False
    after = e.elapsed + tables.delay_to[e.net, service, node, egress]
    if link >= 0:
        after += tables.hop_delay[e.net, service, link]
    if place:
        after += 1000.0 * tables.load[service, e.function] / tables.vm_speed[e.net, node, vm]
    return after <= tables.tolerable_delay[service] + DELAY_TOLERANCE


@njit(cache=True, _nrt=False)
def _add_moves(world, b, count, service, egress, link, node, forward, place):
    """Append the valid actions towards ``node`` (link -1: stay). Returns the new number of valid actions."""
    mask, valid = world.seen.mask, world.seen.valid
    vms = world.ledger.vm_offered.shape[2]
    first = 2 * node * vms
    feasible = world.rules.feasible_mask
    # Forwarding uses no VM: whether it is feasible is the same for every VM of the node.
    if forward and feasible:
        forward = _is_feasible(world, b, service, egress, link, node, 0, False)
    for vm in range(world.tables.vm_count[world.env[b].net, node]):
        if forward:
            mask[b, first + 2 * vm] = True
            valid[b, count] = first + 2 * vm
            count += 1
        if place and (not feasible or _is_feasible(world, b, service, egress, link, node, vm, True)):
            mask[b, first + 2 * vm + 1] = True
            valid[b, count] = first + 2 * vm + 1
            count += 1
    return count


@njit(cache=True, _nrt=False)
def _write_mask(world, b):
    """The possible actions A_p of the current state; ``reject`` keeps the mask non-empty."""
    tables, rules, e = world.tables, world.rules, world.env[b]
    mask, valid = world.seen.mask, world.seen.valid
    for k in range(e.mask_count):
        mask[b, valid[b, k]] = False
    count = 0
    if e.done == 0:
        service = e.service
        egress = e.egress
        unplaced = e.function < tables.chain_length[service]
        if e.node == egress:
            count = _add_moves(world, b, count, service, egress, -1, egress, False, True)
        else:
            for k in range(tables.degree[e.net, e.node]):
                link = np.int64(tables.neighbour_link[e.net, e.node, k])
                node = np.int64(tables.neighbour[e.net, e.node, k])
                count = _add_moves(world, b, count, service, egress, link, node, True, unplaced)
            if rules.colocation and unplaced:
                count = _add_moves(world, b, count, service, egress, -1, e.node, False, True)
    if count == 0 or rules.admission_control:
        reject = mask.shape[1] - 1
        mask[b, reject] = True
        valid[b, count] = reject
        count += 1
    e.mask_count = count


# ------------------------------------------------------------------------------------------------------ one step


@njit(cache=True, _nrt=False)
def _find_link(tables, net, node, neighbour):
    for k in range(tables.degree[net, node]):
        if tables.neighbour[net, node, k] == neighbour:
            return np.int64(tables.neighbour_link[net, node, k])
    return np.int64(-1)


@njit(cache=True, _nrt=False)
def _take(walk, e, b, resource, amount):
    walk.resource[b, e.entries] = resource
    walk.amount[b, e.entries] = amount
    e.entries += 1


@njit(cache=True, _nrt=False)
def _move(world, b, service, action):
    """Check a step and, if it passes, reserve for it. Returns ``PASSES`` or the reason's code."""
    tables, ledger, walk, e = world.tables, world.ledger, world.walk, world.env[b]
    _, nodes, vms = ledger.vm_offered.shape
    place = action % 2 == 1
    vm = (action // 2) % vms
    node = action // (2 * vms)
    link = np.int64(-1) if node == e.node else _find_link(tables, e.net, e.node, node)
    reason = check_step(
        tables, world.rules, ledger, b, e.net, service, e.function, e.elapsed, e.steps, link, node, vm, place
    )
    if reason != PASSES:
        return reason
    cost = 0.0
    delay = 0.0
    if link >= 0:
        units = tables.rate_units[service]
        _change_link(tables, ledger, world.env, world.seen.flat, b, link, units)
        _take(walk, e, b, nodes * vms + link, units)
        cost += tables.link_unit_cost[e.net, link] * tables.rate[service]
        delay += tables.hop_delay[e.net, service, link]
        e.hops += 1
    if place:
        units = tables.load_units[service, e.function]
        _change_vm(tables, ledger, world.env, world.seen.flat, b, node, vm, units)
        _take(walk, e, b, node * vms + vm, units)
        load = tables.load[service, e.function]
        cost += tables.vm_unit_cost[e.net, node, vm] * load
        delay += 1000.0 * load / tables.vm_speed[e.net, node, vm]
        e.function += 1
    walk.action[b, e.steps] = action
    e.steps += 1
    e.node = node
    e.last_vm = vm
    e.elapsed += delay
    e.cost += cost
    world.outcome[b, PASSED] = 1.0
    world.outcome[b, STEP_COST] = cost
    return PASSES


@njit(cache=True, _nrt=False)
def _log_answer(world, b, reason):
    log, e = world.log, world.env[b]
    r = e.cursor
    log.reason[b, r] = reason
    if reason == NO_REASON:
        log.delay[b, r] = e.elapsed
        log.cost[b, r] = e.cost
        log.hops[b, r] = e.hops
        for k in range(e.steps):
            log.action[b, e.log_length + k] = world.walk.action[b, k]
        e.log_length += e.steps
    log.start[b, r + 1] = e.log_length


@njit(cache=True, _nrt=False)
def _finish(world, b, reason):
    """Answer the request (``NO_REASON`` accepts it) and move on to the next one."""
    out, e = world.outcome, world.env[b]
    out[b, REQUEST_DONE] = 1.0
    out[b, REASON] = reason
    if world.log.enabled:
        _log_answer(world, b, reason)
    if reason == NO_REASON:
        out[b, ACCEPTED] = 1.0
        out[b, REQUEST_COST] = e.cost
        out[b, REQUEST_DELAY] = e.elapsed
        out[b, REQUEST_HOPS] = e.hops
        _keep_running(world, b)
    else:
        _release_walk(world, b)
    e.entries = 0
    e.cursor += 1
    _next_request(world, b)


@njit(cache=True, _nrt=False)
def step_env(world, b, action):
    """One step of environment b (Algorithm 3). After the horizon's end it changes nothing but says ``done`` again."""
    out, e = world.outcome, world.env[b]
    for column in range(out.shape[1]):
        out[b, column] = 0.0
    out[b, REASON] = NO_REASON
    out[b, DONE] = 1.0
    if e.done == 1:
        return
    service = e.service
    out[b, SERVICE] = service
    out[b, REQUEST_SLOT] = e.request_slot
    reject = world.seen.mask.shape[1] - 1
    if action == reject:
        if e.mask_count == 1 and world.seen.mask[b, reject]:
            reason = NO_FEASIBLE_ACTION
        elif world.rules.admission_control:
            reason = REJECTED_BY_POLICY
        else:
            reason = INVALID_ACTION
        _finish(world, b, reason)
    elif action < 0 or action > reject or not world.seen.mask[b, action]:
        _finish(world, b, INVALID_ACTION)
    else:
        reason = _move(world, b, service, action)
        if reason != PASSES:
            _finish(world, b, reason)
        elif e.node == e.egress and e.function == world.tables.chain_length[service]:
            _finish(world, b, NO_REASON)
        else:
            _show_request(world, b)
            _write_mask(world, b)
    out[b, DONE] = e.done


@njit(cache=True, nogil=True, _nrt=False)
def step_range(world, actions, first, last):
    """Step environments first .. last - 1 with ``actions`` int64 [B].

    Returns the least number of free records, free entries and free log places left in any of them.
    """
    records = entries = places = np.int64(1) << 60
    for b in range(first, last):
        step_env(world, b, actions[b])
        e = world.env[b]
        records = min(records, e.free_records)
        entries = min(entries, e.free_entries)
        places = min(places, world.log.action.shape[1] - e.log_length)
    return records, entries, places


# ------------------------------------------------------------------------------------------------- start, forward


@njit(cache=True, _nrt=False)
def _empty_network(world, b):
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


@njit(cache=True, nogil=True, _nrt=False)
def start_env(world, b):
    """Begin the horizon of environment b on an empty network; its arrivals must have been written."""
    e = world.env[b]
    _empty_network(world, b)
    for k in range(e.mask_count):
        world.seen.mask[b, world.seen.valid[b, k]] = False
    e.mask_count = 0
    e.slot = 0
    e.cursor = 0
    e.event_cursor = 0
    e.running_cost = 0.0
    e.num_running = 0
    e.vm_used = 0
    e.link_used = 0
    e.log_length = 0
    e.done = 0
    e.hot_service = -1
    e.hot_node = -1
    e.hot_egress = -1
    e.hot_function = -1
    for column in range(world.outcome.shape[1]):
        world.outcome[b, column] = 0.0
    _open_slot(world, b)
    _next_request(world, b)


@njit(cache=True, nogil=True, _nrt=False)
def random_steps(world, steps, seeds):
    """Benchmark: ``steps`` uniformly random valid actions in every environment; ``seeds`` uint64 [B] is advanced.

    Environments that end their horizon, or run out of room, start it again. Returns the number of requests answered.
    """
    requests = np.int64(0)
    room = 2 * world.rules.max_steps
    for b in range(world.env.shape[0]):
        e = world.env[b]
        x = seeds[b]
        for _ in range(steps):
            x ^= x << np.uint64(13)
            x ^= x >> np.uint64(7)
            x ^= x << np.uint64(17)
            action = world.seen.valid[b, np.int64((x >> np.uint64(33)) % np.uint64(e.mask_count))]
            step_env(world, b, np.int64(action))
            requests += np.int64(world.outcome[b, REQUEST_DONE])
            if e.done == 1 or e.free_entries < room or e.free_records < 1:
                start_env(world, b)
        seeds[b] = x
    return requests
