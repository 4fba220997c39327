"""Services: which VNFs a request's chain needs, at what rate and within what delay."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.kinds import CPU, DELAY, Resource, check_kinds
from nfv_torchrl.scenario.names import check_name
from nfv_torchrl.scenario.profiles import Profiles
from nfv_torchrl.scenario.ranges import LARGEST, check_range, is_range, middle, values_of
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY
from nfv_torchrl.settings.values import parse

PAPER_VNFS: dict[str, float] = {"NAT": 0.092, "FW": 0.09, "TM": 1.33, "VOC": 0.54, "IDPS": 1.07}
"""Processing requirement d of each VNF in cycles/bit: 100 times the per-user CPU shares of Savi et al., the source of
the paper's service table."""

SHORTEST_MEAN, LONGEST_MEAN = 1e-6, 1e12
"""s; mean lifetimes beyond make sums of delays and loads lose digits or overflow."""
MOST_SERVICES = 1000
ANY = "any"
"""In place of an ingress or egress: it is free, the first or last function may stand on any node."""
FREE = -1
"""The node of an end that is free."""
NOT_IN_TAGS = re.compile(r"[^-/\w.]")
"""Characters that TensorBoard's writer replaces by ``_``."""


@dataclass(frozen=True)
class ServiceType:
    """One type of service.

    Attributes:
        name: what files and tables call it.
        chain: VNF names in the order in which traffic passes them, repeats allowed; none: requests are only routed.
        rate: data rate B, Mbit/s; or [low, high], from which every request draws its own (see ``scenario/ranges.py``).
        tolerable_delay: tau, ms; None: any delay will do; or [low, high], likewise.
        weight: share of the mix, relative to the other types; 0 never arrives.
        rates: data rate of each segment instead of one for all, F + 1 of them: from the ingress to the first function,
            between functions, and from the last one to the egress.
        ingress: ``any``: the first function may stand on any node, and the walk begins there.
        egress: ``any``: the walk ends with the last function.
        mean_lifetime: s, of the requests of this type; None: the scenario's.

    Raises:
        ScenarioError: a value is out of range.
    """

    name: str
    chain: tuple[str, ...]
    rate: float | tuple[float, float]
    tolerable_delay: float | tuple[float, float] | None
    weight: float = 1.0
    rates: tuple[float, ...] | None = field(default=None, repr=False)
    ingress: str | None = field(default=None, repr=False)
    egress: str | None = field(default=None, repr=False)
    mean_lifetime: float | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_name(self.name, "services")
        where = f"services.{self.name}"
        if isinstance(self.chain, str):
            raise ScenarioError(f"{where}.chain: {self.chain!r} is text; give a list of VNF names")
        object.__setattr__(self, "chain", tuple(self.chain))
        for vnf in self.chain:
            check_name(vnf, f"{where}.chain")
        parse(self.weight, float, f"{where}.weight")
        for key in ("rate", "tolerable_delay"):
            object.__setattr__(self, key, check_range(getattr(self, key), f"{where}.{key}"))
        if not 1 / LEDGER_UNITS <= values_of(self.rate)[0] <= values_of(self.rate)[-1] <= MAX_CAPACITY:
            raise ScenarioError(f"{where}.rate: {self.rate} Mbit/s; use a number from 1e-6 to 1e9")
        if self.tolerable_delay is not None and not 0 < values_of(self.tolerable_delay)[-1] <= LARGEST:
            raise ScenarioError(f"{where}.tolerable_delay: {self.tolerable_delay} ms; use a positive number up to 1e30")
        if self.mean_lifetime is not None:
            parse(self.mean_lifetime, float, f"{where}.mean_lifetime")
            if not SHORTEST_MEAN <= self.mean_lifetime <= LONGEST_MEAN:
                raise ScenarioError(
                    f"{where}.mean_lifetime: {self.mean_lifetime} s; use a positive number, "
                    f"from {SHORTEST_MEAN:g} to {LONGEST_MEAN:g}, or null for the scenario's"
                )
        if not (self.weight == 0 or 1 / LARGEST <= self.weight <= LARGEST):
            raise ScenarioError(f"{where}.weight: {self.weight}; use 0 or a positive number from 1e-30 to 1e30")
        self._check_rates(where)
        self._check_ends(where)

    def _check_rates(self, where: str) -> None:
        if self.rates is None:
            return
        if is_range(self.rate):
            raise ScenarioError(
                f"{where}.rates: leave it out, or give rate as one number; with [low, high] it is drawn"
            )
        rates = parse(self.rates, tuple[float, ...], f"{where}.rates")
        object.__setattr__(self, "rates", rates)
        if len(rates) != len(self.chain) + 1:
            raise ScenarioError(
                f"{where}.rates: there are {len(rates)}; a chain of {len(self.chain)} has {len(self.chain) + 1} "
                "segments: to its first function, between functions, and from its last one"
            )
        for rate in rates:
            if rate != 0 and not 1 / LEDGER_UNITS <= rate <= MAX_CAPACITY:
                raise ScenarioError(f"{where}.rates: {rate} Mbit/s; use 0 or a number from 1e-6 to 1e9")

    def _check_ends(self, where: str) -> None:
        for end in ("ingress", "egress"):
            if getattr(self, end) not in (None, ANY):
                raise ScenarioError(f"{where}.{end}: {getattr(self, end)!r}; use {ANY}, or leave it out")
        if not self.chain and self.free_ends:
            raise ScenarioError(f"{where}: has no chain, so its ends cannot be free; name a VNF or remove {ANY}")

    @property
    def free_ends(self) -> bool:
        """Whether its ingress or egress is free."""
        return self.ingress == ANY or self.egress == ANY

    @property
    def segment_rates(self) -> tuple[float, ...]:
        """Data rate of each of its F + 1 segments, Mbit/s; the mean of a rate that is drawn."""
        return self.rates if self.rates is not None else (middle(self.rate),) * (len(self.chain) + 1)

    @property
    def is_drawn(self) -> bool:
        """Whether each request draws its own rate or tolerable delay."""
        return is_range(self.rate) or is_range(self.tolerable_delay)

    @property
    def drawn_values(self) -> tuple[np.ndarray, np.ndarray]:
        """The rates (Mbit/s) and the tolerable delays (ms, infinite: any) that its requests draw from, ascending."""
        any_delay = np.array([np.inf])
        return values_of(self.rate), any_delay if self.tolerable_delay is None else values_of(self.tolerable_delay)


