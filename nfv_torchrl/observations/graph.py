"""The whole network as a graph, for graph networks."""

from __future__ import annotations

import numpy as np
import torch
from torchrl.data import Categorical, Composite, Unbounded

from nfv_torchrl.codec import count_vms
from nfv_torchrl.observations.base import gather
from nfv_torchrl.observations.request import current_requests
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.steps import link_delay
from nfv_torchrl.simulator.view import demand_size

VM_FEATURES = ("exists", "use", "speed", "unit_cost")
LINK_FEATURES = ("exists", "use", "delay", "unit_cost")
NODE_FEATURES = ("current", "ingress", "egress")


class GraphObservation:
    """Key ``graph``, nested, float32 but for ``link_ends``:

    ``vms`` [B, N, V, 1 + 3 R]: exists, then for each of the R kinds of resources used share, capacity and unit cost
    over the network's mean. ``links`` [B, L, 4]: exists, used share, delay of the hop over the tolerable delay, unit
    cost over the mean; with full duplex a row for each direction. ``link_ends`` int64 [B, L, 2]. ``nodes`` [B, N, 3]:
    one-hot current node, ingress, egress; none where that is free. ``request`` [B, K + 2]: one-hot service type,
    functions placed of the longest chain, delay elapsed of what is tolerable; where requests bring profiles of their
    own, the demand follows, as in the flat observation.
    """

    def __init__(self) -> None:
        self._simulator: Simulator | None = None

    def _prepare(self, simulator: Simulator) -> None:
        if self._simulator is simulator:
            return
        self._simulator = simulator
        tables, net = simulator.tables, simulator.world.env["net"]
        kinds = range(tables.vm_capacity.shape[3])
        vm_exists = tables.vm_capacity[..., 0] > 0
        link_exists = tables.link_capacity > 0
        self._vm_exists = vm_exists[net]
        self._vm_static = [
            [(values[..., kind] / _mean_where(values[..., kind], vm_exists))[net] for kind in kinds]
            for values in (tables.vm_capacity, tables.vm_unit_cost)
        ]
        self._link_static = [
            link_exists[net],
            (tables.link_unit_cost / _mean_where(tables.link_unit_cost, link_exists))[net],
        ]
        self._ends = torch.from_numpy(tables.link_ends[net].astype(np.int64))

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        batch = torch.Size([simulator.batch_size])
        _, nodes, vms, kinds = simulator.world.ledger.vm_offered.shape
        links = simulator.world.ledger.link_offered.shape[1]
        return {
            "graph": Composite(
                vms=Unbounded((*batch, nodes, vms, 1 + kinds * (len(VM_FEATURES) - 1)), dtype=torch.float32),
                links=Unbounded((*batch, links, len(LINK_FEATURES)), dtype=torch.float32),
                link_ends=Categorical(nodes, shape=(*batch, links, 2), dtype=torch.int64),
                nodes=Unbounded((*batch, nodes, len(NODE_FEATURES)), dtype=torch.float32),
                request=Unbounded((*batch, _request_size(simulator)), dtype=torch.float32),
                shape=batch,
            )
        }

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        self._prepare(simulator)
        batch = simulator.batch_size
        _, nodes, vms, kinds = simulator.world.ledger.vm_offered.shape
        flat, tables = simulator.world.seen.flat, simulator.tables
        requests, rows = current_requests(simulator), np.arange(batch)
        places = kinds * count_vms(nodes, vms)
        use = flat[:, :places].reshape(batch, nodes, vms, kinds)
        columns = [(use[..., kind], *(values[kind] for values in self._vm_static)) for kind in range(kinds)]
        link_exists, link_cost = self._link_static
        env = simulator.world.env
        net, profile = env["net"], np.where(env["done"] == 0, env["profile"], 0)
        rate = tables.rate[profile, np.where(env["done"] == 0, env["function"], 0)]
        hop = link_delay(tables.link_delay[net], rate[:, None], tables.link_speed[net])
        delay = np.where(link_exists, hop, 0.0) / tables.tolerable_delay[profile][:, None]
        link_use = flat[:, places:][:, : link_exists.shape[1]]
        marks = np.zeros((batch, nodes, len(NODE_FEATURES)), np.float32)
        for column, name in enumerate(("node", "ingress", "egress")):
            there = requests[name] < nodes
            marks[rows[there], requests[name][there], column] = 1.0
        values = {
            "vms": _stack(self._vm_exists, *(column for columns_of in columns for column in columns_of)),
            "links": _stack(link_exists, link_use, delay, link_cost),
            "link_ends": self._ends.clone(),
            "nodes": torch.from_numpy(marks),
            "request": torch.from_numpy(_describe_request(simulator)),
        }
        return {"graph": gather(values, batch)}


def _request_size(simulator: Simulator) -> int:
    """Numbers of ``request``."""
    _, functions, kinds = simulator.tables.load.shape
    return simulator.tables.services + 2 + (demand_size(functions, kinds) if simulator.world.seen.demand else 0)


def _describe_request(simulator: Simulator) -> np.ndarray:
    """What the request in hand is, beside its nodes, float32 [B, K + 2 + demand]; zeros past the end of the horizon."""
    env, tables, seen = simulator.world.env, simulator.tables, simulator.world.seen
    services, live = tables.services, env["done"] == 0
    values = np.zeros((len(env), _request_size(simulator)), np.float32)
    values[live, env["service"][live]] = 1.0
    values[:, services] = env["function"] / tables.load.shape[1]
    values[:, services + 1] = env["elapsed"] / tables.tolerable_delay[env["profile"]]
    values[:, services + 2 :] = seen.flat[:, seen.flat.shape[1] - (values.shape[1] - services - 2) :]
    values[~live] = 0.0
    return values


def _stack(*columns: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack([column.astype(np.float32) for column in columns], axis=-1))


def _mean_where(values: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Mean over what exists in each substrate, shaped to divide ``values`` [S, ...]."""
    axes = tuple(range(1, values.ndim))
    return (values * exists).sum(axis=axes, keepdims=True) / exists.sum(axis=axes, keepdims=True)
