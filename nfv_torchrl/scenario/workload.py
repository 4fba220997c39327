"""Workloads: every request of a horizon, sampled from a scenario's stream or read from a file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.arrivals import draw_counts
from nfv_torchrl.scenario.formats.virne_laws import ChainLaws
from nfv_torchrl.scenario.profiles import Profiles
from nfv_torchrl.scenario.request_file import Columns, read_columns, write_columns
from nfv_torchrl.scenario.request_sets import chain_columns, is_request_set, read_request_set
from nfv_torchrl.scenario.services import ANY, FREE, ServiceCatalogue
from nfv_torchrl.scenario.streams import Stream, generator

if TYPE_CHECKING:
    from nfv_torchrl.scenario.scenario import Scenario
    from nfv_torchrl.scenario.substrate import Substrate

LONGEST_STAY = 2**40
"""Slots after which any request leaves; more than any horizon, little enough to add without overflow."""


@dataclass(frozen=True, eq=False)
class Workload:
    """R requests in order of arrival. What a policy does never changes them.

    Attributes:
        slot: arrival slot, int64 [R], never decreasing.
        service: index of the service type in the catalogue, int64 [R].
        ingress: node, int64 [R]; -1: free, the first function may stand on any node.
        egress: node, int64 [R]; -1: free, the walk ends with the last function.
        lifetime: s, float64 [R], positive.
        profile: what each asks for, int64 [R]: below K that of a service, from K on one of ``own``; by default the
            service's.
        own: profiles that requests of a file bring, or None.
        time: s, when each arrives within its slot, float64 [R], never decreasing; None: as its slot begins.
    """

    slot: np.ndarray
    service: np.ndarray
    ingress: np.ndarray
    egress: np.ndarray
    lifetime: np.ndarray
    profile: np.ndarray = None  # type: ignore[assignment]
    own: Profiles | None = None
    time: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.profile is None:
            object.__setattr__(self, "profile", self.service)
        for name in (*Columns._fields[:5], "profile", *(() if self.time is None else ("time",))):
            kind = np.float64 if name in ("lifetime", "time") else np.int64
            column = np.asarray(getattr(self, name))
            if column.shape != (len(self.slot),) or (len(column) and not np.can_cast(column.dtype, kind, "same_kind")):
                raise ScenarioError(f"workload: {name} is {column.dtype} {list(column.shape)}; use {kind.__name__} [R]")
            object.__setattr__(self, name, column.astype(kind, copy=False))
        if not len(self):
            return
        if self.slot[0] < 0 or np.any(np.diff(self.slot) < 0):
            raise ScenarioError("workload: slots must be 0 or more and never decrease; sort the requests by slot")
        if min(self.service.min(), self.profile.min()) < 0 or min(self.ingress.min(), self.egress.min()) < FREE:
            raise ScenarioError("workload: service, ingress and egress are indices from 0; a free end is -1")
        if not (self.lifetime.min() > 0 and np.isfinite(self.lifetime.max())):
            raise ScenarioError("workload: a lifetime is not a positive, finite number of seconds; correct it")
        if self.time is not None and (np.any(np.floor(self.time) != self.slot) or np.any(np.diff(self.time) < 0)):
            raise ScenarioError(
                "workload: times must be within their slots and never decrease; sort the requests by time"
            )

    @property
    def free_ends(self) -> bool:
        """Whether the ingress or egress of some request is free."""
        return bool((self.ingress == FREE).any() or (self.egress == FREE).any())

    def check_profiles(self, profiles: Profiles) -> None:
        """Refuse requests whose profile is not among ``profiles``, or that leave nothing to decide.

        Raises:
            ScenarioError: as said.
        """
        if not len(self):
            return
        if self.profile.max() >= len(profiles) or not np.array_equal(profiles.service[self.profile], self.service):
            raise ScenarioError("workload: a profile is not one of this scenario's, or is of another service")
        routed = profiles.chain_length[self.profile] == 0
        if np.any(routed & ((self.ingress == self.egress) | (self.ingress == FREE) | (self.egress == FREE))):
            raise ScenarioError(
                "workload: a request without functions has no two different end nodes, so it asks for nothing"
            )

    def check_fits(self, services: int, nodes: int, horizon: int) -> None:
        """Refuse requests that a world of these sizes does not know.

        Raises:
            ScenarioError: a service, node or slot is out of its range.
        """
        if not len(self):
            return
        nodes_named = max(self.ingress.max(), self.egress.max()) + 1
        for what, found, there in (
            ("service", self.service.max() + 1, services),
            ("node", nodes_named, nodes),
            ("slot", self.slot[-1] + 1, horizon),
        ):
            if found > there:
                raise ScenarioError(
                    f"workload: {what} {found - 1} is outside 0 .. {there - 1}; give a workload made for this scenario"
                )

    def __len__(self) -> int:
        return len(self.slot)

    @property
    def departure(self) -> np.ndarray:
        """Slot in whose beginning each request has left if accepted, int64 [R]: at least one after its arrival."""
        if self.time is None:
            return self.slot + np.clip(np.ceil(self.lifetime), 1, LONGEST_STAY).astype(np.int64)
        return np.maximum(np.ceil(np.minimum(self.leaves, LONGEST_STAY)).astype(np.int64), self.slot + 1)

    @property
    def leaves(self) -> np.ndarray:
        """When each request leaves, s, float64 [R]: before all that arrive then or later in that slot."""
        if self.time is None:
            return self.departure.astype(np.float64)
        return np.maximum(self.time + self.lifetime, np.nextafter(self.time, np.inf))  # never as soon as it comes

    @property
    def uncounted(self) -> np.ndarray:
        """First slot after whose last arrival each request has left, int64 [R]; where times are given, it may come
        before ``departure``, and be the slot of the arrival itself."""
        if self.time is None or not len(self):
            return self.departure
        slots, last = np.unique(self.slot[::-1], return_index=True)
        latest = self.time[::-1][last]  # time of the last arrival in each of these slots
        during = np.floor(np.minimum(self.leaves, LONGEST_STAY)).astype(np.int64)
        place = np.minimum(np.searchsorted(slots, during), len(slots) - 1)
        gone = (slots[place] == during) & (latest[place] >= self.leaves)
        return np.where(gone, during, self.departure)

    @classmethod
    def sample(cls, scenario: Scenario, rng: np.random.Generator) -> Workload:
        """Draw the requests of one horizon; may be empty when few are expected.

        Each slot brings a number of requests that the scenario's ``arrivals`` draw; types follow the mix, lifetimes
        are exponential. Counts, types, endpoints and lifetimes come from generators of their own, so a
        longer horizon continues the same arrivals and another mean lifetime only stretches the same lifetimes.
        """
        counts_rng, service_rng, endpoint_rng, lifetime_rng = _split(rng, 4)
        counts = draw_counts(scenario, counts_rng)
        slot = np.repeat(np.arange(scenario.horizon, dtype=np.int64), counts)
        cumulative = np.cumsum([service.weight for service in scenario.catalogue.types])
        service = np.searchsorted(cumulative / cumulative[-1], service_rng.random(len(slot)), side="right")
        if scenario.arrivals.process == "matrix":
            ingress, egress = scenario.traffic.draw_ends(slot, endpoint_rng)
        else:
            ingress, egress = _draw_endpoints(scenario, service, endpoint_rng)
        for kind, each in enumerate(scenario.catalogue.types):
            for end, nodes in ((each.ingress, ingress), (each.egress, egress)):
                if end == ANY:
                    nodes[service == kind] = FREE
        lifetime = scenario.mean_lifetimes[service] * lifetime_rng.standard_exponential(len(slot))
        # An exponential may round to 0, which is no lifetime.
        lifetime = np.maximum(lifetime, np.finfo(np.float64).tiny)
        service = service.astype(np.int64)
        profile = _draw_profiles(scenario.catalogue, service, rng)
        return cls(slot, service, ingress, egress, lifetime, profile, scenario.catalogue.drawn)

    def to_csv(self, path: str | os.PathLike[str], catalogue: ServiceCatalogue) -> None:
        """Write ``slot,service,ingress_index,egress_index,lifetime``; lifetimes (s) with all their digits. ``demand``
        and ``time`` follow where requests bring them.

        Indices are the substrate's, 0 .. N-1; the header says so, because in other files a number is a node's id.
        """
        write_columns(path, Columns(*(getattr(self, name) for name in Columns._fields)), catalogue)

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        catalogue: ServiceCatalogue,
        substrate: Substrate,
        horizon: int | None,
        *,
        allow_empty: bool = False,
        numbers_are_indices: bool = False,
    ) -> Workload:
        """Read what ``to_csv`` wrote, or ``slot,service,ingress,egress,lifetime`` with nodes by id or label.

        See ``nfv_torchrl.scenario.request_file.read_columns`` for the arguments.

        Raises:
            ScenarioError: a line does not fit the form, the services, the nodes or the horizon; the message names file,
                line and remedy. A file without requests is refused unless ``allow_empty``.
        """
        columns = read_columns(
            path, catalogue, substrate, horizon, allow_empty=allow_empty, numbers_are_indices=numbers_are_indices
        )
        return cls(*_as_drawn(columns, catalogue))

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        catalogue: ServiceCatalogue,
        substrate: Substrate,
        horizon: int | None,
        seed: int,
    ) -> Workload:
        """Read a CSV file, a folder or settings of Virne's, or ``requests.json`` of CN-UPB/NFVdeep (``docs/data.md``).

        Args:
            path: file or folder.
            catalogue: whose services and kinds of resources are asked for.
            substrate: whose nodes a CSV file names.
            horizon: arrivals are below it; None: as long as the requests.
            seed: scenario seed, for a file that holds the laws of its requests.

        Raises:
            ScenarioError: it cannot be used; the message names the line or request, and the remedy.
        """
        if not is_request_set(Path(path)):
            return cls.from_csv(path, catalogue, substrate, horizon)
        return cls(*read_request_set(Path(path), catalogue, horizon, seed))


def _draw_profiles(catalogue: ServiceCatalogue, service: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The profile of each request, int64 [R]: its service, or one of those that its service draws from."""
    if catalogue.drawn is None:
        return service
    rate_rng, delay_rng = _split(rng, 2)
    rate_at, delay_at = rate_rng.random(len(service)), delay_rng.random(len(service))
    profile = service.copy()
    for kind, each in enumerate(catalogue.types):
        if each.is_drawn:
            mine = service == kind
            rates, delays = (len(values) for values in each.drawn_values)
            place = (rate_at[mine] * rates).astype(np.int64) * delays + (delay_at[mine] * delays).astype(np.int64)
            profile[mine] = len(catalogue.types) + catalogue.drawn_first[kind] + place
    return profile


