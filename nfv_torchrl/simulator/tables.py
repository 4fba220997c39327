"""What never changes while the simulator runs: substrates and services as padded arrays for the compiled kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.profiles import Profiles
from nfv_torchrl.scenario.services import ServiceCatalogue
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import LEDGER_UNITS, to_ledger
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import link_delay

DELAY_TOLERANCE = 1e-9
"""ms by which a sum of delays may exceed the budget: the order of adding changes less, a real delay more."""


@by_reference
class Rules(NamedTuple):
    """The rules of one step that a scenario may choose (section "Action Space" and Algorithm 3 of the paper).

    ``colocation``: a function may also go to a VM of the current node. ``feasible_mask``: the mask leaves out what a
    step check would refuse. ``admission_control``: ``reject`` is always valid. ``max_steps``: J, steps a walk may take.
    ``distinct``: no two functions of a request on one node; a function may then also go to a VM of the current node,
    and the egress may be passed through. ``free_ends``: some requests leave their ingress or egress open.
    ``shared_steps``: the requests of a service share J in each slot; else every request has J steps of its own.
    ``switches``: once all functions are placed, an action that places counts as one that forwards (Algorithm 3, the
    branch after i_f < F_k). ``open_pairs``: the service that is observed does not tell both ends of every request.
    """

    colocation: bool
    feasible_mask: bool
    admission_control: bool
    max_steps: int
    distinct: bool = False
    free_ends: bool = False
    shared_steps: bool = False
    switches: bool = False
    open_pairs: bool = False


@by_reference
class Tables(NamedTuple):
    """Read-only arrays of S substrates padded to N nodes, V VMs a node, L links, D neighbours, and of P profiles.

    R kinds of resources, chains of at most F functions. Amounts are int64 in ledger units (bit/s, cycles/s), delays in
    ms, unit costs in $ per Mcycles/s or Mbit/s. With full duplex L counts directions: link l of a substrate is 2 l from
    its smaller node to the greater and 2 l + 1 back. Profile p < ``services`` is service type p.
    """

    num_nodes: np.ndarray  # int64 [S]
    num_links: np.ndarray  # int64 [S]
    full_duplex: bool
    vm_count: np.ndarray  # int64 [S, N]
    vm_capacity: np.ndarray  # int64 [S, N, V, R]
    vm_speed: np.ndarray  # float64 [S, N, V], capacity of the first kind, 1 where there is no VM
    vm_unit_cost: np.ndarray  # float64 [S, N, V, R]
    degree: np.ndarray  # int64 [S, N]
    neighbour: np.ndarray  # int32 [S, N, D], ascending
    neighbour_link: np.ndarray  # int32 [S, N, D], the link that leads there
    link_ends: np.ndarray  # int32 [S, L, 2]
    link_capacity: np.ndarray  # int64 [S, L]
    link_speed: np.ndarray  # float64 [S, L], the same in Mbit/s, 1 where there is no link
    link_delay: np.ndarray  # float64 [S, L], ms, propagation
    link_unit_cost: np.ndarray  # float64 [S, L]
    services: int  # K
    service: np.ndarray  # int64 [P], type that a profile counts as
    chain_length: np.ndarray  # int64 [P]
    load_units: np.ndarray  # int64 [P, F, R]
    load: np.ndarray  # float64 [P, F, R]
    work: np.ndarray  # float64 [P, F], Mcycles/s that a function's processing delay follows from
    fixed_delay: np.ndarray  # float64 [P, F], ms beside it
    rate_units: np.ndarray  # int64 [P, F + 1], of each segment
    rate: np.ndarray  # float64 [P, F + 1], Mbit/s
    tolerable_delay: np.ndarray  # float64 [P], ms, infinite where any will do
    least_rate: np.ndarray  # int64 [P], row of ``delay_to``
    delay_to: np.ndarray  # float64 [S, G, N, N], ms: least sum of hop delays at a profile's least rate, empty network
    link_cost_to: np.ndarray  # float64 [S, N, N], $ per Mbit/s: least sum of link unit costs
    vm_total: np.ndarray  # int64 [S, R], all VM capacity
    link_total: np.ndarray  # int64 [S], all link capacity
    largest_amount: np.ndarray  # float64 [R], what any function takes at most of each kind, at least a ledger unit
    largest_rate: float  # Mbit/s, of any segment


def build_tables(substrates: Sequence[Substrate], requests: ServiceCatalogue | Profiles) -> Tables:
    """Stack ``substrates`` (padded to the largest) and what requests may ask for into arrays.

    Args:
        substrates: networks, all of them full duplex or none.
        requests: a catalogue, or profiles of which those of services come first.

    Raises:
        ScenarioError: no substrate was given, or some are full duplex and others not.
    """
    if not substrates:
        raise ScenarioError("a simulator needs at least one substrate; none was given")
    full_duplex = substrates[0].full_duplex
    if any(substrate.full_duplex != full_duplex for substrate in substrates):
        raise ScenarioError("substrates of one simulator are all full duplex or none; set substrate.duplex")
    profiles = requests.profiles if isinstance(requests, ServiceCatalogue) else requests
    least_rates, least_rate = _least_rates(profiles)
    count, kinds = len(substrates), profiles.kinds
    nodes = max(s.num_nodes for s in substrates)
    vms = max(s.vm_capacity.shape[1] for s in substrates)
    links = max(s.num_links for s in substrates) * (2 if full_duplex else 1)
    degrees = max(int(np.bincount(s.links.ravel(), minlength=s.num_nodes).max()) for s in substrates)
    tables = Tables(
        num_nodes=np.array([s.num_nodes for s in substrates]),
        num_links=np.array([s.num_links * (2 if full_duplex else 1) for s in substrates]),
        full_duplex=full_duplex,
        vm_count=np.zeros((count, nodes), np.int64),
        vm_capacity=np.zeros((count, nodes, vms, kinds), np.int64),
        vm_speed=np.ones((count, nodes, vms)),
        vm_unit_cost=np.zeros((count, nodes, vms, kinds)),
        degree=np.zeros((count, nodes), np.int64),
        neighbour=np.zeros((count, nodes, degrees), np.int32),
        neighbour_link=np.zeros((count, nodes, degrees), np.int32),
        link_ends=np.zeros((count, links, 2), np.int32),
        link_capacity=np.zeros((count, links), np.int64),
        link_speed=np.ones((count, links)),
        link_delay=np.zeros((count, links)),
        link_unit_cost=np.zeros((count, links)),
        services=int(profiles.service.max()) + 1,
        service=profiles.service.copy(),
        chain_length=profiles.chain_length.copy(),
        load_units=to_ledger(profiles.amount),
        load=np.array(profiles.amount),
        work=np.array(profiles.work),
        fixed_delay=np.array(profiles.fixed_delay),
        rate_units=to_ledger(profiles.rate),
        rate=np.array(profiles.rate),
        tolerable_delay=np.array(profiles.tolerable_delay),
        least_rate=least_rate,
        delay_to=np.full((count, len(least_rates), nodes, nodes), np.inf),
        link_cost_to=np.full((count, nodes, nodes), np.inf),
        vm_total=np.zeros((count, kinds), np.int64),
        link_total=np.zeros(count, np.int64),
        largest_amount=np.maximum(profiles.amount.max(axis=(0, 1)), 1 / LEDGER_UNITS),
        largest_rate=max(float(profiles.rate.max()), 1 / LEDGER_UNITS),
    )
    for row, substrate in enumerate(substrates):
        _fill_row(tables, row, substrate, least_rates)
    return tables


def _least_rates(profiles: Profiles) -> tuple[np.ndarray, np.ndarray]:
    """Different least rates, float64 [G], of profiles with a delay limit; and the row of each profile, int64 [P]."""
    segments = np.arange(profiles.rate.shape[1]) <= profiles.chain_length[:, None]
    least = np.where(segments, profiles.rate, np.inf).min(axis=1)
    limited = np.isfinite(profiles.tolerable_delay)
    rates = np.unique(least[limited]) if limited.any() else np.zeros(1)
    return rates, np.where(limited, np.searchsorted(rates, np.where(limited, least, rates[0])), 0)


def _fill_row(tables: Tables, row: int, substrate: Substrate, least_rates: np.ndarray) -> None:
    n = substrate.num_nodes
    vms = substrate.vm_capacity.shape[1]
    tables.vm_count[row, :n] = substrate.vm_count
    tables.vm_capacity[row, :n, :vms] = to_ledger(substrate.capacity_by_kind)
    exists = substrate.vm_capacity > 0
    tables.vm_speed[row, :n, :vms][exists] = substrate.vm_capacity[exists]
    tables.vm_unit_cost[row, :n, :vms] = substrate.unit_cost_by_kind
    _fill_links(tables, row, substrate)
    tables.vm_total[row] = tables.vm_capacity[row].sum(axis=(0, 1))
    tables.link_total[row] = tables.link_capacity[row].sum()
    _fill_neighbours(tables, row, substrate)
    links = slice(0, tables.num_links[row])
    arcs = _arcs(tables, row)
    for place, rate in enumerate(least_rates):
        hop = link_delay(tables.link_delay[row, links], rate, tables.link_speed[row, links])
        tables.delay_to[row, place, :n, :n] = _shortest(n, arcs, hop)
    tables.link_cost_to[row, :n, :n] = _shortest(n, arcs, tables.link_unit_cost[row, links])


def _fill_links(tables: Tables, row: int, substrate: Substrate) -> None:
    """Links as they are, or both directions of each, one after the other."""
    if substrate.back_capacity is None:
        ends, capacity, times = substrate.links, substrate.link_capacity, 1
    else:
        ends = np.stack([substrate.links, substrate.links[:, ::-1]], axis=1).reshape(-1, 2)
        capacity, times = np.stack([substrate.link_capacity, substrate.back_capacity], axis=1).ravel(), 2
    links = len(capacity)
    tables.link_ends[row, :links] = ends
    tables.link_capacity[row, :links] = to_ledger(capacity)
    tables.link_speed[row, :links] = capacity
    tables.link_delay[row, :links] = np.repeat(substrate.link_delay, times)
    tables.link_unit_cost[row, :links] = np.repeat(substrate.link_unit_cost, times)


def _fill_neighbours(tables: Tables, row: int, substrate: Substrate) -> None:
    around: list[list[tuple[int, int]]] = [[] for _ in range(substrate.num_nodes)]
    for link, (u, v) in enumerate(substrate.links.tolist()):
        there, back = (2 * link, 2 * link + 1) if tables.full_duplex else (link, link)
        around[u].append((v, there))
        around[v].append((u, back))
    for node, pairs in enumerate(around):
        pairs.sort()
        tables.degree[row, node] = len(pairs)
        for place, (neighbour, link) in enumerate(pairs):
            tables.neighbour[row, node, place] = neighbour
            tables.neighbour_link[row, node, place] = link


def _arcs(tables: Tables, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tail, head and link of every direction that a link can be used in."""
    u, v = tables.link_ends[row, : tables.num_links[row]].T
    link = np.arange(len(u))
    # Both directions are stored so that csgraph need not symmetrise; weights are positive, so none reads as "no link".
    return (u, v, link) if tables.full_duplex else (np.r_[u, v], np.r_[v, u], np.r_[link, link])


def _shortest(nodes: int, arcs: tuple[np.ndarray, np.ndarray, np.ndarray], weights: np.ndarray) -> np.ndarray:
    """Least sums of ``weights`` float64 [L] between all pairs of nodes, float64 [N, N]."""
    tail, head, link = arcs
    return dijkstra(csr_array((weights[link], (tail, head)), shape=(nodes, nodes)), directed=True)
