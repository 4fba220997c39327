"""Loads a network before learning begins on it: the exact search at noisy prices answers the requests until a slot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.cheapest import grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.search.labels import NO_LIMIT
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room, play_plan
from nfv_torchrl.search.walks import OVERFLOW, Prices
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part

PRICE_NOISE = 0.3
"""Standard deviation of the logarithm of the factors on VM and link unit costs."""


class Refusal(NamedTuple):
    """Who is refused while a network is loaded."""

    fullest: float  # used share of the VMs above which large requests are refused
    large: np.ndarray  # bool [P], whether requests of a profile are large


@part
def _is_refused(world, b, refusal):
    e = world.env[b]
    return refusal.large[e.profile] and (world.ledger.vm_used[b, 0] > refusal.fullest * world.tables.vm_total[e.net, 0])


@kernel
def forward_planned(world, b, slot, prices, refusal, scratch, plan):
    """Answer requests of environment b by ``plan_cheapest`` until ``slot``, but for those that ``refusal`` is about.

    Returns FINISHED, NO_ROOM if the simulator's pools run low, or OVERFLOW if the scratch must grow.
    """
    e = world.env[b]
    while e.slot < slot and e.done == 0:
        if not has_room(world, b):
            return NO_ROOM
        steps = 0
        if not _is_refused(world, b, refusal):
            steps = plan_cheapest(world, b, prices, scratch, plan)
        if steps == OVERFLOW:
            return OVERFLOW
        play_plan(world, b, steps, plan)
    return FINISHED


class Loader:
    """Brings environments of a simulator to a later slot, each by prices of its own.

    The search accepts nearly whatever fits, so the loads are those that a good method leads to; the noise on the prices
    fills other VMs and links each time.

    Args:
        simulator: whose environments are loaded.
        fullest: None, or a range that a used share of the VMs is drawn from each time. Above that share large requests
            (more load than services have on average) are refused, as a method that chooses its requests does, and no
            search is made for them.
        labels: walks that a search may keep; beyond that the answer is that of a narrow search. None: no limit.
    """

    def __init__(
        self, simulator: Simulator, fullest: tuple[float, float] | None = None, labels: int | None = None
    ) -> None:
        self.simulator, self.fullest = simulator, fullest
        unproved = np.zeros(simulator.batch_size, np.int64)
        self._scratch = make_scratch(simulator.tables, allowed=labels or NO_LIMIT, unproved=unproved)
        self._large = _large(simulator)
        self._plan = np.zeros(simulator.world.rules.max_steps, np.int64)

    def forward(self, b: int, slot: int, rng: np.random.Generator) -> None:
        """Answer requests of environment b, whose horizon has begun, until ``slot`` or the horizon's end."""
        tables, net = self.simulator.tables, self.simulator.world.env["net"][b]
        vm_price = tables.vm_unit_cost[net] * np.exp(rng.normal(0.0, PRICE_NOISE, tables.vm_unit_cost[net].shape))
        link_price = tables.link_unit_cost[net] * np.exp(rng.normal(0.0, PRICE_NOISE, tables.link_unit_cost[net].shape))
        prices = Prices(vm_price, link_price)
        refusal = Refusal(np.inf if self.fullest is None else rng.uniform(*self.fullest), self._large)
        while True:
            outcome = forward_planned(self.simulator.world, b, slot, prices, refusal, self._scratch, self._plan)
            if outcome == FINISHED:
                break
            if outcome == NO_ROOM:
                self.simulator.make_room_for(b)
            else:
                self._scratch = grow_scratch(tables, self._scratch)
        self.simulator.make_room_for(b)  # the last plan may have taken what the next step needs
        self.simulator.clear_outcome(b)


def _large(simulator: Simulator) -> np.ndarray:
    """Profiles with more load than services have on average, or, where requests bring their own, than all profiles."""
    tables = simulator.tables
    load = tables.load[:, :, 0].sum(axis=1)
    if simulator.world.seen.demand:
        return load * load.size > load.sum()
    return (load * tables.services > load[: tables.services].sum())[tables.service]
