"""What is seen of the world: the flat observation, updated where something changed (section "Network States")."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from nfv_torchrl.codec import count_vms
from nfv_torchrl.columns import columns
from nfv_torchrl.simulator.compiled import inlined, part


class RequestNumbers(NamedTuple):
    """The numbers of the request that follow the used shares in the flat observation."""

    service: int  # index among the services, scaled to [0, 1]
    node: int  # current node, scaled to [0, 1]
    vm: int  # VM named last, scaled to [0, 1]
    function: int  # functions placed, of the longest chain
    delay: int  # elapsed, of the tolerable delay


AT = columns(RequestNumbers)


class EndNumbers(NamedTuple):
    """The numbers that follow where neither these nor one-hot features tell the ends of a request."""

    ingress: int  # node, scaled to [0, 1] as ``node`` is; -1 / (N - 1) when it is free
    egress: int


END = columns(EndNumbers)

SHARE_LEVELS = 1000
"""I: levels of the used share in the observation."""


@inlined
def show_share(flat, b, place, capacity, offered):
    """Used share of a resource at its ``place`` in the observation: floor(I (capacity - offered) / capacity) / I."""
    flat[b, place] = ((capacity - offered) * SHARE_LEVELS // capacity) / SHARE_LEVELS


@part
def _move_one(flat, b, old, first, at):
    """Put the one of a one-hot block that begins at ``first`` to ``at``, nowhere when that is negative."""
    if old >= 0:
        flat[b, old] = 0.0
    if at < 0:
        return np.int64(-1)
    flat[b, first + at] = 1.0
    return first + at


@part
def show_request(world, b):
    """The five numbers of the request in the flat observation and, when on, its ends or one-hot features after them.

    Off the network, before a request with a free ingress has taken its first step, the node shows as -1 / (N - 1).
    """
    tables, e = world.tables, world.env[b]
    flat = world.seen.flat
    _, nodes, vms, kinds = world.ledger.vm_offered.shape
    functions = tables.load.shape[1]
    base = kinds * count_vms(nodes, vms) + world.ledger.link_offered.shape[1]
    flat[b, base + AT.service] = e.service_share
    flat[b, base + AT.node] = e.node / max(nodes - 1, 1)
    flat[b, base + AT.vm] = e.last_vm / max(vms - 1, 1)
    flat[b, base + AT.function] = e.function / functions
    flat[b, base + AT.delay] = e.elapsed / tables.tolerable_delay[e.profile]
    base += len(AT)
    if world.seen.ends:
        flat[b, base + END.ingress] = e.ingress / max(nodes - 1, 1)
        flat[b, base + END.egress] = e.egress / max(nodes - 1, 1)
    if world.seen.one_hot:
        services = tables.services
        e.hot_service = _move_one(flat, b, e.hot_service, base, e.service)
        e.hot_node = _move_one(flat, b, e.hot_node, base + services, e.node)
        e.hot_egress = _move_one(flat, b, e.hot_egress, base + services + nodes, e.egress)
        e.hot_function = _move_one(flat, b, e.hot_function, base + services + 2 * nodes, e.function)
    if world.seen.demand and e.steps == 0:
        _show_demand(world, b, flat.shape[1] - demand_size(functions, kinds))


@part
def _show_demand(world, b, base):
    """What the request asks for, as shares: ``demand_size`` numbers from ``base`` on."""
    tables, e = world.tables, world.env[b]
    flat = world.seen.flat
    _, functions, kinds = tables.load.shape
    for f in range(functions):
        for kind in range(kinds):
            flat[b, base + f * kinds + kind] = tables.load[e.profile, f, kind] / tables.largest_amount[kind]
    base += functions * kinds
    for f in range(functions):
        # Delays beyond 100 ms are all but 1; what does not tolerate any delay is 0.
        flat[b, base + f] = 1.0 - 1.0 / (1.0 + tables.fixed_delay[e.profile, f] / 100.0)
    base += functions
    for segment in range(functions + 1):
        flat[b, base + segment] = tables.rate[e.profile, segment] / tables.largest_rate
    base += functions + 1
    flat[b, base] = tables.chain_length[e.profile] / functions
    flat[b, base + 1] = 1.0 / (1.0 + tables.tolerable_delay[e.profile] / 100.0)


@register_jitable
def demand_size(functions, kinds):
    """Numbers that tell what a request asks for: F R amounts, F delays, F + 1 rates, chain length, tolerable delay."""
    return functions * (kinds + 2) + 3
