"""What no embedding can beat, for all pairs of nodes at once: its delay, its cost, and the links it has to cross."""

from __future__ import annotations

import networkx as nx
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import to_ledger
from nfv_torchrl.simulator.steps import link_cost, link_delay, vm_delay

ALL_SETS_UP_TO = 10
"""Nodes up to which every set of nodes is looked at as a cut; 2^9 - 1 of them for 10."""


def least_delay(scenario: Scenario, service: int) -> np.ndarray:
    """ms that a request of type ``service`` takes at least on the empty network, float64 [N, N], inf if impossible.

    A relaxation: a link or VM used twice is not counted twice, and a walk may pass through the egress and go on.
    """
    substrate, rate = scenario.substrate, scenario.catalogue.rate[service]
    hop = link_delay(substrate.link_delay, rate, substrate.link_capacity)
    speed = np.where(substrate.vm_capacity > 0, substrate.vm_capacity, 1.0)
    return _least(scenario, service, hop, vm_delay(1.0, speed))


def least_cost(scenario: Scenario, service: int) -> np.ndarray:
    """$ that a request of type ``service`` costs at least, delay ignored, float64 [N, N]; relaxed as the delay is."""
    substrate, rate = scenario.substrate, scenario.catalogue.rate[service]
    return _least(scenario, service, link_cost(substrate.link_unit_cost, rate), substrate.vm_unit_cost)


def _least(scenario: Scenario, service: int, hop: np.ndarray, per_load: np.ndarray) -> np.ndarray:
    """Least sum of ``hop`` [L] over links and ``per_load`` [N, V] times the load over placements, [ingress, egress]."""
    substrate, catalogue = scenario.substrate, scenario.catalogue
    usable = to_ledger(substrate.link_capacity) >= to_ledger(catalogue.rate)[service]
    direct = np.full((substrate.num_nodes,) * 2, np.inf)
    u, v = substrate.links[usable].T
    direct[u, v] = direct[v, u] = hop[usable]
    route = _shortest(direct)
    # Without colocation every function not on the egress comes with a hop of its own, be it there and back.
    move = route if scenario.colocation else _min_plus(direct, route)
    capacity, loads = to_ledger(substrate.vm_capacity), catalogue.load[service, : catalogue.chain_length[service]]
    fits = (capacity[None] >= to_ledger(loads)[:, None, None]) & (capacity > 0)
    place = np.where(fits, per_load * loads[:, None, None], np.inf).min(axis=2)  # [functions, N]
    at_egress = np.zeros(len(loads) + 1)[:, None] + np.zeros(substrate.num_nodes)
    at_egress[:-1] = np.cumsum(place[::-1], axis=0)[::-1]  # the functions from i on, all at the egress
    best = route + at_egress[0]
    before = np.where(np.eye(substrate.num_nodes, dtype=bool), 0.0, np.inf)  # with i functions placed, being anywhere
    for i in range(len(loads)):
        before = _min_plus(before, move) + place[i]
        best = np.minimum(best, _min_plus(before, route) + at_egress[i + 1])
    return best


def _shortest(direct: np.ndarray) -> np.ndarray:
    u, v = np.nonzero(np.isfinite(direct))
    return dijkstra(csr_array((direct[u, v], (u, v)), shape=direct.shape))


def _min_plus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([(row[:, None] + b).min(axis=0) for row in a])


def candidate_cuts(substrate: Substrate) -> np.ndarray:
    """Sets of nodes, bool [M, N], whose leaving links may be what is scarce.

    Every set on a small network. On larger ones every node, every two neighbours, and the minimum cuts between all
    pairs of nodes (N - 1 of them suffice, by Gomory and Hu).
    """
    nodes = substrate.num_nodes
    if nodes <= ALL_SETS_UP_TO:
        number = np.arange(1, 2 ** (nodes - 1))
        return (number[:, None] >> np.arange(nodes)) % 2 == 1  # sets without the last node: a set and the rest are one
    singles = np.eye(nodes, dtype=bool)
    pairs = singles[substrate.links[:, 0]] | singles[substrate.links[:, 1]]
    return np.unique(np.concatenate([singles, pairs, _minimum_cuts(substrate)]), axis=0)


def _minimum_cuts(substrate: Substrate) -> np.ndarray:
    graph = nx.Graph()
    for (u, v), capacity in zip(substrate.links.tolist(), substrate.link_capacity.tolist(), strict=True):
        graph.add_edge(u, v, capacity=capacity)
    tree = nx.gomory_hu_tree(graph)
    cuts = np.zeros((substrate.num_nodes - 1, substrate.num_nodes), dtype=bool)
    for row, (u, v) in enumerate(list(tree.edges)):
        rest = nx.restricted_view(tree, [], [(u, v)])
        cuts[row, list(nx.node_connected_component(rest, u))] = True
    return cuts


def crossed(cuts: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Which node pairs int64 [P, 2] have their ends on different sides of which cut bool [M, N]; bool [M, P]."""
    return cuts[:, pairs[:, 0]] != cuts[:, pairs[:, 1]]
