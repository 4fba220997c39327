"""The current request, in plain numbers."""

from __future__ import annotations

import numpy as np
import torch
from torchrl.data import Categorical, Composite, Unbounded

from nfv_torchrl.observations.base import gather
from nfv_torchrl.simulator import Simulator

INTEGERS = ("service", "ingress", "egress", "node", "function")
NUMBERS = ("rate", "tolerable_delay", "remaining_delay")


class RequestObservation:
    """Key ``request``, nested; everything of shape [B].

    int64: ``service`` (type index), ``ingress``, ``egress``, ``node`` (where the walk is), ``function`` (index of the
    next function). float32: ``rate`` (Mbit/s), ``tolerable_delay`` and ``remaining_delay`` (ms), and ``lifetime`` (s)
    if the scenario has ``observe_lifetime``. Zero past the end of the horizon.
    """

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        batch = torch.Size([simulator.batch_size])
        tables = simulator.tables
        services, functions = tables.load.shape
        nodes = tables.vm_count.shape[1]
        ends = {"service": services, "function": functions + 1}  # a whole chain is placed before the walk ends
        spec = {name: Categorical(ends.get(name, nodes), shape=batch, dtype=torch.int64) for name in INTEGERS}
        spec |= {name: Unbounded(batch, dtype=torch.float32) for name in self._numbers(simulator)}
        return {"request": Composite(spec, shape=batch)}

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        values = current_requests(simulator)
        tensors = {name: torch.from_numpy(values[name]) for name in INTEGERS}
        tensors |= {name: torch.from_numpy(values[name].astype(np.float32)) for name in self._numbers(simulator)}
        return {"request": gather(tensors, simulator.batch_size)}

    @staticmethod
    def _numbers(simulator: Simulator) -> tuple[str, ...]:
        return (*NUMBERS, "lifetime") if simulator.scenarios[0].observe_lifetime else NUMBERS


def current_requests(simulator: Simulator) -> dict[str, np.ndarray]:
    """The request each environment is at, arrays [B] by name; zeros past the end of the horizon."""
    env, tables = simulator.world.env, simulator.tables
    active = env["done"] == 0
    values = {name: np.where(active, env[name], 0) for name in (*INTEGERS, "lifetime")}
    service = values["service"]
    values["rate"] = np.where(active, tables.rate[service], 0.0)
    values["tolerable_delay"] = np.where(active, tables.tolerable_delay[service], 0.0)
    values["remaining_delay"] = np.where(active, values["tolerable_delay"] - env["elapsed"], 0.0)
    return values
