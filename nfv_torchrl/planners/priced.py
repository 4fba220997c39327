"""``priced`` and ``priced_admit``: the cheapest embedding at prices that rise as resources fill up.

The price of a unit is its unit cost plus p * (M^u - 1) / (M - 1), u the used share of the resource: exponential costs
as in competitive online routing (Awerbuch, Azar and Plotkin 1993). An empty resource costs what it costs, a full one p
more, and the larger M the later the price rises.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import CompiledPlanner
from nfv_torchrl.planners.cheapest import Scratch, grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.planners.compiled import kernel
from nfv_torchrl.planners.walks import OVERFLOW
from nfv_torchrl.settings.values import AboveOne, NotNegative
from nfv_torchrl.simulator.tables import Rules, Tables


@kernel
def fill_prices(tables, net, vm_offered, link_offered, price, steepness, vm_price, link_price):
    """Prices of VMs ($ per Mcycles/s, float64 [N, V]) and links ($ per Mbit/s, float64 [L]) from what they offer."""
    scale = price / (steepness - 1.0)
    rise = np.log(steepness)
    for node in range(tables.num_nodes[net]):
        for vm in range(tables.vm_count[net, node]):
            used = 1.0 - vm_offered[node, vm] / tables.vm_capacity[net, node, vm]
            vm_price[node, vm] = tables.vm_unit_cost[net, node, vm] + scale * (np.exp(rise * used) - 1.0)
    for link in range(tables.num_links[net]):
        used = 1.0 - link_offered[link] / tables.link_capacity[net, link]
        link_price[link] = tables.link_unit_cost[net, link] + scale * (np.exp(rise * used) - 1.0)


@kernel
def plan_priced(
    tables,
    rules,
    net,
    vm_offered,
    link_offered,
    service,
    ingress,
    egress,
    price,
    steepness,
    admit_threshold,
    scratch,
    plan,
):
    """``plan_cheapest`` at the prices of ``fill_prices``, with its other arguments.

    Args:
        price: p, what a full resource costs above its unit cost ($ per unit).
        steepness: M, above 1.
        admit_threshold: refuse (return 0) a request whose priced cost ($) exceeds this; inf: never.

    Returns:
        Number of actions, 0 if infeasible or refused, OVERFLOW (-1) if the scratch must grow.
    """
    vm_price, link_price = scratch.vm_price, scratch.link_price
    fill_prices(tables, net, vm_offered, link_offered, price, steepness, vm_price, link_price)
    steps = plan_cheapest(
        tables,
        rules,
        net,
        vm_offered,
        link_offered,
        vm_price,
        link_price,
        service,
        ingress,
        egress,
        scratch,
        plan,
    )
    if steps > 0 and scratch.result[0] > admit_threshold:
        return 0
    return steps


@kernel
def plan_priced_batch(
    tables,
    rules,
    rows,
    env_net,
    vm_offered,
    link_offered,
    service,
    ingress,
    egress,
    price,
    steepness,
    admit_threshold,
    scratch,
    plans,
    lengths,
):
    """``plan_priced`` for every environment in ``rows``; returns how many were answered before an overflow."""
    for done in range(rows.size):
        b = rows[done]
        lengths[b] = plan_priced(
            tables,
            rules,
            env_net[b],
            vm_offered[b],
            link_offered[b],
            service[b],
            ingress[b],
            egress[b],
            price,
            steepness,
            admit_threshold,
            scratch,
            plans[b],
        )
        if lengths[b] == OVERFLOW:
            return done
    return rows.size


class PricedPlanner(CompiledPlanner):
    """Cheapest embedding at prices that rise with use, and optionally refusal of what is too dear.

    Args:
        price: p, $ per unit that a full resource costs above its unit cost. The default was tuned without refusal.
        steepness: M, how late the price rises.
        admit_threshold: refuse a request whose priced cost ($) exceeds this; None never refuses. ``priced_admit``
            goes with ``price=1600, admit_threshold=16000``.

    Raises:
        ScenarioError: price < 0, steepness <= 1 or a negative threshold.
    """

    _scratch: Scratch

    def __init__(
        self, *, price: NotNegative = 3200.0, steepness: AboveOne = 3000.0, admit_threshold: NotNegative | None = None
    ) -> None:
        super().__init__()
        if not (price >= 0 and np.isfinite(price)):
            raise ScenarioError(f"price is {price}; give a finite number of $ that is not negative")
        if not (steepness > 1 and np.isfinite(steepness)):
            raise ScenarioError(f"steepness is {steepness}; give a finite number above 1")
        if admit_threshold is not None and not admit_threshold >= 0:
            raise ScenarioError(f"admit_threshold is {admit_threshold}; give $ that are not negative, or None")
        self.price = float(price)
        self.steepness = float(steepness)
        self.admit_threshold = np.inf if admit_threshold is None else float(admit_threshold)

    def _make(self, tables: Tables, rules: Rules) -> Scratch:
        return make_scratch(tables)

    def _grow(self, tables: Tables) -> Scratch:
        return grow_scratch(tables, self._scratch)

    def _kernel(self, *request: Any) -> int:
        prices = (self.price, self.steepness, self.admit_threshold)
        return plan_priced(*request[:-1], *prices, self._scratch, request[-1])

    def _batch(self, *requests: Any) -> int:
        prices = (self.price, self.steepness, self.admit_threshold)
        return plan_priced_batch(*requests[:-2], *prices, self._scratch, *requests[-2:])
