"""``priced`` and ``priced_admit``: the cheapest embedding at prices that rise as resources fill up.

The price of a unit is its unit cost plus p * (M^u - 1) / (M - 1), u the used share of the resource: exponential costs
as in competitive online routing (Awerbuch, Azar and Plotkin 1993). An empty resource costs what it costs, a full one p
more, and the larger M the later the price rises. Of further kinds of resources a full one costs as much more for the
same share of what is installed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import ExactPlanner, over_rows
from nfv_torchrl.search.cheapest import Scratch, grow_scratch, plan_cheapest
from nfv_torchrl.search.walks import Prices
from nfv_torchrl.settings.values import AboveOne, Count, NotNegative
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.tables import Tables


class PriceRule(NamedTuple):
    """The settings of ``PricedPlanner``."""

    price: float  # p, what a full resource costs above its unit cost, $ per unit
    steepness: float  # M, above 1
    admit_threshold: float  # a request whose priced cost ($) exceeds this is refused; inf: none is


class PricedScratch(NamedTuple):
    """Scratch memory of ``priced``, one for each thread."""

    rule: PriceRule
    search: Scratch


@kernel
def fill_prices(world, b, rule, prices):
    """Fill ``Prices`` from what VMs and links of environment b offer."""
    raise_prices(
        world.tables, world.env[b].net, rule, (world.ledger.vm_offered[b], world.ledger.link_offered[b]), prices
    )


@part
def raise_prices(tables, net, rule, offers, prices):
    """The same for the network in row ``net``, from ``offers``: int64 [N, V, R] of VMs and [L] of links."""
    vm_offered, link_offered = offers
    scale = rule.price / (rule.steepness - 1.0)
    rise = np.log(rule.steepness)
    for node in range(tables.num_nodes[net]):
        for vm in range(tables.vm_count[net, node]):
            for kind in range(tables.vm_capacity.shape[3]):
                used = 1.0 - vm_offered[node, vm, kind] / tables.vm_capacity[net, node, vm, kind]
                own = scale if kind == 0 else scale * kind_scale(tables, net, kind)
                unit_cost = tables.vm_unit_cost[net, node, vm, kind]
                prices.vm[node, vm, kind] = unit_cost + own * (np.exp(rise * used) - 1.0)
    for link in range(tables.num_links[net]):
        used = 1.0 - link_offered[link] / tables.link_capacity[net, link]
        prices.link[link] = tables.link_unit_cost[net, link] + scale * (np.exp(rise * used) - 1.0)


@part
def kind_scale(tables, net, kind):
    """What a unit of a kind is worth in units of the first: the installed amount of that over the kind's own."""
    return tables.vm_total[net, 0] / tables.vm_total[net, kind]


@part
def plan_priced(world, b, scratch, plan):
    """``plan_cheapest`` at the prices of ``fill_prices``; 0 also if the request is refused."""
    rule, search = scratch.rule, scratch.search
    prices = Prices(search.vm_price, search.link_price)
    fill_prices(world, b, rule, prices)
    steps = plan_cheapest(world, b, prices, search, plan)
    if steps > 0 and search.result[0] > rule.admit_threshold:
        return 0
    return steps


class PricedPlanner(ExactPlanner):
    """The cheapest embedding at prices that rise with use. It can also refuse requests that are too dear.

    Args:
        price: p, $ per unit that a full resource costs above its unit cost. The default was tuned without refusal.
        steepness: M, how late the price rises.
        admit_threshold: refuse a request whose priced cost ($) exceeds this; None never refuses. ``priced_admit``
            goes with ``price=1600, admit_threshold=16000``.
        labels: limit on the search for one request, see ``ExactPlanner``; what goes beyond it is not proved the
            cheapest at these prices, and counted as ``unproved``. None: no limit.

    Raises:
        ScenarioError: price < 0, steepness <= 1, a negative threshold or labels < 1.
    """

    own: PricedScratch
    kernel = over_rows(plan_priced)

    def __init__(
        self,
        *,
        price: NotNegative = 3200.0,
        steepness: AboveOne = 3000.0,
        admit_threshold: NotNegative | None = None,
        labels: Count | None = None,
    ) -> None:
        super().__init__(labels)
        if not (price >= 0 and np.isfinite(price)):
            raise ScenarioError(f"price is {price}; give a finite number of $ that is not negative")
        if not (steepness > 1 and np.isfinite(steepness)):
            raise ScenarioError(f"steepness is {steepness}; give a finite number above 1")
        if admit_threshold is not None and not admit_threshold >= 0:
            raise ScenarioError(f"admit_threshold is {admit_threshold}; give $ that are not negative, or None")
        threshold = np.inf if admit_threshold is None else float(admit_threshold)
        self.rule = PriceRule(float(price), float(steepness), threshold)

    def make(self, tables: Tables) -> PricedScratch:
        """See ``CompiledPlanner``."""
        return PricedScratch(self.rule, self.make_search(tables))

    def grow(self, tables: Tables) -> PricedScratch:
        """See ``CompiledPlanner``."""
        return self.own._replace(search=grow_scratch(tables, self.own.search))
