"""Workloads: every request of a horizon, sampled from a scenario's stream or read from a CSV file."""

from __future__ import annotations

import csv
import io
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_text, write_atomically

if TYPE_CHECKING:
    from nfv_torchrl.scenario.scenario import Scenario
    from nfv_torchrl.scenario.services import ServiceCatalogue
    from nfv_torchrl.scenario.substrate import Substrate

HEADER = ("slot", "service", "ingress", "egress", "lifetime")
LONGEST_STAY = 2**40
"""Slots after which any request leaves; more than any horizon, little enough to add without overflow."""


@dataclass(frozen=True, eq=False)
class Workload:
    """R requests in order of arrival. What a policy does never changes them.

    Attributes:
        slot: arrival slot, int64 [R], never decreasing.
        service: index of the service type in the catalogue, int64 [R].
        ingress: node, int64 [R].
        egress: node other than the ingress, int64 [R].
        lifetime: s, float64 [R], positive.
    """

    slot: np.ndarray
    service: np.ndarray
    ingress: np.ndarray
    egress: np.ndarray
    lifetime: np.ndarray

    def __len__(self) -> int:
        return len(self.slot)

    @property
    def departure(self) -> np.ndarray:
        """Slot in whose beginning each request leaves if accepted, int64 [R]: at least one after its arrival."""
        stay = np.clip(np.ceil(self.lifetime), 1, LONGEST_STAY).astype(np.int64)
        return self.slot + stay

    @classmethod
    def sample(cls, scenario: Scenario, rng: np.random.Generator) -> Workload:
        """Draw the requests of one horizon; may be empty when few are expected.

        Each slot brings an integer number of requests, uniform in {0, .., 2 * arrival_rate}; types follow the mix,
        lifetimes are exponential. Counts, types, endpoints and lifetimes come from generators of their own, so a
        longer horizon continues the same arrivals and another mean lifetime only stretches the same lifetimes.
        """
        counts_rng, service_rng, endpoint_rng, lifetime_rng = _split(rng, 4)
        counts = counts_rng.integers(0, round(2 * scenario.arrival_rate), size=scenario.horizon, endpoint=True)
        slot = np.repeat(np.arange(scenario.horizon, dtype=np.int64), counts)
        cumulative = np.cumsum([service.weight for service in scenario.catalogue.types])
        service = np.searchsorted(cumulative / cumulative[-1], service_rng.random(len(slot)), side="right")
        ingress, egress = _draw_endpoints(scenario, service, endpoint_rng)
        lifetime = scenario.mean_lifetime * lifetime_rng.standard_exponential(len(slot))
        # An exponential may round to 0, which is no lifetime.
        lifetime = np.maximum(lifetime, np.finfo(np.float64).tiny)
        return cls(slot, service.astype(np.int64), ingress, egress, lifetime)

    def to_csv(self, path: str | os.PathLike[str], catalogue: ServiceCatalogue) -> None:
        """Write ``slot,service,ingress,egress,lifetime``; services by name, lifetimes (s) with all their digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(HEADER)
        names = [catalogue.names[service] for service in self.service]
        columns = (self.slot.tolist(), names, self.ingress.tolist(), self.egress.tolist(), self.lifetime.tolist())
        writer.writerows(zip(*columns, strict=True))
        write_atomically(path, text.getvalue())

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        catalogue: ServiceCatalogue,
        substrate: Substrate,
        horizon: int,
        *,
        allow_empty: bool = False,
    ) -> Workload:
        """Read what :meth:`to_csv` wrote, or anyone's file of that form.

        Raises:
            ScenarioError: a line does not fit the form, the services, the nodes or the horizon; the message names file,
                line and remedy. A file without requests is refused unless ``allow_empty``.
        """
        reader = csv.reader(io.StringIO(read_text(path), newline=""))
        services = {name: index for index, name in enumerate(catalogue.names)}
        rows: list[tuple[int, int, int, int, float]] = []
        try:
            if tuple(name.strip() for name in next(reader, ())) != HEADER:
                raise ScenarioError(f"{path}, line 1: the header must be {','.join(HEADER)}; add or correct it")
            for row in reader:
                if row:
                    where = f"{path}, line {reader.line_num}"
                    rows.append(_parse_row(row, where, services, substrate.num_nodes, horizon))
                    if len(rows) > 1 and rows[-1][0] < rows[-2][0]:
                        raise ScenarioError(f"{where}: slot {rows[-1][0]} follows {rows[-2][0]}; sort lines by slot")
        except csv.Error as error:
            raise ScenarioError(f"{path}, line {reader.line_num}: is not CSV ({error}); correct that line") from error
        if not rows and not allow_empty:
            raise ScenarioError(f"{path}: holds no requests; add at least one line below the header")
        slot, service, ingress, egress = np.array([row[:4] for row in rows], np.int64).reshape(-1, 4).T.copy()
        return cls(slot, service, ingress, egress, np.array([row[4] for row in rows], np.float64))


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


def _parse_row(
    row: list[str], where: str, services: dict[str, int], nodes: int, horizon: int
) -> tuple[int, int, int, int, float]:
    """Slot, service index, ingress, egress and lifetime of one line of a file."""
    if len(row) != len(HEADER):
        raise ScenarioError(f"{where}: has {len(row)} fields; {','.join(HEADER)} are needed")
    slot = _integer(row[0], f"{where}: slot")
    if not 0 <= slot < horizon:
        raise ScenarioError(f"{where}: slot {slot} is outside 0 .. {horizon - 1}; correct it or change the horizon")
    name = row[1].strip()
    if name not in services:
        raise ScenarioError(f"{where}: unknown service {name!r}; define it under services or use one of {[*services]}")
    ingress, egress = (_integer(row[place], f"{where}: {HEADER[place]}") for place in (2, 3))
    for node in (ingress, egress):
        if not 0 <= node < nodes:
            raise ScenarioError(f"{where}: unknown node {node}; the substrate's nodes are 0 .. {nodes - 1}")
    if ingress == egress:
        raise ScenarioError(f"{where}: ingress and egress are both {ingress}; they must differ")
    try:
        lifetime = float(row[4])
    except ValueError:
        lifetime = math.nan
    if not (math.isfinite(lifetime) and lifetime > 0):
        raise ScenarioError(f"{where}: lifetime {row[4]!r}; use a positive number of seconds")
    return slot, services[name], ingress, egress, lifetime


def _integer(text: str, where: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ScenarioError(f"{where} is {text!r}; use an integer") from None
