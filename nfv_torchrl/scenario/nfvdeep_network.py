"""A topology with the capacities that CN-UPB/NFVdeep (github.com/CN-UPB/NFVdeep) gives to it."""

from __future__ import annotations

import dataclasses
import random
import warnings

import numpy as np

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario.streams import check_seed
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.topology_zoo import read_topology

COSTS = {"cpu": 0.2, "memory": 0.2, "bandwidth": 0.0006}
"""$ for a unit of each, theirs."""


def draw_nfvdeep(
    seed: int,
    path: str = "topohub:sndlib/abilene",
    network_seed: int | None = 0,
    cpu: tuple[int, int] = (1, 500),
    memory: tuple[float, float] = (1.0, 64.0),
    bandwidth: tuple[float, float] = (1.0, 1000.0),
) -> Substrate:
    """The network of ``path`` with one VM a node, of cpu and memory, and links with the bandwidth of the nodes.

    ``graph_generator.py`` of CN-UPB/NFVdeep draws cpu (a whole number), memory and bandwidth for each node in turn. The
    same numbers come from the same generator here: with the defaults they are those of the ``abilene.gpickle`` that all
    their results are of. There, what a function sends is counted on its node alone. Here it is counted on links, so
    each direction of a link carries what the node that sends over it has (full duplex). Delays are those of ``path``.
    Use it by ``scenario.substrate.generator={_target_:nfv_torchrl.scenario.nfvdeep_network.draw_nfvdeep}``.

    Args:
        seed: scenario seed.
        path: as ``scenario.substrate.path``.
        network_seed: what capacities are drawn with; None: the scenario seed.
        cpu: interval of each node's.
        memory: likewise.
        bandwidth: likewise, Mbit/s.

    Raises:
        ScenarioError: ``path`` cannot be read, or an interval does not lie above zero.
    """
    for name, (low, high) in (("cpu", cpu), ("memory", memory), ("bandwidth", bandwidth)):
        if not 0 < low <= high:
            raise ScenarioError(f"nfvdeep_network: {name} is [{low}, {high}]; use two numbers in order, above 0")
    drawn_with = seed if network_seed is None else network_seed
    check_seed(drawn_with)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)  # all that it says is drawn is replaced below
        topology = read_topology(path, seed)
    rng = random.Random(drawn_with)
    nodes = [(rng.randint(*cpu), rng.uniform(*memory), rng.uniform(*bandwidth)) for _ in range(topology.num_nodes)]
    offered = np.array(nodes, np.float64)
    one = np.ones((topology.num_nodes, 1))
    u, v = topology.links.T
    return dataclasses.replace(
        topology,
        vm_count=np.ones(topology.num_nodes, np.int64),
        vm_capacity=offered[:, :1],
        vm_unit_cost=COSTS["cpu"] * one,
        resources=("cpu", "memory"),
        extra_capacity=offered[:, 1:2, None],
        extra_unit_cost=COSTS["memory"] * one[..., None],
        link_capacity=offered[u, 2],
        back_capacity=offered[v, 2],
        link_unit_cost=np.full(topology.num_links, COSTS["bandwidth"]),
    )
