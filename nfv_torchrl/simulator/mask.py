"""What may be done: the step checks of Algorithm 3 and the possible actions A_p."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.reasons import Reason
from nfv_torchrl.simulator.steps import Step, step_delay, step_fits, vm_delay
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

LINK_CAPACITY = int(Reason.LINK_CAPACITY)
VM_CAPACITY = int(Reason.VM_CAPACITY)
DELAY = int(Reason.DELAY)
STEP_LIMIT = int(Reason.STEP_LIMIT)
PASSES = -1
STAY = np.int64(-1)


@part
def check_step(world, b, step):
    """The step checks of Algorithm 3 in their order. Returns ``PASSES`` or a reason's code."""
    tables, e = world.tables, world.env[b]
    link_fits, vm_fits = step_fits(world, b, step)
    if not link_fits:
        return LINK_CAPACITY
    if not vm_fits:
        return VM_CAPACITY
    if e.elapsed + step_delay(tables, e, step) > tables.tolerable_delay[e.service] + DELAY_TOLERANCE:
        return DELAY
    if e.steps + 1 > world.rules.max_steps:
        return STEP_LIMIT
    return PASSES


@part
def _is_feasible(world, b, step):
    """Whether a step passes every check and leaves enough delay to reach the egress at all."""
    if check_step(world, b, step) != PASSES:
        return False
    tables, e = world.tables, world.env[b]
    after = e.elapsed + tables.delay_to[e.net, e.service, step.node, e.egress]
    if step.link >= 0:
        after += tables.hop_delay[e.net, e.service, step.link]
    if step.places:
        after += vm_delay(tables.load[e.service, e.function], tables.vm_speed[e.net, step.node, step.vm])
    return after <= tables.tolerable_delay[e.service] + DELAY_TOLERANCE


@part
def _allow(world, b, count, action):
    """Append a valid action. Returns the new number of them."""
    world.seen.mask[b, action] = True
    world.seen.valid[b, count] = action
    return count + 1


@part
def _add_moves(world, b, count, move, forward, place):
    """Append the valid actions that go as ``move`` does, whatever its VM. Returns the new number of valid actions."""
    link, node = move
    vms = world.ledger.vm_offered.shape[2]
    feasible = world.rules.feasible_mask
    # Forwarding uses no VM: whether it is feasible is the same for every VM of the node.
    if forward and feasible:
        forward = _is_feasible(world, b, Step(link, node, 0, False))
    for vm in range(world.tables.vm_count[world.env[b].net, node]):
        if forward:
            count = _allow(world, b, count, encode_action(node, vm, 0, vms))
        if place and (not feasible or _is_feasible(world, b, Step(link, node, vm, True))):
            count = _allow(world, b, count, encode_action(node, vm, 1, vms))
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
        unplaced = e.function < tables.chain_length[e.service]
        if e.node == e.egress:
            count = _add_moves(world, b, count, (STAY, e.node), False, True)
        else:
            for k in range(tables.degree[e.net, e.node]):
                link = np.int64(tables.neighbour_link[e.net, e.node, k])
                node = np.int64(tables.neighbour[e.net, e.node, k])
                count = _add_moves(world, b, count, (link, node), True, unplaced)
            if rules.colocation and unplaced:
                count = _add_moves(world, b, count, (STAY, e.node), False, True)
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
