"""Waxman's random networks as Virne's published one is drawn."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.limits import MAX_NODES
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.substrate import Substrate

TRIES = 1000


def draw_waxman(
    seed: int,
    nodes: int = 100,
    beta: float = 0.5,
    alpha: float = 0.2,
    vm_capacity: tuple[int, int] = (50, 100),
    link_capacity: tuple[int, int] = (50, 100),
) -> Substrate:
    """A connected Waxman graph with one VM a node; whole capacities, uniform in intervals whose ends are included.

    Nodes lie anywhere in a square; two have a link with probability ``beta`` exp(-d / (``alpha`` D)), d their distance
    and D the largest of all. Every unit costs 1, links take no time. Use it by
    ``scenario.substrate.generator={_target_:nfv_torchrl.scenario.waxman.draw_waxman}``.

    Args:
        seed: scenario seed.
        nodes: N.
        beta: in (0, 1].
        alpha: positive.
        vm_capacity: of each VM, Mcycles/s.
        link_capacity: of each link, Mbit/s.

    Raises:
        ScenarioError: a value is out of range, or no connected graph was drawn in 1,000 tries.
    """
    if not 2 <= nodes <= MAX_NODES or not 0 < beta <= 1 or not 0 < alpha < math.inf:
        raise ScenarioError(f"waxman: nodes {nodes}, beta {beta}, alpha {alpha}; use 2 or more, (0, 1], above 0")
    for name, (low, high) in (("vm_capacity", vm_capacity), ("link_capacity", link_capacity)):
        if not 1 <= low <= high:
            raise ScenarioError(f"waxman: {name} is [{low}, {high}]; use two integers in order, from 1 on")
    links = _connected_links(generator(seed, Stream.TOPOLOGY), nodes, beta, alpha)
    resources = generator(seed, Stream.RESOURCES)
    cpu = resources.integers(*vm_capacity, size=(nodes, 1), endpoint=True).astype(float)
    bandwidth = resources.integers(*link_capacity, size=len(links), endpoint=True).astype(float)
    return Substrate(
        name=f"waxman-{nodes}",
        labels=tuple(str(node) for node in range(nodes)),
        vm_count=np.ones(nodes, np.int64),
        vm_capacity=cpu,
        vm_unit_cost=np.ones((nodes, 1)),
        links=links,
        link_capacity=bandwidth,
        link_delay=np.zeros(len(links)),
        link_unit_cost=np.ones(len(links)),
        coordinates=None,
    )


def _connected_links(rng: np.random.Generator, nodes: int, beta: float, alpha: float) -> np.ndarray:
    """Ends of the links, int64 [L, 2], of the first graph that is connected."""
    u, v = np.triu_indices(nodes, 1)
    for _ in range(TRIES):
        places = rng.random((nodes, 2))
        distance = np.linalg.norm(places[u] - places[v], axis=1)
        there = rng.random(len(u)) < beta * np.exp(-distance / (alpha * distance.max()))
        links = np.stack([u[there], v[there]], axis=1)
        graph = nx.Graph(links.tolist())
        if len(graph) == nodes and nx.is_connected(graph):
            return links
    raise ScenarioError(f"waxman: {TRIES} graphs of {nodes} nodes were in parts; raise beta or alpha")