@dataclass(frozen=True)
class ServiceCatalogue:
    """All service types of a scenario and the VNFs they are made of. Arrays below have K types and F the longest chain.

    Attributes:
        types: K service types with distinct names.
        vnfs: what each VNF requires: of the first kind (processing requirement d, cycles/bit), or a mapping from kinds
            to requirements, with the VNF's own processing delay in ms under ``delay`` if it has one.
        resources: kinds of resources that VMs offer; the first is what processing delays follow from.

    Raises:
        ScenarioError: no type, two types of one name, weights that are all zero, an unknown VNF or kind, or a
            requirement that is not positive.
    """

    types: tuple[ServiceType, ...]
    vnfs: Mapping[str, float | Mapping[str, float]] = field(default_factory=lambda: dict(PAPER_VNFS))
    resources: tuple[Resource, ...] = CPU

    def __post_init__(self) -> None:
        object.__setattr__(self, "types", tuple(self.types))
        object.__setattr__(self, "resources", check_kinds(self.resources))
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
            if isinstance(requirement, Mapping):
                self._check_requirements(vnf, requirement)
                continue
            parse(requirement, float, f"vnfs.{vnf}")
            if not requirement > 0:
                raise ScenarioError(f"vnfs.{vnf}: {requirement} cycles/bit; use a positive number")
        for service in self.types:
            for vnf, rate in self._uses(service):
                if vnf not in self.vnfs:
                    raise ScenarioError(
                        f"services.{service.name}.chain: unknown VNF {vnf!r}; define it under vnfs or use one of "
                        f"{sorted(self.vnfs)}"
                    )
                self._check_load(service, vnf, rate)

    @staticmethod
    def _uses(service: ServiceType) -> Iterator[tuple[str, float]]:
        """VNFs of a chain with the least and the largest rate that they may have to carry."""
        if service.rates is not None:
            yield from zip(service.chain, service.rates, strict=False)
            return
        rates = service.drawn_values[0]
        for vnf in service.chain:
            yield vnf, float(rates[0])
            yield vnf, float(rates[-1])

    def _check_requirements(self, vnf: str, requirement: Mapping[str, float]) -> None:
        known = [*(kind.name for kind in self.resources), DELAY]
        for kind, value in requirement.items():
            if kind not in known:
                raise ScenarioError(f"vnfs.{vnf}.{kind}: unknown; use some of {known}, or define it under resources")
            parse(value, float, f"vnfs.{vnf}.{kind}")
            if not 0 <= value <= MAX_CAPACITY:
                raise ScenarioError(f"vnfs.{vnf}.{kind}: {value}; use a number from 0 to 1e9")

    def _check_load(self, service: ServiceType, vnf: str, rate: float) -> None:
        for kind, load in zip(self.resources, self.amounts_of(vnf, rate), strict=True):
            if load == 0 and (rate == 0 or isinstance(self.vnfs[vnf], Mapping) or kind is not self.resources[0]):
                continue
            if not 1 / LEDGER_UNITS <= load <= MAX_CAPACITY:
                what = f"{load} Mcycles/s (d times rate)" if kind.name == "cpu" else f"{load} of {kind.name}"
                raise ScenarioError(
                    f"services.{service.name}: VNF {vnf} needs {what}; "
                    "change the rate or vnfs so that it lies from 1e-6 to 1e9"
                )

    def amounts_of(self, vnf: str, rate: float) -> list[float]:
        """What a VNF takes of each kind at ``rate`` Mbit/s, R numbers."""
        requirement = self.vnfs[vnf]
        if not isinstance(requirement, Mapping):
            requirement = {self.resources[0].name: requirement}
        return [requirement.get(kind.name, 0.0) * (rate if kind.scales_with_rate else 1.0) for kind in self.resources]

    def own_delay(self, vnf: str) -> float | None:
        """The processing delay that a VNF states, ms; None where it follows from its load and the VM."""
        requirement = self.vnfs[vnf]
        return requirement.get(DELAY) if isinstance(requirement, Mapping) else None

    @property
    def names(self) -> tuple[str, ...]:
        """The K names, in order: a service's index is its place here."""
        return tuple(service.name for service in self.types)

    @cached_property
    def chain_length(self) -> np.ndarray:
        """Functions in each chain, int64 [K]."""
        return np.array([len(service.chain) for service in self.types], np.int64)

    @cached_property
    def profiles(self) -> Profiles:
        """The K types as profiles, in order; what is drawn for each request at its mean."""
        delays = [np.inf if each.tolerable_delay is None else middle(each.tolerable_delay) for each in self.types]
        return self._profiles(np.arange(len(self.types)), [each.segment_rates for each in self.types], delays)

    @cached_property
    def drawn(self) -> Profiles | None:
        """Every profile that a request may draw, a service's together (see ``drawn_first``); None without any."""
        kinds, rates, delays = [], [], []
        for kind, service in enumerate(self.types):
            if service.is_drawn:
                for rate in service.drawn_values[0]:
                    segments = service.rates or (float(rate),) * (len(service.chain) + 1)
                    for delay in service.drawn_values[1]:
                        kinds.append(kind)
                        rates.append(segments)
                        delays.append(float(delay))
        return self._profiles(np.array(kinds), rates, delays) if kinds else None

    @cached_property
    def drawn_first(self) -> np.ndarray:
        """Of each type the first of its profiles in ``drawn``, int64 [K]. They are in order of rate, then of delay."""
        sizes = [len(each.drawn_values[0]) * len(each.drawn_values[1]) if each.is_drawn else 0 for each in self.types]
        return np.cumsum([0, *sizes[:-1]])

    def _profiles(self, kinds: np.ndarray, rates: Sequence[Sequence[float]], delays: Sequence[float]) -> Profiles:
        """A profile for each of the types ``kinds`` int64 [P], with rates of its segments and a tolerable delay."""
        functions = max(int(self.chain_length.max()), 1)
        count = len(kinds)
        amount = np.zeros((count, functions, len(self.resources)))
        work, fixed_delay = np.zeros((count, functions)), np.zeros((count, functions))
        rate = np.zeros((count, functions + 1))
        for row, kind in enumerate(kinds):
            service = self.types[kind]
            rate[row, : len(service.chain) + 1] = rates[row]
            for place, vnf in enumerate(service.chain):
                amount[row, place] = self.amounts_of(vnf, rate[row, place])
                stated = self.own_delay(vnf)
                if stated is not None:
                    fixed_delay[row, place] = stated
                elif self.resources[0].scales_with_rate:
                    work[row, place] = amount[row, place, 0]
        return Profiles(kinds, self.chain_length[kinds], amount, work, fixed_delay, rate, np.array(delays))

    @cached_property
    def load(self) -> np.ndarray:
        """Load of each function of each chain on the first kind (d * B in Mcycles/s), float64 [K, F]."""
        return self.profiles.amount[:, :, 0]

    @cached_property
    def rate(self) -> np.ndarray:
        """Data rates B in Mbit/s, float64 [K]; of the first segment where these differ."""
        return self.profiles.rate[:, 0]

    @cached_property
    def tolerable_delay(self) -> np.ndarray:
        """Tolerable delays tau in ms, float64 [K], infinite where any delay will do."""
        return self.profiles.tolerable_delay

    @cached_property
    def mix(self) -> np.ndarray:
        """Probability that an arriving request is of each type, float64 [K]."""
        weights = np.array([service.weight for service in self.types], np.float64)
        return weights / weights.sum()

    @property
    def mean_load(self) -> float:
        """Load of a whole chain on the first kind, averaged over the mix, Mcycles/s."""
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
