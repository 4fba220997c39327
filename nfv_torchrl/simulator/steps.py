"""What a step costs, how long it takes and what fits, said here only; for plain Python, NumPy arrays and kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from nfv_torchrl.simulator.compiled import inlined


class Step(NamedTuple):
    """One step of a walk."""

    link: int | np.signedinteger  # -1: the walk stays
    node: int  # where it leads
    vm: int
    places: bool  # whether the next function is placed on that VM


@register_jitable
def fits(offered, asked):
    """Whether a resource that offers so many ledger units can take what is asked for."""
    return offered >= asked


@register_jitable
def link_cost(unit_cost, rate):
    """$ of a hop: ``unit_cost`` in $ per Mbit/s, ``rate`` in Mbit/s."""
    return unit_cost * rate


@register_jitable
def link_delay(propagation, rate, capacity):
    """ms of a hop: propagation (ms) and transmission of a second's traffic, ``rate`` and ``capacity`` in Mbit/s."""
    return propagation + 1000.0 * rate / capacity


@register_jitable
def vm_cost(unit_cost, load):
    """$ of a placement: ``unit_cost`` in $ per Mcycles/s, ``load`` in Mcycles/s."""
    return unit_cost * load


@register_jitable
def vm_delay(load, speed):
    """ms that a function of ``load`` takes on a VM of ``speed``, both in Mcycles/s."""
    return 1000.0 * load / speed


@inlined
def step_cost(tables, e, step):
    """phi~ of a step of the request that environment record ``e`` is at, $."""
    cost = 0.0
    if step.link >= 0:
        cost += link_cost(tables.link_unit_cost[e.net, step.link], tables.rate[e.service])
    if step.places:
        unit_cost = tables.vm_unit_cost[e.net, step.node, step.vm]
        cost += vm_cost(unit_cost, tables.load[e.service, e.function])
    return cost


@inlined
def step_delay(tables, e, step):
    """Delay of the same step, ms."""
    delay = 0.0
    if step.link >= 0:
        delay += tables.hop_delay[e.net, e.service, step.link]
    if step.places:
        delay += vm_delay(tables.load[e.service, e.function], tables.vm_speed[e.net, step.node, step.vm])
    return delay


@inlined
def step_fits(world, b, step):
    """(whether the link, whether the VM of a step of environment b has room for what the step takes)."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    link = step.link < 0 or fits(ledger.link_offered[b, step.link], tables.rate_units[e.service])
    vm = not step.places or fits(ledger.vm_offered[b, step.node, step.vm], tables.load_units[e.service, e.function])
    return link, vm


@inlined
def find_link(tables, net, node, neighbour):
    """The link between two nodes of network ``net``, -1 if there is none."""
    for k in range(tables.degree[net, node]):
        if tables.neighbour[net, node, k] == neighbour:
            return np.int64(tables.neighbour_link[net, node, k])
    return np.int64(-1)
