"""What a scenario's yaml may say: dataclasses of all keys with their defaults, and a strict parser."""

from __future__ import annotations

import dataclasses
import difflib
import os
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Union, get_args, get_origin

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.failures import FailureModel
from nfv_torchrl.scenario.services import PAPER_VNFS, ServiceType, paper_catalogue

Range = tuple[float, float]


@dataclass(frozen=True)
class SubstrateConfig:
    """The network. Ranges are [low, high], drawn uniformly.

    Attributes:
        path: file (``.json`` as written here, ``.graphml`` or ``.gml``) or name of a topology that ships; null: random.
        generator: ``_target_`` and arguments of a user's own callable, called with ``seed=``; returns a ``Substrate``.
        nodes: N, random graphs only.
        mean_degree: random graphs only.
        vms_min, vms_max: V_m, VMs of a node.
        vm_capacity: psi, Mcycles/s.
        vm_unit_cost: w, $ per Mcycles/s.
        link_capacity: x, Mbit/s; where a file has no speeds.
        link_delay: kappa, ms; where a file has no coordinates.
        link_unit_cost: w-hat, $ per Mbit/s.
        fibre_km_per_ms: speed of light in fibre, km per ms.
        detour: length of a fibre over the great circle's.
        largest_component: of a disconnected file take the largest component instead of refusing it.
        target_rho: after the draw all VM capacities are scaled by one factor so that the offered load is this.
    """

    path: str | None = None
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
    target_rho: float | None = None

    def __post_init__(self) -> None:
        if self.target_rho is not None and self.target_rho <= 0:
            raise ScenarioError(f"substrate.target_rho: {self.target_rho}; use a positive number, or null")


@dataclass(frozen=True)
class WorkloadConfig:
    """``path``: CSV file of requests that replaces sampled workloads, or null."""

    path: str | None = None


def _paper_services() -> dict[str, ServiceType]:
    return {service.name: service for service in paper_catalogue().types}


@dataclass(frozen=True)
class ScenarioConfig:
    """All keys of a scenario; see :class:`nfv_torchrl.scenario.Scenario` for those that it has too.

    Attributes:
        pairs_per_service: P, (ingress, egress) pairs of a service type with ``endpoints: catalogue``.
        vnfs: processing requirement d of each VNF, cycles/bit.
        services: service types by name.
    """

    name: str = "paper"
    seed: int = 0
    horizon: int = 1000
    warmup: int = 0
    arrival_rate: float = 10.0
    mean_lifetime: float = 600.0
    endpoints: str = "catalogue"
    pairs_per_service: int = 10
    colocation: bool = False
    mask: str = "adjacency"
    admission_control: bool = False
    observe_lifetime: bool = False
    max_steps: int = 100
    substrate: SubstrateConfig = field(default_factory=SubstrateConfig)
    vnfs: dict[str, float] = field(default_factory=lambda: dict(PAPER_VNFS))
    services: dict[str, ServiceType] = field(default_factory=_paper_services)
    workload: WorkloadConfig = field(default_factory=WorkloadConfig)
    failures: FailureModel = field(default_factory=FailureModel)


def parse_config(config: Mapping[str, Any] | ScenarioConfig) -> ScenarioConfig:
    """A checked :class:`ScenarioConfig` from a plain mapping; missing keys take the paper's values.

    ``services`` may be a mapping from names to types or a list of types that have a ``name``.

    Raises:
        ScenarioError: an unknown key, or a value of the wrong kind or out of range.
    """
    if isinstance(config, ScenarioConfig):
        return config
    if not isinstance(config, Mapping):
        raise ScenarioError(f"scenario: is a {type(config).__name__}; a mapping of keys to values was expected")
    values = dict(config)
    if "services" in values:
        values["services"] = _services(values["services"])
    return _parse_dataclass(ScenarioConfig, values, "scenario")


