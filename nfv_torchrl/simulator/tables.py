"""What never changes while the simulator runs: substrates and services as padded arrays for the compiled kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.services import ServiceCatalogue
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import to_ledger
from nfv_torchrl.simulator.steps import link_delay

DELAY_TOLERANCE = 1e-9
"""ms by which a sum of delays may exceed the budget: the order of adding changes less, a real delay more."""


class Rules(NamedTuple):
    """The rules of one step that a scenario may choose (section "Action Space" and Algorithm 3 of the paper).

    ``colocation``: a function may also go to a VM of the current node. ``feasible_mask``: the mask leaves out what a
    step check would refuse. ``admission_control``: ``reject`` is always valid. ``max_steps``: J, steps a walk may take.
    """

    colocation: bool
    feasible_mask: bool
    admission_control: bool
    max_steps: int


class Tables(NamedTuple):
    """Read-only arrays of S substrates padded to N nodes, V VMs a node, L links, D neighbours, and of K services.

    Amounts are int64 in ledger units (bit/s, cycles/s), delays in ms, unit costs in $ per Mcycles/s or Mbit/s.
    """

    num_nodes: np.ndarray  # int64 [S]
    num_links: np.ndarray  # int64 [S]
    vm_count: np.ndarray  # int64 [S, N]
    vm_capacity: np.ndarray  # int64 [S, N, V]
    vm_speed: np.ndarray  # float64 [S, N, V], Mcycles/s, 1 where there is no VM
    vm_unit_cost: np.ndarray  # float64 [S, N, V]
    degree: np.ndarray  # int64 [S, N]
    neighbour: np.ndarray  # int32 [S, N, D], ascending
    neighbour_link: np.ndarray  # int32 [S, N, D]
    link_ends: np.ndarray  # int32 [S, L, 2]
    link_capacity: np.ndarray  # int64 [S, L]
    link_unit_cost: np.ndarray  # float64 [S, L]
    chain_length: np.ndarray  # int64 [K]
    load_units: np.ndarray  # int64 [K, F]
    load: np.ndarray  # float64 [K, F], Mcycles/s
    rate_units: np.ndarray  # int64 [K]
    rate: np.ndarray  # float64 [K], Mbit/s
    tolerable_delay: np.ndarray  # float64 [K], ms
    hop_delay: np.ndarray  # float64 [S, K, L], ms: propagation + transmission
    delay_to: np.ndarray  # float64 [S, K, N, N], ms: least sum of hop delays, capacities ignored
    link_cost_to: np.ndarray  # float64 [S, N, N], $ per Mbit/s: least sum of link unit costs
    vm_total: np.ndarray  # int64 [S], all VM capacity
    link_total: np.ndarray  # int64 [S], all link capacity


def build_tables(substrates: Sequence[Substrate], catalogue: ServiceCatalogue) -> Tables:
    """Stack ``substrates`` (padded to the largest) and ``catalogue`` into arrays.

    Raises:
        ScenarioError: no substrate was given.
    """
    if not substrates:
        raise ScenarioError("a simulator needs at least one substrate; none was given")
    count = len(substrates)
    nodes = max(s.num_nodes for s in substrates)
    vms = max(s.vm_capacity.shape[1] for s in substrates)
    links = max(s.num_links for s in substrates)
    degrees = max(int(np.bincount(s.links.ravel(), minlength=s.num_nodes).max()) for s in substrates)
    services = len(catalogue.rate)
    tables = Tables(
        num_nodes=np.array([s.num_nodes for s in substrates]),
        num_links=np.array([s.num_links for s in substrates]),
        vm_count=np.zeros((count, nodes), np.int64),
        vm_capacity=np.zeros((count, nodes, vms), np.int64),
        vm_speed=np.ones((count, nodes, vms)),
        vm_unit_cost=np.zeros((count, nodes, vms)),
        degree=np.zeros((count, nodes), np.int64),
        neighbour=np.zeros((count, nodes, degrees), np.int32),
        neighbour_link=np.zeros((count, nodes, degrees), np.int32),
        link_ends=np.zeros((count, links, 2), np.int32),
        link_capacity=np.zeros((count, links), np.int64),
        link_unit_cost=np.zeros((count, links)),
        chain_length=catalogue.chain_length.astype(np.int64),
        load_units=to_ledger(catalogue.load),
        load=np.ascontiguousarray(catalogue.load),
        rate_units=to_ledger(catalogue.rate),
        rate=np.ascontiguousarray(catalogue.rate),
        tolerable_delay=np.ascontiguousarray(catalogue.tolerable_delay),
        hop_delay=np.zeros((count, services, links)),
        delay_to=np.full((count, services, nodes, nodes), np.inf),
        link_cost_to=np.full((count, nodes, nodes), np.inf),
        vm_total=np.zeros(count, np.int64),
        link_total=np.zeros(count, np.int64),
    )
    for row, substrate in enumerate(substrates):
        _fill_row(tables, row, substrate)
    return tables


def _fill_row(tables: Tables, row: int, substrate: Substrate) -> None:
    n, links = substrate.num_nodes, substrate.num_links
    vms = substrate.vm_capacity.shape[1]
    tables.vm_count[row, :n] = substrate.vm_count
    tables.vm_capacity[row, :n, :vms] = to_ledger(substrate.vm_capacity)
    exists = substrate.vm_capacity > 0
    tables.vm_speed[row, :n, :vms][exists] = substrate.vm_capacity[exists]
    tables.vm_unit_cost[row, :n, :vms] = substrate.vm_unit_cost
    tables.link_ends[row, :links] = substrate.links
    tables.link_capacity[row, :links] = to_ledger(substrate.link_capacity)
    tables.link_unit_cost[row, :links] = substrate.link_unit_cost
    tables.vm_total[row] = tables.vm_capacity[row].sum()
    tables.link_total[row] = tables.link_capacity[row].sum()
    _fill_neighbours(tables, row, substrate)
    for service, rate in enumerate(tables.rate):
        hop = link_delay(substrate.link_delay, rate, substrate.link_capacity)
        tables.hop_delay[row, service, :links] = hop
        tables.delay_to[row, service, :n, :n] = _shortest(substrate, hop)
    tables.link_cost_to[row, :n, :n] = _shortest(substrate, substrate.link_unit_cost)


def _fill_neighbours(tables: Tables, row: int, substrate: Substrate) -> None:
    around: list[list[tuple[int, int]]] = [[] for _ in range(substrate.num_nodes)]
    for link, (u, v) in enumerate(substrate.links.tolist()):
        around[u].append((v, link))
        around[v].append((u, link))
    for node, pairs in enumerate(around):
        pairs.sort()
        tables.degree[row, node] = len(pairs)
        for place, (neighbour, link) in enumerate(pairs):
            tables.neighbour[row, node, place] = neighbour
            tables.neighbour_link[row, node, place] = link


def _shortest(substrate: Substrate, weights: np.ndarray) -> np.ndarray:
    """Least sums of ``weights`` float64 [L] between all pairs of nodes, float64 [N, N]."""
    u, v = substrate.links.T
    n = substrate.num_nodes
    # Both directions are stored so that csgraph need not symmetrise; weights are positive, so none reads as "no link".
    graph = csr_array((np.r_[weights, weights], (np.r_[u, v], np.r_[v, u])), shape=(n, n))
    return dijkstra(graph, directed=True)
