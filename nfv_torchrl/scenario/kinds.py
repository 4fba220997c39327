"""Kinds of resources that a VM offers, such as cpu and memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.names import check_name
from nfv_torchrl.settings.values import parse, parse_dataclass, shown

MOST_KINDS = 8
DELAY = "delay"
"""Of a VNF's requirements: its own processing delay, ms. No kind may be called so."""


@dataclass(frozen=True)
class Resource:
    """One kind of resource.

    Attributes:
        name: what files and tables call it.
        scales_with_rate: a VNF's requirement is multiplied by the data rate (as cycles/bit are, which gives
            Mcycles/s); otherwise a function takes the requirement as it is, whatever its rate (as MB of memory).
        vm_capacity: [low, high] that capacities are drawn from where a network's file has none; not for the first kind,
            whose interval is ``substrate.vm_capacity``.
        vm_unit_cost: [low, high] of unit costs, $ per unit, likewise.

    Raises:
        ScenarioError: no name, or an interval that is none.
    """

    name: str
    scales_with_rate: bool = True
    vm_capacity: tuple[float, float] | None = None
    vm_unit_cost: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_name(self.name, "resources")
        if self.name == DELAY:
            raise ScenarioError(f"resources: no kind can be called {DELAY!r}, which is a VNF's processing delay")
        for key in ("vm_capacity", "vm_unit_cost"):
            pair = getattr(self, key)
            if pair is None:
                continue
            low, high = parse(pair, tuple[float, float], f"resources.{self.name}.{key}")
            if not 0 < low <= high:
                raise ScenarioError(f"resources.{self.name}.{key}: [{low:g}, {high:g}]; give [low, high] with 0 < low")
            object.__setattr__(self, key, (low, high))


CPU = (Resource("cpu"),)
"""The paper's only kind: Mcycles/s, in proportion to the data rate."""


def check_kinds(kinds: Sequence[Resource]) -> tuple[Resource, ...]:
    """The kinds as a tuple.

    Raises:
        ScenarioError: none, too many, or two of one name.
    """
    if not 1 <= len(kinds) <= MOST_KINDS:
        raise ScenarioError(f"resources: there are {len(kinds)} kinds; define 1 to {MOST_KINDS}")
    names = [kind.name for kind in kinds]
    if len(set(names)) < len(names):
        raise ScenarioError(f"resources: {shown(names)} has a name twice; names must differ")
    return tuple(kinds)


def parse_kinds(config: Any, where: str) -> tuple[Resource, ...]:
    """Kinds of a mapping from names to ``scales_with_rate``, ``vm_capacity`` and ``vm_unit_cost``, in its order."""
    if config is None:
        return CPU
    if isinstance(config, Sequence) and not isinstance(config, str):
        if all(isinstance(kind, Resource) for kind in config):
            return check_kinds(tuple(config))
        config = {entry.get("name", "") if isinstance(entry, dict) else "": entry for entry in config}
    if not isinstance(config, dict) or not all(isinstance(entry, dict) for entry in config.values()):
        raise ScenarioError(
            f"{where}: is {shown(config)}; give a mapping of names to {{scales_with_rate, vm_capacity, vm_unit_cost}}"
        )
    kinds = [parse_dataclass(Resource, {**entry, "name": name}, f"{where}.{name}") for name, entry in config.items()]
    return check_kinds(kinds)
