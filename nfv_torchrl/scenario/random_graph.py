"""Random substrates: a uniform random labelled tree plus uniformly drawn extra links."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import SubstrateConfig
from nfv_torchrl.scenario.limits import MAX_NODES, PAIR_BYTES, check_memory, random_graph_parts, would_take
from nfv_torchrl.scenario.resources import ResourceRanges, draw_links, draw_vms
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.settings.values import shown

LARGEST_DEGREE = 1e9
"""Far beyond a complete graph of the largest network."""


def draw_random_substrate(
    nodes: int, seed: int, *, mean_degree: float = SubstrateConfig.mean_degree, **ranges: Any
) -> Substrate:
    """A connected random network of ``nodes`` nodes (the paper's "Simulation Results": N from 10 to 100).

    The graph has round(mean_degree * N / 2) links, at least N - 1 and at most N (N - 1) / 2, and comes from the
    topology stream of ``seed``; VMs and link numbers come from its resources stream.

    Args:
        nodes: N >= 2.
        seed: scenario seed >= 0.
        mean_degree: links per node times two.
        ranges: any field of ``ResourceRanges``, as ``vm_capacity=(200, 1200)``.

    Raises:
        ScenarioError: an argument is out of range.
    """
    if isinstance(nodes, bool) or not isinstance(nodes, int | np.integer) or nodes < 2:
        raise ScenarioError(f"nodes: {nodes!r} makes no network; use an integer of at least 2")
    if isinstance(mean_degree, str | bool) or not 0 < mean_degree <= LARGEST_DEGREE:
        raise ScenarioError(f"mean_degree: {mean_degree!r} is no degree; use a positive number, such as 4")
    if nodes > MAX_NODES:
        size = would_take(PAIR_BYTES * float(min(nodes, 10**100)) ** 2)
        raise ScenarioError(f"nodes: {shown(nodes)}; use an integer of at most {MAX_NODES}{size}")
    drawn_from = ResourceRanges(**ranges)
    check_memory(random_graph_parts(int(nodes), _count_links(int(nodes), mean_degree), int(drawn_from.vms[1])))
    links = draw_random_links(int(nodes), seed, mean_degree)
    vms = draw_vms(nodes, seed, drawn_from)
    numbers = draw_links(len(links), seed, drawn_from)
    return Substrate(
        name=f"random_{nodes}_seed_{seed}",
        labels=tuple(str(node) for node in range(nodes)),
        **vms._asdict(),
        links=links,
        link_capacity=numbers.capacity,
        link_delay=numbers.delay,
        link_unit_cost=numbers.unit_cost,
    )


def draw_random_links(nodes: int, seed: int, mean_degree: float) -> np.ndarray:
    """Ends of the links, int64 [L, 2], u < v, sorted."""
    rng = generator(seed, Stream.TOPOLOGY)
    # A Pruefer sequence drawn uniformly is a labelled tree drawn uniformly.
    tree = nx.from_prufer_sequence(rng.integers(nodes, size=nodes - 2).tolist())
    pairs = np.stack(np.triu_indices(nodes, 1), axis=1)
    in_tree = np.zeros((nodes, nodes), bool)
    u, v = np.sort(np.array(tree.edges, np.int64), axis=1).T
    in_tree[u, v] = True
    taken = in_tree[pairs[:, 0], pairs[:, 1]]
    taken[rng.choice(np.flatnonzero(~taken), size=_count_links(nodes, mean_degree) - (nodes - 1), replace=False)] = True
    return pairs[taken].astype(np.int64)


def _count_links(nodes: int, mean_degree: float) -> int:
    return min(max(round(mean_degree * nodes / 2), nodes - 1), nodes * (nodes - 1) // 2)
