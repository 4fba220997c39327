"""What is seen of the world: the flat observation, updated where something changed (section "Network States")."""

from __future__ import annotations

from typing import NamedTuple

from nfv_torchrl.codec import count_vms
from nfv_torchrl.columns import columns
from nfv_torchrl.simulator.compiled import part


class RequestNumbers(NamedTuple):
    """The numbers of the request that follow the used shares in the flat observation."""

    service: int  # index among the services, scaled to [0, 1]
    node: int  # current node, scaled to [0, 1]
    vm: int  # VM named last, scaled to [0, 1]
    function: int  # functions placed, of the longest chain
    delay: int  # elapsed, of the tolerable delay


AT = columns(RequestNumbers)

SHARE_LEVELS = 1000
"""I: levels of the used share in the observation."""


@part
def show_share(flat, b, resource, capacity, offered):
    """Used share of a resource in the observation: floor(I (capacity - offered) / capacity) / I."""
    flat[b, resource] = ((capacity - offered) * SHARE_LEVELS // capacity) / SHARE_LEVELS


@part
def _move_one(flat, b, old, new):
    if old >= 0:
        flat[b, old] = 0.0
    flat[b, new] = 1.0
    return new


@part
def show_request(world, b):
    """The five numbers of the request in the flat observation and, when on, the one-hot features after them."""
    tables, e = world.tables, world.env[b]
    flat = world.seen.flat
    _, nodes, vms = world.ledger.vm_offered.shape
    services, functions = tables.load.shape
    base = count_vms(nodes, vms) + world.ledger.link_offered.shape[1]
    service = e.service
    flat[b, base + AT.service] = e.service_share
    flat[b, base + AT.node] = e.node / max(nodes - 1, 1)
    flat[b, base + AT.vm] = e.last_vm / max(vms - 1, 1)
    flat[b, base + AT.function] = e.function / functions
    flat[b, base + AT.delay] = e.elapsed / tables.tolerable_delay[service]
    if world.seen.one_hot:
        base += len(AT)
        e.hot_service = _move_one(flat, b, e.hot_service, base + service)
        e.hot_node = _move_one(flat, b, e.hot_node, base + services + e.node)
        e.hot_egress = _move_one(flat, b, e.hot_egress, base + services + nodes + e.egress)
        e.hot_function = _move_one(flat, b, e.hot_function, base + services + 2 * nodes + e.function)
