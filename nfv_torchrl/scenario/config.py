"""What a scenario's yaml may say: dataclasses of all keys with their defaults.

The paper's numbers are here and nowhere else in Python; a test compares `_base.yaml`, which shows them to users.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.arrivals import UNIFORM, ArrivalProcess, parse_arrivals
from nfv_torchrl.scenario.failures import FailureModel
from nfv_torchrl.scenario.kinds import CPU, Resource, parse_kinds
from nfv_torchrl.scenario.names import check_name
from nfv_torchrl.scenario.services import PAPER_VNFS, ServiceType, paper_catalogue
from nfv_torchrl.settings.values import parse_dataclass, shown

Range = tuple[float, float]
HORIZON = 1000
"""T of the paper, slots."""


@dataclass(frozen=True)
class SubstrateConfig:
    """The network. Ranges are [low, high], drawn uniformly.

    Attributes:
        path: network file, ``topohub:`` and a key, or name of a topology that ships (``docs/data.md``); null: random.
        attributes: what the file calls capacities, delays and so on, where these are not the names that are known.
        directed: ``pairs``: arcs of a directed file must pair up, if any do; ``merge``: the worse numbers of both.
        generator: ``_target_`` and arguments of a user's own callable, called with ``seed=``; returns a ``Substrate``.
        nodes: N, random graphs only.
        mean_degree: random graphs only.
        vms_min, vms_max: V_m, VMs of a node.
        vm_capacity: psi, Mcycles/s.
        vm_unit_cost: w, $ per Mcycles/s.
        link_capacity: x, Mbit/s; where a file has no capacities.
        link_delay: kappa, ms; where a file has neither delays nor coordinates.
        link_unit_cost: w-hat, $ per Mbit/s.
        fibre_km_per_ms: speed of light in fibre, km per ms.
        detour: length of a fibre over the great circle's.
        largest_component: of a disconnected file take the largest component instead of refusing it.
        duplex: ``shared``: one capacity for both directions of a link; ``full``: each direction has its own, that of
            the file's ``back_capacity`` or the same again; null: full where the file has that, else shared.
        target_rho: after the draw all VM capacities are scaled by one factor so that the offered load is this.
    """

    path: str | None = None
    attributes: dict[str, Any] | None = None
    directed: str = "pairs"
    generator: dict[str, Any] | None = None
    nodes: int = 10
    mean_degree: float = 4.0
    vms_min: int = 1
    vms_max: int = 6
    vm_capacity: Range = (200.0, 1200.0)
    vm_unit_cost: Range = (25.0, 75.0)
    link_capacity: Range = (1600.0, 6400.0)
    link_delay: Range = (5.0, 15.0)
    link_unit_cost: Range = (25.0, 75.0)
    fibre_km_per_ms: float = 200.0
    detour: float = 1.0
    largest_component: bool = False
    duplex: str | None = None
    target_rho: float | None = None

    def __post_init__(self) -> None:
        if self.duplex not in (None, "shared", "full"):
            raise ScenarioError(f"substrate.duplex: {shown(self.duplex)} is unknown; use shared or full, or null")
        if self.target_rho is not None and not 1e-6 <= self.target_rho <= 1e6:
            raise ScenarioError(f"substrate.target_rho: {self.target_rho}; use a positive number up to 1e6, or null")


@dataclass(frozen=True)
class WorkloadConfig:
    """``path``: file or folder of requests that replaces sampled workloads, or null (``docs/data.md``)."""

    path: str | None = None


def _paper_services() -> dict[str, ServiceType]:
    return {service.name: service for service in paper_catalogue().types}


@dataclass(frozen=True)
class ScenarioConfig:
    """All keys of a scenario; see ``nfv_torchrl.scenario.Scenario`` for those that it has too.

    Attributes:
        horizon: T, slots; null: up to the last request of ``workload.path``.
        arrivals: name of an arrival process, or a mapping with ``process`` and what it needs.
        pairs_per_service: P, (ingress, egress) pairs of a service type with ``endpoints: catalogue``.
        placement: ``walk``: one function with each arrival at a node; ``colocate``: what ``colocation: true`` says;
            ``distinct``: no two functions of a request on one node; null: as ``colocation`` says.
        step_budget: ``request``: J steps for each; ``slot``: for all of a service's requests in a slot.
        placing_after_chain: what an action that places is once all functions are placed: ``masked``: left out;
            ``forwards``: counted as one that forwards.
        resources: kinds of resources by name, see ``nfv_torchrl.scenario.kinds.Resource``; null: cpu alone.
        vnfs: processing requirement d of each VNF, cycles/bit; or a mapping from kinds of resources to requirements.
        services: service types by name.
    """

    name: str = "paper"
    seed: int = 0
    horizon: int | None = HORIZON
    warmup: int = 0
    arrival_rate: float = 10.0
    arrivals: ArrivalProcess = UNIFORM
    mean_lifetime: float = 600.0
    endpoints: str = "catalogue"
    pairs_per_service: int = 10
    colocation: bool = False
    placement: str | None = None
    mask: str = "adjacency"
    admission_control: bool = False
    observe_lifetime: bool = False
    max_steps: int = 100
    step_budget: str = "request"
    placing_after_chain: str = "masked"
    substrate: SubstrateConfig = field(default_factory=SubstrateConfig)
    resources: tuple[Resource, ...] = CPU
    vnfs: dict[str, float | dict[str, float]] = field(default_factory=lambda: dict(PAPER_VNFS))
    services: dict[str, ServiceType] = field(default_factory=_paper_services)
    workload: WorkloadConfig = field(default_factory=WorkloadConfig)
    failures: FailureModel = field(default_factory=FailureModel)


def parse_config(config: Mapping[str, Any] | ScenarioConfig) -> ScenarioConfig:
    """A checked ``ScenarioConfig`` from a plain mapping; missing keys take the paper's values.

    ``services`` may be a mapping from names to types or a list of types that have a ``name``; null stands for the
    paper's.

    Raises:
        ScenarioError: an unknown key, or a value of the wrong kind or out of range.
    """
    if isinstance(config, ScenarioConfig):
        return config
    if not isinstance(config, Mapping):
        raise ScenarioError(f"scenario: is a {type(config).__name__}; a mapping of keys to values was expected")
    values = dict(config)
    values["arrivals"] = parse_arrivals(values.get("arrivals"), "scenario.arrivals")
    values["resources"] = parse_kinds(values.get("resources"), "scenario.resources")
    if values.get("services") is None:
        values.pop("services", None)
    else:
        values["services"] = _services(values["services"])
    if isinstance(values.get("vnfs"), Mapping):
        for name in values["vnfs"]:
            check_name(name, "scenario.vnfs")
    return parse_dataclass(ScenarioConfig, values, "scenario")


def _services(config: Any) -> dict[str, ServiceType]:
    where = "scenario.services"
    if isinstance(config, Mapping):
        entries = list(config.items())
    elif isinstance(config, Sequence) and not isinstance(config, str):
        entries = [(service.get("name", "") if isinstance(service, Mapping) else "", service) for service in config]
    else:
        raise ScenarioError(f"{where}: is {shown(config)}; a mapping or list of services was expected")
    services: dict[str, ServiceType] = {}
    for name, entry in entries:
        service = _service(name, entry, where)
        if service.name in services:
            raise ScenarioError(f"{where}: {service.name!r} is there twice; names must differ")
        services[service.name] = service
    return services


def _service(name: Any, entry: Any, where: str) -> ServiceType:
    """One service of a config; ``name`` is its key, or its own ``name`` in a list."""
    if isinstance(entry, ServiceType):
        return entry
    check_name(name, where)
    if not isinstance(entry, Mapping):
        raise ScenarioError(f"{where}.{name}: is {shown(entry)}; give chain, rate, tolerable_delay and weight")
    if name in _paper_services() and {*entry} <= {*ServiceType.__dataclass_fields__} and "chain" not in entry:
        raise ScenarioError(
            f"{where}.{name}.chain: is missing; a service of your own has chain, rate and tolerable_delay, and to "
            "change single values of the paper's the scenario file needs `- services: paper` in its defaults"
        )
    return parse_dataclass(ServiceType, {"name": name, **entry}, f"{where}.{name}")
