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
def hop_delay(tables, net, profile, segment, link):
    """ms of a hop over ``link`` by the ``segment`` of a profile."""
    return link_delay(tables.link_delay[net, link], tables.rate[profile, segment], tables.link_speed[net, link])


@inlined
def place_delay(tables, e, node, vm):
    """ms that the next function of the request in hand takes on a VM."""
    work = vm_delay(tables.work[e.profile, e.function], tables.vm_speed[e.net, node, vm])
    return tables.fixed_delay[e.profile, e.function] + work


@inlined
def step_cost(tables, e, step):
    """phi~ of a step of the request that environment record ``e`` is at, $."""
    cost = 0.0
    if step.link >= 0:
        cost += link_cost(tables.link_unit_cost[e.net, step.link], tables.rate[e.profile, e.function])
    if step.places:
        for kind in range(tables.load.shape[2]):
            unit_cost = tables.vm_unit_cost[e.net, step.node, step.vm, kind]
            cost += vm_cost(unit_cost, tables.load[e.profile, e.function, kind])
    return cost


@inlined
def step_delay(tables, e, step):
    """Delay of the same step, ms."""
    delay = 0.0
    if step.link >= 0:
        delay += hop_delay(tables, e.net, e.profile, e.function, step.link)
    if step.places:
        delay += place_delay(tables, e, step.node, step.vm)
    return delay


@inlined
def step_fits(world, b, step):
    """(whether the link, whether the VM of a step of environment b has room for what the step takes)."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    link = step.link < 0 or fits(ledger.link_offered[b, step.link], tables.rate_units[e.profile, e.function])
    vm = True
    if step.places:
        for kind in range(tables.load_units.shape[2]):
            asked = tables.load_units[e.profile, e.function, kind]
            vm = vm and fits(ledger.vm_offered[b, step.node, step.vm, kind], asked)
    return link, vm


@inlined
def is_complete(tables, e):
    """Whether the walk of the request in hand has nothing left to do."""
    return e.function == tables.chain_length[e.profile] and (e.egress < 0 or e.node == e.egress)


@inlined
def counts_as_switch(tables, rules, e):
    """Whether an action that places now counts as one that forwards: no function is left, and the rules say so."""
    return rules.switches and e.function == tables.chain_length[e.profile]


@inlined
def find_link(tables, net, node, neighbour):
    """The link between two nodes of network ``net``, -1 if there is none."""
    for k in range(tables.degree[net, node]):
        if tables.neighbour[net, node, k] == neighbour:
            return np.int64(tables.neighbour_link[net, node, k])
    return np.int64(-1)
