"""Services: which VNFs a request's chain needs, at what rate and within what delay."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.names import check_name
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY
from nfv_torchrl.settings.values import parse

PAPER_VNFS: dict[str, float] = {"NAT": 0.092, "FW": 0.09, "TM": 1.33, "VOC": 0.54, "IDPS": 1.07}
"""Processing requirement d of each VNF in cycles/bit: 100 times the per-user CPU shares of Savi et al., the source of
the paper's service table."""

LARGEST = 1e30
"""Bound of delays and weights: beyond it sums and 32-bit numbers of observations overflow."""
MOST_SERVICES = 1000
NOT_IN_TAGS = re.compile(r"[^-/\w.]")
"""Characters that TensorBoard's writer replaces by ``_``."""


@dataclass(frozen=True)
class ServiceType:
    """One type of service.

    Attributes:
        name: what files and tables call it.
        chain: VNF names in the order in which traffic passes them; at least one, repeats allowed.
        rate: data rate B, Mbit/s.
        tolerable_delay: tau, ms.
        weight: share of the mix, relative to the other types; 0 never arrives.

    Raises:
        ScenarioError: a value is out of range.
    """

    name: str
    chain: tuple[str, ...]
    rate: float
    tolerable_delay: float
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_name(self.name, "services")
        where = f"services.{self.name}"
        if isinstance(self.chain, str):
            raise ScenarioError(f"{where}.chain: {self.chain!r} is text; give a list of VNF names")
        object.__setattr__(self, "chain", tuple(self.chain))
        if not self.chain:
            raise ScenarioError(f"{where}.chain: is empty; name at least one VNF")
        for vnf in self.chain:
            check_name(vnf, f"{where}.chain")
        for key in ("rate", "tolerable_delay", "weight"):
            parse(getattr(self, key), float, f"{where}.{key}")
        if not 1 / LEDGER_UNITS <= self.rate <= MAX_CAPACITY:
            raise ScenarioError(f"{where}.rate: {self.rate} Mbit/s; use a number from 1e-6 to 1e9")
        if not 0 < self.tolerable_delay <= LARGEST:
            raise ScenarioError(f"{where}.tolerable_delay: {self.tolerable_delay} ms; use a positive number up to 1e30")
        if not (self.weight == 0 or 1 / LARGEST <= self.weight <= LARGEST):
            raise ScenarioError(f"{where}.weight: {self.weight}; use 0 or a positive number from 1e-30 to 1e30")


@dataclass(frozen=True)
class ServiceCatalogue:
    """All service types of a scenario and the VNFs they are made of. Arrays below have K types and F the longest chain.

    Attributes:
        types: K service types with distinct names.
        vnfs: processing requirement d of each VNF, cycles/bit.

    Raises:
        ScenarioError: no type, two types of one name, weights that are all zero, an unknown VNF, or a requirement that
            is not positive.
    """

    types: tuple[ServiceType, ...]
    vnfs: Mapping[str, float] = field(default_factory=lambda: dict(PAPER_VNFS))

    def __post_init__(self) -> None:
        object.__setattr__(self, "types", tuple(self.types))
        if not 1 <= len(self.types) <= MOST_SERVICES:
            raise ScenarioError(
                f"services: there are {len(self.types) or 'none'}; define 1 to {MOST_SERVICES} services"
            )
        self._check_names()
        if not any(service.weight > 0 for service in self.types):
            raise ScenarioError("services: all weights are 0, so nothing could arrive; raise at least one weight")
        self._check_vnfs()

    def _check_names(self) -> None:
        """Names must differ, and so must the TensorBoard tags that they become."""
        tags: dict[str, str] = {}
        for name in self.names:
            tag = NOT_IN_TAGS.sub("_", name)
            if tag in tags:
                raise ScenarioError(f"services: {tags[tag]!r} and {name!r} have the one tag {tag!r}; names must differ")
            tags[tag] = name

    def _check_vnfs(self) -> None:
        for vnf, requirement in self.vnfs.items():
            check_name(vnf, "vnfs")
            parse(requirement, float, f"vnfs.{vnf}")
            if not requirement > 0:
                raise ScenarioError(f"vnfs.{vnf}: {requirement} cycles/bit; use a positive number")
        for service in self.types:
            for vnf in service.chain:
                if vnf not in self.vnfs:
                    raise ScenarioError(
                        f"services.{service.name}.chain: unknown VNF {vnf!r}; define it under vnfs or use one of "
                        f"{sorted(self.vnfs)}"
                    )
                load = self.vnfs[vnf] * service.rate
                if not 1 / LEDGER_UNITS <= load <= MAX_CAPACITY:
                    raise ScenarioError(
                        f"services.{service.name}: VNF {vnf} needs {load} Mcycles/s (d times rate); "
                        "change the rate or vnfs so that it lies from 1e-6 to 1e9"
                    )

    @property
    def names(self) -> tuple[str, ...]:
        """The K names, in order: a service's index is its place here."""
        return tuple(service.name for service in self.types)

    @cached_property
    def chain_length(self) -> np.ndarray:
        """Functions in each chain, int64 [K]."""
        return np.array([len(service.chain) for service in self.types], np.int64)

    @cached_property
    def load(self) -> np.ndarray:
        """Processing load d * B of each function of each chain in Mcycles/s, float64 [K, F], 0 past a chain's end."""
        table = np.zeros((len(self.types), int(self.chain_length.max())))
        for row, service in zip(table, self.types, strict=True):
            row[: len(service.chain)] = [self.vnfs[vnf] * service.rate for vnf in service.chain]
        return table

    @cached_property
    def rate(self) -> np.ndarray:
        """Data rates B in Mbit/s, float64 [K]."""
        return np.array([service.rate for service in self.types], np.float64)

    @cached_property
    def tolerable_delay(self) -> np.ndarray:
        """Tolerable delays tau in ms, float64 [K]."""
        return np.array([service.tolerable_delay for service in self.types], np.float64)

    @cached_property
    def mix(self) -> np.ndarray:
        """Probability that an arriving request is of each type, float64 [K]."""
        weights = np.array([service.weight for service in self.types], np.float64)
        return weights / weights.sum()

    @property
    def mean_load(self) -> float:
        """Processing load of a whole chain, averaged over the mix, Mcycles/s."""
        return float(self.mix @ self.load.sum(axis=1))


def paper_catalogue() -> ServiceCatalogue:
    """Web, VoIP and video as in the paper's service table."""
    return ServiceCatalogue(
        types=(
            ServiceType("web", ("NAT", "FW", "TM", "IDPS"), rate=0.1, tolerable_delay=500.0),
            ServiceType("voip", ("NAT", "FW", "TM", "FW", "NAT"), rate=0.064, tolerable_delay=100.0),
            ServiceType("video", ("NAT", "FW", "TM", "VOC", "IDPS"), rate=4.0, tolerable_delay=100.0),
        )
    )
