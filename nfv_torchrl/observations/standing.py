"""How the network stands with the request in hand: numbers that are the same for all that can be done now.

All are shares, ratios or logarithms, so that one network with shared weights serves networks of any size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.columns import columns
from nfv_torchrl.observations.ahead import CHEAP, SPARE
from nfv_torchrl.observations.menu import AT_ONCE, stay_of
from nfv_torchrl.observations.menu_layout import pow8
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.slots import used_vm_share
from nfv_torchrl.simulator.tables import Tables

MOST = 20.0
"""Costs are seen up to this multiple of the least."""


class StateFeatures(NamedTuple):
    """Numbers of the network and the request, the same for all rows."""

    demand: int  # load of the chain over the mean over services; of several kinds of resources the largest
    stay: int  # what the lifetime makes of the price of the demand, see ``menu.stay_of``; 1 where lifetimes are hidden
    log_demand: int
    size: int  # log of the load of the chain over the capacity of a mean VM, over 5
    rate: int  # log of 1 + the highest rate over that of the mean link, over 5
    vm_used: int  # used share of all VM capacity
    vm_used_pow8: int
    link_used: int  # used share of all link capacity
    link_used_pow8: int
    colocation: int  # 1 where functions may share a node
    nodes: int  # log of their number, over 5
    near: int  # least delay of hops from ingress to egress over the tolerable delay
    dear: int  # log of the least cost over that of the chain's load at mean prices, over 5
    risen: int  # log of what the cheapest walk costs at raised prices over what it costs, over 5
    spare_cost: int  # what the walk at raised prices costs over the cheapest, less 1
    spare_saves: int  # log of 1 + what it saves at raised prices over the least cost, over 5
    functions_left: int  # share of the chain not placed yet
    fits: int  # 1: the request can still be finished


STATE = columns(StateFeatures)
FACTORS = 2
"""The first columns, which a price is multiplied by; perceptrons see the others."""


class StateScales(NamedTuple):
    """What the numbers of the state are measured by."""

    demand: np.ndarray  # float64 [P], load of each over the mean over services, of several kinds the largest
    chain: np.ndarray  # float64 [P], load of each profile, of the first kind of resources
    rate: np.ndarray  # float64 [P], highest rate of each, Mbit/s
    mean_capacity: np.ndarray  # float64 [S], Mcycles/s of a VM
    mean_speed: np.ndarray  # float64 [S], Mbit/s of a link
    at_once: float  # of ``stay_of``


def state_scales(tables: Tables, at_once: float = AT_ONCE) -> StateScales:
    """``StateScales`` of a simulator's tables, with a share ``at_once`` of the price of a mean stay paid for coming."""
    loads = tables.load.sum(axis=1)
    chain = np.ascontiguousarray(loads[:, 0])
    usual = np.array([max(float(kind[: tables.services].mean()), LEAST_COST) for kind in loads.T])
    links = np.maximum(tables.num_links, 1)
    exists = np.arange(tables.link_speed.shape[1]) < tables.num_links[:, None]
    vms = np.maximum(tables.vm_count.sum(axis=1), 1)
    return StateScales(
        demand=(loads / usual).max(axis=1),
        chain=chain,
        rate=tables.rate.max(axis=1),
        mean_capacity=np.where(tables.vm_capacity[..., 0] > 0, tables.vm_speed, 0.0).sum(axis=(1, 2)) / vms,
        mean_speed=np.where(exists, tables.link_speed, 0.0).sum(axis=1) / links,
        at_once=at_once,
    )


@part
def scale_of(kept, b):
    """What costs of environment b's request are measured by, $, above 0."""
    return max(kept.least[b], LEAST_COST) if kept.least[b] < np.inf else 1.0


@part
def write_state(world, b, own, scales, state):
    """Fill the numbers of the network and the request, float32 [S]."""
    tables, kept, e = world.tables, own.kept, world.env[b]
    net, profile = e.net, e.profile
    demand = scales.demand[profile]
    used = used_vm_share(world, b)
    link_used = e.link_used / tables.link_total[net]
    state[STATE.demand] = demand
    state[STATE.stay] = stay_of(world, b, scales.at_once, 1.0 - scales.at_once)
    state[STATE.log_demand] = 0.5 * np.log(max(demand, 1e-3))
    state[STATE.size] = np.log(max(scales.chain[profile] / scales.mean_capacity[net], 1e-9)) / 5.0
    state[STATE.rate] = np.log(1.0 + scales.rate[profile] / scales.mean_speed[net]) / 5.0
    state[STATE.vm_used] = used
    state[STATE.vm_used_pow8] = pow8(used)
    state[STATE.link_used] = link_used
    state[STATE.link_used_pow8] = pow8(link_used)
    state[STATE.colocation] = world.rules.colocation
    state[STATE.nodes] = np.log(tables.num_nodes[net]) / 5.0
    if e.ingress >= 0 and e.egress >= 0:
        hops = tables.delay_to[net, tables.least_rate[profile], e.ingress, e.egress]
        state[STATE.near] = hops / tables.tolerable_delay[profile]
    state[STATE.functions_left] = 1.0 - kept.placed[b] / max(tables.chain_length[profile], 1)
    if kept.least[b] < np.inf:
        least = scale_of(kept, b)
        usual = max(own.mean_cost[net] * scales.chain[profile], LEAST_COST)
        state[STATE.dear] = np.log(least / usual) / 5.0
        cheap, spare = kept.total[b, CHEAP], kept.total[b, SPARE]
        if cheap[CHEAP] < np.inf:
            state[STATE.fits] = 1.0
            state[STATE.risen] = np.log(max(cheap[SPARE] / max(cheap[CHEAP], LEAST_COST), 1.0)) / 5.0
            state[STATE.spare_cost] = min(spare[CHEAP] / max(cheap[CHEAP], LEAST_COST) - 1.0, MOST)
            saved = max(cheap[SPARE] - spare[SPARE], 0.0) / least
            state[STATE.spare_saves] = np.log(1.0 + saved) / 5.0
        elif not own.exact:
            state[STATE.fits] = 1.0
