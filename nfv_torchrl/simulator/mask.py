"""What may be done: the step checks of Algorithm 3 and the possible actions A_p."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.reasons import Reason
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

LINK_CAPACITY = int(Reason.LINK_CAPACITY)
VM_CAPACITY = int(Reason.VM_CAPACITY)
DELAY = int(Reason.DELAY)
STEP_LIMIT = int(Reason.STEP_LIMIT)
PASSES = -1


@part
def find_link(tables, net, node, neighbour):
    for k in range(tables.degree[net, node]):
        if tables.neighbour[net, node, k] == neighbour:
            return np.int64(tables.neighbour_link[net, node, k])
    return np.int64(-1)


@part
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


@part
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


@part
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


@part
def write_mask(world, b):
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


@kernel
def write_masks(world):
    """``write_mask`` for every environment."""
    for b in range(world.env.shape[0]):
        write_mask(world, b)
