"""How a policy over menus acts where functions of a request may not share a node: what counts besides what it learned.

Between walks these are a price level, and a price on the room that the latest requests need. In refusing it is a share
of the learned bid price.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.observations.menu_layout import ROW, ROW_SERVICE, SERVICE, STATE, what_fits
from nfv_torchrl.observations.needs import closeness
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import kernel, part

RISING = 4
"""Power of the used share of the VMs with which a price level rises from an empty network to a full one."""


class Acting(NamedTuple):
    """Settings of how a policy acts, see ``MenuPlanner``."""

    empty: float  # price level where no VM is used
    full: float  # where all are
    between: float  # share of the learned bid price that counts between walks
    reserve: float  # what a walk loses that leaves one of the latest requests no room, in accepted requests
    refusing: float  # share of the bid price that counts against accepting a request whose lifetime is hidden
    refusing_full: float  # the same where requests of another service find no room


class Rule(NamedTuple):
    """The same for one request."""

    level: float
    between: float
    reserve: float
    refusing: float


BY_COST = Acting(empty=0.0, full=0.0, between=1.0, reserve=0.0, refusing=1.0, refusing_full=1.0)
"""By the network's values alone."""


@part
def level_at(used, acting):
    """p where the share ``used`` of the VMs is used."""
    return acting.empty + (acting.full - acting.empty) * used**RISING


@part
def refusing_at(close, acting):
    """Share of the bid price that counts in refusing where another service is so close to finding no room."""
    return acting.refusing + (acting.refusing_full - acting.refusing) * close * close


@part
def closest_of_others(seen, services, own):
    """How close one of the latest requests of a service other than ``own`` is to finding no room, 0 to 1."""
    close = 0.0
    for service in range(services):
        if service != own:
            room = np.float64(seen[len(STATE) + service * len(SERVICE) + SERVICE.vm_room])
            close = max(close, closeness(what_fits(room)))
    return close


@part
def rule_for(world, b, seen, acting):
    """``Rule`` for the request that environment b is at, of which a policy sees ``seen`` float32 [P]."""
    if world.rules.colocation:
        return Rule(0.0, 1.0, 0.0, 1.0)
    level = level_at(np.float64(seen[STATE.vm_used]), acting)
    if world.mean_lifetime[b] > 0.0:  # a price for the stay has a factor of its own, ``per_stay``
        return Rule(level, acting.between, acting.reserve, 1.0)
    services = world.tables.services
    close = closest_of_others(seen, services, world.tables.service[world.env[b].profile])
    return Rule(level, acting.between, acting.reserve, refusing_at(close, acting))


@part
def counts_against(b, k, menu, row, rule, w_cost):
    """What counts against walk k beside its true cost and bid price, in accepted requests; ``row`` describes it."""
    closer = 0.0
    for service in range((row.size - len(ROW)) // len(ROW_SERVICE)):
        closer += np.float64(row[len(ROW) + service * len(ROW_SERVICE) + ROW_SERVICE.closer_most])
    risen = rule.level * (menu.rise[b, k] - menu.rise[b, 0]) / max(menu.cost[b, 0], LEAST_COST)
    return rule.reserve * closer + w_cost * risen


@kernel
def fill_rules(world, rows, offers, acting, w_cost, counts):
    """What ``rule_for`` and ``counts_against`` say of the environments ``rows`` int64 [R].

    Args:
        world: the simulator's ``World``; only read.
        rows: environments.
        offers: ``Offers``, made of what the world is now.
        acting: the settings.
        w_cost: weight of cost in a policy's values.
        counts: float64 [R, K + 1], receives what counts against walks that are offered, and last the share of the bid
            price that counts in refusing.
    """
    menu, shape = offers.menu, offers.shape
    for r in range(rows.size):
        b = rows[r]
        rule = rule_for(world, b, offers.flat[b], acting)
        counts[r, shape.rows] = rule.refusing
        for k in range(shape.rows):
            if menu.mask[b, k]:
                first = shape.state + k * shape.row
                row = offers.flat[b, first : first + shape.row]
                counts[r, k] = counts_against(b, k, menu, row, rule, w_cost)