def _services(config: Any) -> dict[str, ServiceType]:
    where = "scenario.services"
    if isinstance(config, Mapping):
        entries = [(str(name), service) for name, service in config.items()]
    elif isinstance(config, Sequence) and not isinstance(config, str):
        entries = [(service.get("name", "") if isinstance(service, Mapping) else "", service) for service in config]
    else:
        raise ScenarioError(f"{where}: is {config!r}; a mapping or list of services was expected")
    services: dict[str, ServiceType] = {}
    for name, service in entries:
        if isinstance(service, Mapping):
            service = _parse_dataclass(ServiceType, {"name": name, **service}, f"{where}.{name}")
        if not isinstance(service, ServiceType):
            raise ScenarioError(f"{where}.{name}: is {service!r}; give chain, rate, tolerable_delay and weight")
        if service.name in services:
            raise ScenarioError(f"{where}: {service.name!r} is there twice; names must differ")
        services[service.name] = service
    return services


def _parse_dataclass(kind: type, values: Mapping[str, Any], where: str) -> Any:
    hints = typing.get_type_hints(kind)
    for key in values:
        if key not in hints:
            close = difflib.get_close_matches(str(key), hints, n=1)
            guess = f"did you mean {close[0]!r}? " if close else ""
            raise ScenarioError(f"{where}.{key}: unknown key; {guess}known keys: {', '.join(hints)}")
    for spec in dataclasses.fields(kind):
        required = spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING
        if required and spec.name not in values:
            raise ScenarioError(f"{where}.{spec.name}: is missing; add it")
    return kind(**{key: _parse(value, hints[key], f"{where}.{key}") for key, value in values.items()})


def _parse(value: Any, hint: Any, where: str) -> Any:
    """``value`` as the annotated type ``hint``, or an error that says what was expected."""
    if get_origin(hint) in (Union, types.UnionType):
        inner = [choice for choice in get_args(hint) if choice is not type(None)]
        return None if value is None else _parse(value, inner[0], where)
    if dataclasses.is_dataclass(hint):
        return _parse_nested(value, hint, where)
    if get_origin(hint) is dict:
        return _parse_mapping(value, get_args(hint)[1], where)
    if get_origin(hint) is tuple:
        return _parse_sequence(value, get_args(hint), where)
    if hint is Any or (isinstance(hint, type) and hint is not float and hint is not int and isinstance(value, hint)):
        return value
    if hint is str and isinstance(value, os.PathLike):
        return os.fspath(value)
    if hint in (int, float):
        return _parse_number(value, hint, where)
    expected = {bool: "true or false", str: "text"}.get(hint, f"a {hint}")
    raise ScenarioError(f"{where}: {value!r} where {expected} was expected")


def _parse_nested(value: Any, hint: Any, where: str) -> Any:
    if isinstance(value, hint):
        return value
    if not isinstance(value, Mapping):
        raise ScenarioError(f"{where}: {value!r} where a mapping of keys to values was expected")
    return _parse_dataclass(hint, value, where)


def _parse_mapping(value: Any, hint: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ScenarioError(f"{where}: {value!r} where a mapping of keys to values was expected")
    return {str(key): _parse(item, hint, f"{where}.{key}") for key, item in value.items()}


def _parse_sequence(value: Any, hints: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    endless = hints[-1] is Ellipsis
    expected = "a list" if endless else "two numbers [low, high]"
    if isinstance(value, str) or not isinstance(value, Sequence) or not (endless or len(value) == len(hints)):
        raise ScenarioError(f"{where}: {value!r} where {expected} was expected")
    return tuple(_parse(item, hints[0], f"{where}[{place}]") for place, item in enumerate(value))


def _parse_number(value: Any, hint: Any, where: str) -> int | float:
    expected = "an integer" if hint is int else "a finite number"
    # A comparison, because math.isfinite chokes on integers beyond a float's range.
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.integer | np.floating)
        or not -1e300 < value < 1e300
    ):
        raise ScenarioError(f"{where}: {value!r} where {expected} was expected")
    if hint is int and value != round(value):
        raise ScenarioError(f"{where}: {value!r} where {expected} was expected")
    return hint(value)
