"""What no embedding can beat, for all pairs of nodes at once: its delay, its cost, and the links it has to cross."""

from __future__ import annotations

from collections.abc import Callable

import networkx as nx
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import to_ledger
from nfv_torchrl.simulator.steps import link_cost, link_delay, vm_cost, vm_delay

ALL_SETS_UP_TO = 10
"""Nodes up to which every set of nodes is looked at as a cut; 2^9 - 1 of them for 10."""


def least_delay(scenario: Scenario, profile: int) -> np.ndarray:
    """ms that a request of ``profile`` takes at least on the empty network, float64 [N + 1, N + 1], inf if impossible.

    By ingress and egress; the last row is for a free ingress, the last column for a free egress. A relaxation: a link
    or VM used twice is not counted twice, functions that may not share a node only not two in a row, and a walk may
    pass through the egress and go on.
    """
    substrate, profiles = scenario.substrate, scenario.profiles
    speed = np.where(substrate.vm_capacity > 0, substrate.vm_capacity, 1.0)
    length = profiles.chain_length[profile]
    work, fixed = profiles.work[profile, :length], profiles.fixed_delay[profile, :length]
    place = fixed[:, None, None] + vm_delay(1.0, speed) * work[:, None, None]

    def hop(rate: float) -> tuple[np.ndarray, np.ndarray]:
        return tuple(link_delay(substrate.link_delay, rate, capacity) for capacity in _capacities(substrate))

    return _least(scenario, profile, hop, place)


def least_cost(scenario: Scenario, profile: int) -> np.ndarray:
    """$ that a request costs at least, delay ignored, float64 [N + 1, N + 1]; relaxed as the delay is."""
    substrate, profiles = scenario.substrate, scenario.profiles
    amounts = profiles.amount[profile, : profiles.chain_length[profile]]
    unit_cost = substrate.unit_cost_by_kind
    place = sum(vm_cost(unit_cost[:, :, kind], amounts[:, kind, None, None]) for kind in range(profiles.kinds))

    def hop(rate: float) -> tuple[np.ndarray, np.ndarray]:
        return (link_cost(substrate.link_unit_cost, rate),) * 2

    return _least(scenario, profile, hop, place)


def _capacities(substrate: Substrate) -> tuple[np.ndarray, np.ndarray]:
    """Capacity of each link from its smaller node to the greater and back, Mbit/s, float64 [L]."""
    back = substrate.back_capacity
    return substrate.link_capacity, substrate.link_capacity if back is None else back


def fitting(scenario: Scenario, profile: int) -> np.ndarray:
    """Which VMs can hold each function of ``profile`` when they are empty, bool [functions, N, V]."""
    profiles = scenario.profiles
    amounts = to_ledger(profiles.amount[profile, : profiles.chain_length[profile]])
    capacity = to_ledger(scenario.substrate.capacity_by_kind)
    return (capacity[None] >= amounts[:, None, None, :]).all(axis=3) & (capacity[..., 0] > 0)


def _least(
    scenario: Scenario, profile: int, hop: Callable[[float], tuple[np.ndarray, np.ndarray]], place: np.ndarray
) -> np.ndarray:
    """Least sum over a walk, [ingress, egress].

    Args:
        hop: of a rate, what a hop over each link takes, there and back, float64 [L] each.
        place: what each function takes on each VM, float64 [functions, N, V].
    """
    substrate, rates = scenario.substrate, scenario.profiles.rate[profile]
    nodes, functions = substrate.num_nodes, len(place)
    best_place = np.where(fitting(scenario, profile), place, np.inf).min(axis=2)  # [functions, N]
    at_egress = np.zeros(functions + 1)[:, None] + np.zeros(nodes)
    at_egress[:-1] = np.cumsum(best_place[::-1], axis=0)[::-1]  # the functions from i on, all at the egress
    if scenario.placement == "distinct":
        at_egress[:-1] = np.inf  # the last of them comes there by a hop
    before = np.full((nodes + 1, nodes), np.inf)  # with i functions placed, being anywhere; from each ingress, or none
    before[:nodes][np.eye(nodes, dtype=bool)] = 0.0
    best = np.full((nodes + 1, nodes), np.inf)
    for i in range(functions + 1):
        if i == 0 or rates[i] != rates[i - 1]:
            direct = _direct(substrate, rates[i], hop(rates[i]))
            route = _shortest(direct)
            hopping = _min_plus(direct, route)
        best = np.minimum(best, _min_plus(before, route) + at_egress[i])
        if i < functions:
            # Without colocation every function not on the egress comes with a hop of its own, be it there and back.
            stays = scenario.colocation or (scenario.placement == "distinct" and i == 0)
            before = _min_plus(before, route if stays else hopping) + best_place[i]
            if i == 0:
                before[nodes] = best_place[0]
    return np.concatenate([best, before.min(axis=1)[:, None]], axis=1)


def _direct(substrate: Substrate, rate: float, weights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """What a hop between neighbours takes, float64 [N, N], inf where no link can carry ``rate``."""
    direct = np.full((substrate.num_nodes,) * 2, np.inf)
    u, v = substrate.links.T
    capacities = _capacities(substrate)
    for tail, head, capacity, weight in ((u, v, capacities[0], weights[0]), (v, u, capacities[1], weights[1])):
        usable = to_ledger(capacity) >= to_ledger(rate)
        direct[tail[usable], head[usable]] = weight[usable]
    return direct


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
