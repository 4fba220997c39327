"""What may be done: the step checks of Algorithm 3 and the possible actions A_p."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import decode_action, encode_action
from nfv_torchrl.simulator.compiled import inlined, kernel, part
from nfv_torchrl.simulator.reasons import Reason
from nfv_torchrl.simulator.steps import Step, hop_delay, place_delay, step_delay, step_fits
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
    if e.elapsed + step_delay(tables, e, step) > tables.tolerable_delay[e.profile] + DELAY_TOLERANCE:
        return DELAY
    if e.steps + 1 > e.most_steps:
        return STEP_LIMIT
    return PASSES


@part
def _is_feasible(world, b, step):
    """Whether a step passes every check and leaves enough delay to reach the egress at all."""
    if check_step(world, b, step) != PASSES:
        return False
    tables, e = world.tables, world.env[b]
    after = e.elapsed
    if e.egress >= 0:
        after += tables.delay_to[e.net, tables.least_rate[e.profile], step.node, e.egress]
    if step.link >= 0:
        after += hop_delay(tables, e.net, e.profile, e.function, step.link)
    if step.places:
        after += place_delay(tables, e, step.node, step.vm)
    return after <= tables.tolerable_delay[e.profile] + DELAY_TOLERANCE


@inlined
def _allow(world, b, count, action):
    """Append a valid action. Returns the new number of them."""
    world.seen.mask[b, action] = True
    world.seen.valid[b, count] = action
    return count + 1


@part
def _add_moves(world, b, count, move, forward, place):
    """Append the valid actions that go as ``move`` does, whatever its VM. Returns the new number of valid actions.

    ``forward`` and ``place``: which of the two may be done there by rule; whether they are feasible is looked at here.
    """
    link, node = move
    vms = world.ledger.vm_offered.shape[2]
    feasible = world.rules.feasible_mask
    # Forwarding uses no VM: whether it is feasible is the same for every VM of the node.
    if forward and feasible:
        forward = _is_feasible(world, b, Step(link, node, 0, False))
    there = world.tables.vm_count[world.env[b].net, node]
    if forward and there == 0:  # a node that only forwards is named with VM 0
        return _allow(world, b, count, encode_action(node, 0, 0, vms))
    for vm in range(there):
        if forward:
            count = _allow(world, b, count, encode_action(node, vm, 0, vms))
        if place and (not feasible or _is_feasible(world, b, Step(link, node, vm, True))):
            count = _allow(world, b, count, encode_action(node, vm, 1, vms))
    return count


@part
def _add_switches(world, b, count, move):
    """Append what goes as ``move`` does once all functions are placed, where placing counts as forwarding."""
    link, node = move
    vms = world.ledger.vm_offered.shape[2]
    if world.rules.feasible_mask and not _is_feasible(world, b, Step(link, node, 0, False)):
        return count
    for vm in range(max(world.tables.vm_count[world.env[b].net, node], 1)):
        count = _allow(world, b, count, encode_action(node, vm, 0, vms))
        count = _allow(world, b, count, encode_action(node, vm, 1, vms))
    return count


@part
def _stands_on(world, b, node):
    """Whether a function of the request in hand has been placed on ``node``."""
    vms = world.ledger.vm_offered.shape[2]
    for k in range(world.env[b].steps):
        there, _, places = decode_action(np.int64(world.walk.action[b, k]), vms)
        if places and there == node:
            return True
    return False


@inlined
def _add_steps(world, b, count):
    """Append the possible actions of a request in hand, but for reject. Returns the new number of valid actions."""
    tables, rules, e = world.tables, world.rules, world.env[b]
    unplaced = e.function < tables.chain_length[e.profile]
    if e.node < 0:  # off the network: the first function stands anywhere
        for start in range(tables.num_nodes[e.net]):
            count = _add_moves(world, b, count, (STAY, start), False, True)
        return count
    if e.node == e.egress and not rules.distinct:
        return _add_moves(world, b, count, (STAY, e.node), False, True)
    for k in range(tables.degree[e.net, e.node]):
        link = np.int64(tables.neighbour_link[e.net, e.node, k])
        node = np.int64(tables.neighbour[e.net, e.node, k])
        if rules.switches and not unplaced:
            count = _add_switches(world, b, count, (link, node))
            continue
        place = unplaced and not (rules.distinct and _stands_on(world, b, node))
        count = _add_moves(world, b, count, (link, node), True, place)
    if unplaced and (rules.colocation or (rules.distinct and not _stands_on(world, b, e.node))):
        count = _add_moves(world, b, count, (STAY, e.node), False, True)
    return count


@part
def write_mask(world, b):
    """The possible actions A_p of the current state; ``reject`` keeps the mask non-empty."""
    e = world.env[b]
    mask, valid = world.seen.mask, world.seen.valid
    for k in range(e.mask_count):
        mask[b, valid[b, k]] = False
    count = 0
    if e.done == 0:
        count = _add_steps(world, b, count)
    if count == 0 or world.rules.admission_control:
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
