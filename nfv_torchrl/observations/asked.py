"""What a request asks for, as numbers of its own, where its service type does not tell it or its ends are free.

Two requests that differ should differ here, too. So there is not only how much is asked, but also how it is shared out
along the chain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.columns import columns
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.simulator.compiled import part


class AskedFeatures(NamedTuple):
    """Columns of the state, after those of the services. Loads are over their means over profiles."""

    length: int  # a tenth of the chain's functions
    largest: int  # log of the largest function over the mean chain, halved; of several kinds of resources the largest
    loads: int  # log of the chain's load, halved; of several kinds the mean
    load_late: int  # where on the chain it is: 0 at the beginning, 1 at the end
    load_uneven: int  # 1 where one function has all of it
    share: int  # of the resources that are free, at most 1; of several kinds the largest
    traffic: int  # log of the rates that a walk has to carry together, over the mean, halved
    traffic_late: int  # as of the load
    traffic_uneven: int
    traffic_share: int  # of what is free on all links, at most 1
    haste: int  # 0 where any delay will do, near 1 where hardly any is tolerated
    fixed_delay: int  # 0 for none, near 1 for seconds
    free_start: int  # 1 where the ingress is free
    free_end: int


ASKED = columns(AskedFeatures)
LEAST_RATIO = 0.01
"""Requests that ask for less than this share of what usual ones ask look alike in it."""
USUAL_DELAY = 100.0
"""ms, in the middle between 0 and 1."""


@part
def scarcest(own, profile):
    """The kind of resources of which the profile takes most, and how much over the mean over profiles."""
    kind, most = 0, own.needs.chain_units[profile, 0] / own.reference_load[0]
    for k in range(1, own.reference_load.size):
        ratio = own.needs.chain_units[profile, k] / own.reference_load[k]
        if ratio > most:
            kind, most = k, ratio
    return kind, max(most, own.least_ratio)


@part
def carried_rate(world, b):
    """Rates of the segments that any walk of the request in hand carries over links or could, Mbit/s, together.

    What leads to the first function from a free ingress, or from the last to a free egress, takes no link.
    """
    tables, e = world.tables, world.env[b]
    total = 0.0
    for segment in range(tables.chain_length[e.profile] + 1):
        total += tables.rate[e.profile, segment] * _is_carried(world, b, segment)
    return total


@part
def _is_carried(world, b, segment):
    e = world.env[b]
    if segment == 0 and e.ingress < 0:
        return False
    return not (segment == world.tables.chain_length[e.profile] and e.egress < 0)


@part
def usual_cost(world, b, own):
    """$ of the request in hand at mean unit costs; where requests are described by what they ask, with a hop for each
    segment that has to be carried."""
    tables, e = world.tables, world.env[b]
    usual = own.mean_cost[e.net, 0] * tables.load[e.profile, :, 0].sum()
    if not own.asked:
        return usual
    for kind in range(1, tables.load.shape[2]):
        usual += own.mean_cost[e.net, kind] * tables.load[e.profile, :, kind].sum()
    return max(usual + own.mean_link_cost[e.net] * carried_rate(world, b), LEAST_COST)


@part
def describe_asked(world, b, own, columns):
    """Fill the columns of ``AskedFeatures`` of the request in hand.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``MenuView`` of the world's tables.
        columns: receives them, float32.
    """
    tables, e = world.tables, world.env[b]
    chain = tables.chain_length[e.profile]
    columns[ASKED.length] = chain / 10.0
    _describe_load(world, b, own, columns)
    _describe_traffic(world, b, own, columns)
    columns[ASKED.haste] = 1.0 / (1.0 + tables.tolerable_delay[e.profile] / USUAL_DELAY)
    fixed = 0.0
    for f in range(chain):
        fixed += tables.fixed_delay[e.profile, f]
    columns[ASKED.fixed_delay] = 1.0 - 1.0 / (1.0 + fixed / USUAL_DELAY)
    columns[ASKED.free_start] = 1.0 if e.ingress < 0 else 0.0
    columns[ASKED.free_end] = 1.0 if e.egress < 0 else 0.0


@part
def _half_log(ratio, own):
    return 0.5 * np.log(max(ratio, own.least_ratio))


@part
def _describe_load(world, b, own, columns):
    tables, e = world.tables, world.env[b]
    kinds, chain = own.reference_load.size, tables.chain_length[e.profile]
    largest, total, share = 0.0, 0.0, 0.0
    for kind in range(kinds):
        asked = own.needs.chain_units[e.profile, kind]
        largest = max(largest, own.needs.largest_units[e.profile, kind] / own.reference_load[kind])
        total += asked / own.reference_load[kind]
        free = tables.vm_total[e.net, kind] - world.ledger.vm_used[b, kind]
        share = max(share, min(asked / max(free, 1), 1.0))
    late, squares = 0.0, 0.0
    for f in range(chain):
        here = 0.0
        for kind in range(kinds):
            # Kinds weigh differently, so that two requests which swap them differ.
            here += tables.load_units[e.profile, f, kind] / own.reference_load[kind] * np.sqrt(1.0 + kind)
        late += here * np.sqrt((f + 0.5) / chain)
        squares += here * here
    columns[ASKED.largest] = _half_log(largest, own)
    columns[ASKED.loads] = _half_log(total / kinds, own)
    columns[ASKED.load_late] = late / max(total, own.least_ratio)
    columns[ASKED.load_uneven] = squares / max(total * total, own.least_ratio)
    columns[ASKED.share] = share


@part
def _describe_traffic(world, b, own, columns):
    tables, e = world.tables, world.env[b]
    segments = tables.chain_length[e.profile] + 1
    total, late, squares = 0.0, 0.0, 0.0
    for segment in range(segments):
        here = tables.rate_units[e.profile, segment] / own.reference_traffic * _is_carried(world, b, segment)
        total += here
        late += here * np.sqrt((segment + 0.5) / segments)
        squares += here * here
    free = (tables.link_total[e.net] - e.link_used) / own.reference_traffic
    columns[ASKED.traffic] = _half_log(total, own)
    columns[ASKED.traffic_late] = late / max(total, own.least_ratio)
    columns[ASKED.traffic_uneven] = squares / max(total * total, own.least_ratio)
    columns[ASKED.traffic_share] = min(total / max(free, own.least_ratio), 1.0)
