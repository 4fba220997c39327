"""How what a policy sees of a request's menu is laid out: its columns, and the measures that they are given in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.columns import columns
from nfv_torchrl.observations.asked import ASKED
from nfv_torchrl.simulator.compiled import part


class StateFeatures(NamedTuple):
    """Numbers of the network and the request."""

    demand: int  # load of the chain over the mean over services
    stay: int  # what the lifetime makes of a bid price, see ``stay_of``; 1 where lifetimes are hidden
    log_demand: int
    rate: int  # log of the rate over the mean over services, over 4
    near: int  # least delay of hops from ingress to egress over the tolerable delay
    vm_used: int  # used share of all VMs
    vm_used_pow8: int
    link_used: int  # used share of all links
    colocation: int  # 1 where functions may share a node
    nodes: int  # log of their number, over 5
    vm_size: int  # log of the mean capacity of a VM over the reference load, over 5
    least_cost: int  # log of the cost of the cheapest walk over that of its load at mean prices, over 3
    offered_walks: int  # share of the walks that are offered
    ingress_room: int  # room on the links of the ingress; of a free one, of the node where there is most
    egress_room: int  # and of the egress


class ServiceFeatures(NamedTuple):
    """Numbers of each service type, over those of its requests that are among the latest ones."""

    vm_room: int  # least room on VMs that a request can reach and that its largest function fits on
    vm_room_mean: int
    link_room: int  # least room on the links of one of its ends
    close: int  # mean closeness to finding no room: 1 where nothing is left, 1/2 where FEW more requests fit


class RowFeatures(NamedTuple):
    """Numbers of one walk. Means over its VMs are weighted by load."""

    regret: int  # cost over that of the cheapest walk, less 1, at most MOST_REGRET
    delay: int  # share of the tolerable delay
    hops: int  # a tenth of their number
    more_hops: int  # a tenth of those more than the cheapest walk has
    vm_used: int  # mean used share of its VMs
    vm_used_pow16: int
    vm_room: int  # mean room that it leaves on its VMs
    vm_room_least: int
    link_used: int  # mean used share of its links
    link_used_pow16: int
    link_room_least: int  # on its links
    ends_room: int  # least room on the links of a node that it passes and where one of the latest requests ends


class RowServiceFeatures(NamedTuple):
    """Numbers of one walk for each service type."""

    closes: int  # share of its load on VMs that it leaves too little of for the largest function of the type
    closer: int  # by how much it raises the mean closeness to finding no room, see ServiceFeatures
    closer_most: int  # by how much that of the request that it raises most
    room_least: int  # room, in requests of the type, that it leaves the one with the least


STATE = columns(StateFeatures)
SERVICE = columns(ServiceFeatures)
ROW = columns(RowFeatures)
ROW_SERVICE = columns(RowServiceFeatures)
MOST_REGRET = 5.0
"""Costs are seen up to this multiple above the least."""
FACTORS = 2
"""The first columns of the state, which a price is multiplied by; perceptrons see the others."""
SCALE = 8.0
"""Room is log(1 + what is free / reference) over this: 0 where nothing is left, 1 for 3000 references."""


class MenuShape(NamedTuple):
    """How a flat observation of a menu is laid out: ``state`` numbers, then ``row`` numbers for each of ``rows``.

    The state has the columns of ``StateFeatures``, of ``ServiceFeatures`` for each service type and, where requests are
    described by what they ask (``describes_asked``), of ``AskedFeatures``.
    """

    state: int
    row: int
    rows: int

    @classmethod
    def of(cls, services: int, rows: int, asked: bool = False) -> MenuShape:
        """The layout for so many service types and walks, with what requests ask for or without."""
        state = len(STATE) + services * len(SERVICE) + (len(ASKED) if asked else 0)
        return cls(state, len(ROW) + services * len(ROW_SERVICE), rows)

    @property
    def size(self) -> int:
        """P, of the flat observation."""
        return self.state + self.rows * self.row


@part
def room_of(free, reference):
    """Room for what is free, in requests (or rates) of the size ``reference``; see ``SCALE``."""
    return np.log(1.0 + free / reference) / SCALE


@part
def what_fits(room):
    """For how many requests (or rates) of the size of its reference ``room_of`` gives ``room``."""
    return np.exp(room * SCALE) - 1.0


@part
def least_room(free, references):
    """The room of the kind with the least."""
    room = room_of(free[0], references[0])
    for kind in range(1, references.size):
        room = min(room, room_of(free[kind], references[kind]))
    return room


@part
def pow8(x):
    """x to the power of eight: near 0 but where a share is nearly 1."""
    x = x * x
    x = x * x
    return x * x