def _as_drawn(columns: Columns, catalogue: ServiceCatalogue) -> Columns:
    """The same requests with the profiles that services draw from, where all demands of a file are among these."""
    if columns.own is None or catalogue.drawn is None:
        return columns
    place = {_key(catalogue.drawn, row): row for row in range(len(catalogue.drawn))}
    found = [place.get(_key(columns.own, row)) for row in range(len(columns.own))]
    if None in found:
        return columns
    first = len(catalogue.types)
    moved = np.r_[np.arange(first), first + np.array(found, np.int64)]
    return columns._replace(profile=moved[columns.profile], own=catalogue.drawn)


def _key(profiles: Profiles, row: int) -> tuple[object, ...]:
    """All that a profile asks for."""
    functions = int(profiles.chain_length[row])
    of_functions = (profiles.amount, profiles.work, profiles.fixed_delay)
    return (
        int(profiles.service[row]),
        *(values[row, :functions].tobytes() for values in of_functions),
        profiles.rate[row, : functions + 1].tobytes(),
        float(profiles.tolerable_delay[row]),
    )


def draw_chains(seed: int, catalogue: ServiceCatalogue, laws: ChainLaws | None = None) -> Workload:
    """Requests drawn as Virne draws its chains: a profile each, both ends free.

    ``Workload.to_csv`` writes them for ``scenario.workload.path``.

    Args:
        seed: scenario seed; the same requests as a file of these laws gives with it.
        catalogue: has one service, that of all requests, and the kinds of resources of ``laws``.
        laws: Virne's published ones by default.

    Raises:
        ScenarioError: a catalogue of other services or kinds.
    """
    if len(catalogue.types) != 1:
        raise ScenarioError(f"draw_chains: {len(catalogue.types)} services; chains are of one, give such a catalogue")
    return Workload(*chain_columns(laws or ChainLaws(), catalogue, generator(seed, Stream.REQUESTS)))


def _split(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    """Generators seeded by draws of ``rng``: unlike spawning, this leaves its whole state in its bit generator."""
    return [np.random.default_rng(int(seed)) for seed in rng.integers(2**63, size=count)]


def _draw_endpoints(scenario: Scenario, service: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Ingress and egress int64 [R]: one of the service's pairs, or any two different nodes."""
    if scenario.endpoint_pairs is not None:
        choice = rng.integers(scenario.endpoint_pairs.shape[1], size=len(service))
        ingress, egress = scenario.endpoint_pairs[service, choice].T
        return ingress.copy(), egress.copy()
    return decode_pairs(rng.integers(count_pairs(scenario.substrate.num_nodes), size=len(service)), scenario.substrate)


def count_pairs(nodes: int) -> int:
    """Ordered pairs of different nodes."""
    return nodes * (nodes - 1)


def decode_pairs(code: np.ndarray, substrate: Substrate) -> tuple[np.ndarray, np.ndarray]:
    """Ingress and egress of pair number ``code``, 0 .. N (N - 1) - 1, as int64 of the same shape."""
    ingress, egress = np.divmod(code, substrate.num_nodes - 1)
    return ingress, egress + (egress >= ingress)
