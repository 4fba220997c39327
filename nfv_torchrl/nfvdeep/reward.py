"""The reward of NFVdeep: income of an accepted request less the cost of its embedding."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nfv_torchrl.rewards import CostScale
from nfv_torchrl.settings.values import NotNegative
from nfv_torchrl.simulator import Simulator


class Profit:
    """Income - cost of a request when it is accepted, 0 when it is rejected and on every step before.

    The income of a request is what it asks for at the substrate's mean unit prices, its whole load on VMs and its rate
    on one link, times ``markup``; it does not depend on the lifetime, which a controller does not know. The cost is the
    phi that the ledger charges.

    Args:
        markup: the larger, the more acceptance counts beside cost. Below 3 or so accepting can be a loss.
        relative: divide by the request's own income, so that every request counts alike (1 - cost / income at most 1);
            otherwise by the mean income of the services, so that large requests count for more.

    It is a ``nfv_torchrl.rewards.Reward`` that an environment prepares; the scale is not used.
    """

    def __init__(self, *, markup: NotNegative = 4.0, relative: bool = False) -> None:
        self.markup, self.relative = markup, relative

    def prepare(self, simulator: Simulator) -> None:
        """Read unit prices, services and each environment's substrate from ``simulator``."""
        tables = simulator.tables
        links = _mean_where(tables.link_unit_cost, tables.link_capacity > 0)
        chains = tables.load.sum(axis=1)[: tables.services]
        kinds = range(chains.shape[1])
        vm_parts = [
            _mean_where(tables.vm_unit_cost[..., kind], tables.vm_capacity[..., kind] > 0)[:, None] * chains[:, kind]
            for kind in kinds
        ]
        rate = tables.rate[: tables.services].max(axis=1)
        self.income = self.markup * (sum(vm_parts) + links[:, None] * rate)[simulator.world.env["net"]]
        mean = np.broadcast_to(self.income.mean(1, keepdims=True), self.income.shape)
        self.scale = self.income if self.relative else mean

    def __call__(self, outcome: Mapping[str, np.ndarray], scale: CostScale) -> np.ndarray:
        """Reward of every environment's last step."""
        rows, service = np.arange(len(self.income)), outcome["service"].astype(np.int64)
        profit = (self.income[rows, service] - outcome["request_cost"]) / self.scale[rows, service]
        return np.where(outcome["accepted"] > 0, profit, 0.0)


def _mean_where(values: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Mean over what exists of each substrate, [S, ...] to [S]."""
    axes = tuple(range(1, values.ndim))
    return (values * exists).sum(axis=axes) / exists.sum(axis=axes)
