"""The current request, in plain numbers."""

from __future__ import annotations

import numpy as np
import torch
from torchrl.data import Categorical, Composite, Unbounded

from nfv_torchrl.observations.base import gather
from nfv_torchrl.simulator import Simulator

INTEGERS = ("service", "ingress", "egress", "node", "function")
DEMANDS = ("amounts", "rates", "delays", "chain_length")
MOST_DELAY = 1e9
"""ms shown where any delay will do."""
NUMBERS = ("rate", "tolerable_delay", "remaining_delay")


class RequestObservation:
    """Key ``request``, nested; everything of shape [B].

    int64: ``service`` (type index), ``ingress``, ``egress``, ``node`` (where the walk is), ``function`` (index of the
    next function). float32: ``rate`` (Mbit/s, of the next segment), ``tolerable_delay`` and ``remaining_delay`` (ms;
    1e9 where any delay will do), and ``lifetime`` (s) if the scenario has ``observe_lifetime``. With requests whose
    ends may be free, N stands for a free end and for off the network. Where requests bring profiles of their own, also
    ``amounts`` [B, F, R] and ``rates`` [B, F + 1], as shares of the largest of all, ``delays`` [B, F] (ms of each
    function beside what follows from its load) and int64 ``chain_length`` [B]. Zero past the end of the horizon.
    """

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        batch = torch.Size([simulator.batch_size])
        tables = simulator.tables
        services, (_, functions, kinds) = tables.services, tables.load.shape
        nodes = tables.vm_count.shape[1] + simulator.world.rules.free_ends
        ends = {"service": services, "function": functions + 1}  # a whole chain is placed before the walk ends
        spec = {name: Categorical(ends.get(name, nodes), shape=batch, dtype=torch.int64) for name in INTEGERS}
        spec |= {name: Unbounded(batch, dtype=torch.float32) for name in self._numbers(simulator)}
        if simulator.world.seen.demand:
            spec["amounts"] = Unbounded((*batch, functions, kinds), dtype=torch.float32)
            spec["rates"] = Unbounded((*batch, functions + 1), dtype=torch.float32)
            spec["delays"] = Unbounded((*batch, functions), dtype=torch.float32)
            spec["chain_length"] = Categorical(functions + 1, shape=batch, dtype=torch.int64)
        return {"request": Composite(spec, shape=batch)}

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        values = current_requests(simulator)
        tensors = {name: torch.from_numpy(values[name]) for name in INTEGERS}
        tensors |= {name: torch.from_numpy(values[name].astype(np.float32)) for name in self._numbers(simulator)}
        if simulator.world.seen.demand:
            tensors |= {name: torch.from_numpy(values[name]) for name in DEMANDS}
        return {"request": gather(tensors, simulator.batch_size)}

    @staticmethod
    def _numbers(simulator: Simulator) -> tuple[str, ...]:
        return (*NUMBERS, "lifetime") if simulator.scenarios[0].observe_lifetime else NUMBERS


def current_requests(simulator: Simulator) -> dict[str, np.ndarray]:
    """The request each environment is at, arrays [B] by name; zeros past the end of the horizon."""
    env, tables = simulator.world.env, simulator.tables
    active = env["done"] == 0
    values = {name: np.where(active, env[name], 0) for name in (*INTEGERS, "lifetime")}
    if simulator.world.rules.free_ends:
        nodes = tables.vm_count.shape[1]
        values |= {name: np.where(values[name] < 0, nodes, values[name]) for name in ("ingress", "egress", "node")}
    profile = np.where(active, env["profile"], 0)
    tolerable = np.minimum(tables.tolerable_delay[profile], MOST_DELAY)
    values["rate"] = np.where(active, tables.rate[profile, env["function"]], 0.0)
    values["tolerable_delay"] = np.where(active, tolerable, 0.0)
    values["remaining_delay"] = np.where(active, values["tolerable_delay"] - env["elapsed"], 0.0)
    if simulator.world.seen.demand:
        amounts = tables.load[profile] / tables.largest_amount * active[:, None, None]
        values["amounts"] = amounts.astype(np.float32)
        values["rates"] = (tables.rate[profile] / tables.largest_rate * active[:, None]).astype(np.float32)
        values["delays"] = (tables.fixed_delay[profile] * active[:, None]).astype(np.float32)
        values["chain_length"] = tables.chain_length[profile] * active
    return values
