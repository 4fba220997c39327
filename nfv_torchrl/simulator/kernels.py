"""The rules of the model, compiled: Algorithm 3 (one request, step by step), over the books, slots, mask and view.

Plain loops over arrays, one environment at a time; no randomness and no allocation inside. A step touches one VM, one
link, the mask of one node and a few numbers of the observation, so its cost hardly depends on the network's size.
"""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.simulator.books import empty_network, keep_running, release_walk, reserve_step
from nfv_torchrl.simulator.compiled import inlined, kernel, part
from nfv_torchrl.simulator.mask import PASSES, check_step, write_mask
from nfv_torchrl.simulator.reasons import NO_REASON, Reason
from nfv_torchrl.simulator.slots import next_request, open_slot, paper_service
from nfv_torchrl.simulator.state import OUTCOME
from nfv_torchrl.simulator.steps import Step, counts_as_switch, find_link, is_complete, step_cost, step_delay
from nfv_torchrl.simulator.view import show_request

NO_FEASIBLE_ACTION = int(Reason.NO_FEASIBLE_ACTION)
REJECTED_BY_POLICY = int(Reason.REJECTED_BY_POLICY)
INVALID_ACTION = int(Reason.INVALID_ACTION)
PLENTY = (1 << 60, 1 << 60, 1 << 60)
"""Room before any environment was looked at."""


@part
def _move(world, b, action):
    """Check a step and, if it passes, reserve for it. Returns ``PASSES`` or the reason's code."""
    tables, ledger, walk, e = world.tables, world.ledger, world.walk, world.env[b]
    node, vm, places = decode_action(action, ledger.vm_offered.shape[2])
    if places and counts_as_switch(tables, world.rules, e):
        places = False
    link = np.int64(-1) if node == e.node or e.node < 0 else find_link(tables, e.net, e.node, node)
    step = Step(link, node, vm, places)
    reason = check_step(world, b, step)
    if reason != PASSES:
        return reason
    cost, delay = step_cost(tables, e, step), step_delay(tables, e, step)
    reserve_step(world, b, step)
    if link >= 0:
        e.hops += 1
    if places:
        e.function += 1
    walk.action[b, e.steps] = action
    e.steps += 1
    e.node = node
    e.last_vm = vm
    e.elapsed += delay
    e.cost += cost
    world.outcome[b, OUTCOME.passed] = 1.0
    world.outcome[b, OUTCOME.step_cost] = cost
    return PASSES


@part
def _log_answer(world, b, reason, action):
    """The steps of the walk; of a rejected request also ``action``, the one that ended it (-1 if it is none at all)."""
    log, e = world.log, world.env[b]
    r = e.cursor
    log.reason[b, r] = reason
    for k in range(e.steps):
        log.action[b, e.log_length + k] = world.walk.action[b, k]
    e.log_length += e.steps
    if reason == NO_REASON:
        log.delay[b, r] = e.elapsed
        log.cost[b, r] = e.cost
        log.hops[b, r] = e.hops
    else:
        known = 0 <= action < world.seen.mask.shape[1]
        log.action[b, e.log_length] = action if known else np.int64(-1)
        e.log_length += 1
    log.start[b, r + 1] = e.log_length


@part
def _finish(world, b, reason, action):
    """Answer the request (``NO_REASON`` accepts it) after its last ``action`` and move on to the next one."""
    out, e = world.outcome, world.env[b]
    out[b, OUTCOME.request_done] = 1.0
    out[b, OUTCOME.reason] = reason
    if world.log.enabled:
        _log_answer(world, b, reason, action)
    if reason == NO_REASON:
        out[b, OUTCOME.accepted] = 1.0
        out[b, OUTCOME.request_cost] = e.cost
        out[b, OUTCOME.request_delay] = e.elapsed
        out[b, OUTCOME.request_hops] = e.hops
        keep_running(world, b)
    else:
        out[b, OUTCOME.lost_steps] = e.steps
        out[b, OUTCOME.lost_cost] = e.cost
        release_walk(world, b)
    if world.rules.shared_steps:
        world.walk.spent[b, paper_service(e)] += e.steps
    e.entries = 0
    e.cursor += 1
    next_request(world, b)


@kernel
def step_env(world, b, action):
    """One step of environment b (Algorithm 3). After the horizon's end it changes nothing but says ``done`` again."""
    out, e = world.outcome, world.env[b]
    for column in range(out.shape[1]):
        out[b, column] = 0.0
    out[b, OUTCOME.reason] = NO_REASON
    out[b, OUTCOME.done] = 1.0
    if e.done == 1:
        return
    out[b, OUTCOME.service] = e.service
    out[b, OUTCOME.request_slot] = e.request_slot
    reject = world.seen.mask.shape[1] - 1
    if action == reject:
        if e.mask_count == 1 and world.seen.mask[b, reject]:
            reason = NO_FEASIBLE_ACTION
        elif world.rules.admission_control:
            reason = REJECTED_BY_POLICY
        else:
            reason = INVALID_ACTION
        _finish(world, b, reason, action)
    elif action < 0 or action > reject or not world.seen.mask[b, action]:
        _finish(world, b, INVALID_ACTION, action)
    else:
        reason = _move(world, b, action)
        if reason != PASSES:
            _finish(world, b, reason, action)
        elif is_complete(world.tables, e):
            _finish(world, b, NO_REASON, action)
        else:
            show_request(world, b)
            write_mask(world, b)
    out[b, OUTCOME.done] = e.done


@kernel
def step_range(world, actions, first, last):
    """Step environments first .. last - 1 with ``actions`` int64 [B].

    Returns the least number of free records, free entries and free log places left in any of them.
    """
    room = PLENTY
    for b in range(first, last):
        step_env(world, b, actions[b])
        room = _least_room(world, b, room)
    return room


@kernel
def answer_range(world, plans, lengths, first, last):
    """Answer the requests that environments first .. last - 1 are at, as ``Simulator.answer`` says.

    Returns what ``step_range`` returns.
    """
    room = PLENTY
    reject = np.int64(world.seen.mask.shape[1] - 1)
    for b in range(first, last):
        k = 0
        while world.env[b].done == 0:
            step_env(world, b, plans[b, k] if k < lengths[b] else reject)
            k += 1
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
        room = _least_room(world, b, room)
    return room


@inlined
def _least_room(world, b, room):
    e = world.env[b]
    records, entries, places = room
    places = min(places, world.log.action.shape[1] - e.log_length)
    return min(records, e.free_records), min(entries, e.free_entries), places


@kernel
def start_env(world, b):
    """Begin the horizon of environment b on an empty network; its arrivals must have been written."""
    e = world.env[b]
    empty_network(world, b)
    for k in range(e.mask_count):
        world.seen.mask[b, world.seen.valid[b, k]] = False
    e.mask_count = 0
    e.slot = 0
    e.cursor = 0
    e.event_cursor = 0
    e.running_cost = 0.0
    e.num_running = 0
    e.link_used = 0
    e.log_length = 0
    e.done = 0
    e.hot_service = -1
    e.hot_node = -1
    e.hot_egress = -1
    e.hot_function = -1
    for column in range(world.outcome.shape[1]):
        world.outcome[b, column] = 0.0
    open_slot(world, b)
    next_request(world, b)


@kernel
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
            requests += np.int64(world.outcome[b, OUTCOME.request_done])
            if e.done == 1 or e.free_entries < room or e.free_records < 1:
                start_env(world, b)
        seeds[b] = x
    return requests
