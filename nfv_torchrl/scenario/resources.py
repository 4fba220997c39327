"""Draws of what a topology does not tell: VMs, capacities, delays and unit costs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import Range, SubstrateConfig
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.limits import MAX_VMS
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY
from nfv_torchrl.settings.values import refuse


@dataclass(frozen=True)
class ResourceRanges:
    """Closed intervals that resources are drawn from, uniformly; the defaults are the paper's simulation settings.

    Attributes:
        vms: V_m, VMs of a node (integers).
        vm_capacity: psi, Mcycles/s.
        vm_unit_cost: w, $ per Mcycles/s.
        link_capacity: x, Mbit/s.
        link_delay: kappa, ms.
        link_unit_cost: w-hat, $ per Mbit/s.

    Raises:
        ScenarioError: an interval is empty, not finite, or reaches zero and below.
    """

    vms: tuple[int, int] = (SubstrateConfig.vms_min, SubstrateConfig.vms_max)
    vm_capacity: Range = SubstrateConfig.vm_capacity
    vm_unit_cost: Range = SubstrateConfig.vm_unit_cost
    link_capacity: Range = SubstrateConfig.link_capacity
    link_delay: Range = SubstrateConfig.link_delay
    link_unit_cost: Range = SubstrateConfig.link_unit_cost

    def __post_init__(self) -> None:
        for field in fields(self):
            low, high = _two_numbers(getattr(self, field.name), field.name)
            self._check(field.name, low, high)
        low, high = self.vms
        if low < 1 or int(low) != low or int(high) != high:
            raise ScenarioError(f"vms_min, vms_max: [{low}, {high}] are not VM counts; use integers from 1")
        if high > MAX_VMS:
            raise ScenarioError(f"vms_min, vms_max: [{low}, {high}]; use at most {MAX_VMS} VMs a node")

    def _check(self, name: str, low: float, high: float) -> None:
        hint = f"{'vms_min, vms_max' if name == 'vms' else name}: [{low:g}, {high:g}]"
        if not (np.isfinite(low) and np.isfinite(high)):
            raise ScenarioError(f"{hint} is not finite; give two numbers [low, high]")
        if low > high:
            raise ScenarioError(f"{hint} has low above high; swap them")
        least = 1 / LEDGER_UNITS if name.endswith("capacity") else 0.0
        if low < least or (low == 0 and name != "link_delay"):
            raise ScenarioError(f"{hint} must be positive; raise the lower bound")
        if high > MAX_CAPACITY:
            raise ScenarioError(f"{hint} exceeds {MAX_CAPACITY:g}; lower the upper bound")


def _two_numbers(pair: Any, name: str) -> tuple[float, float]:
    """The bounds of the interval ``name``."""
    numbers = isinstance(pair, tuple | list | np.ndarray) and len(pair) == 2
    if not numbers or any(isinstance(value, bool | str) or not np.isscalar(value) for value in pair):
        refuse(name, pair, "two numbers [low, high]")
    try:
        return float(pair[0]), float(pair[1])
    except (TypeError, OverflowError):
        refuse(name, pair, "two numbers [low, high]")


class VmDraw(NamedTuple):
    """Arrays of VMs as a ``Substrate`` has them; V is the end of the range of ``vms``."""

    vm_count: np.ndarray
    vm_capacity: np.ndarray
    vm_unit_cost: np.ndarray
    resources: tuple[str, ...] = ("cpu",)
    extra_capacity: np.ndarray | None = None
    extra_unit_cost: np.ndarray | None = None


class LinkDraw(NamedTuple):
    """``capacity`` (Mbit/s), ``delay`` (ms), ``unit_cost``: float64 [L]."""

    capacity: np.ndarray
    delay: np.ndarray
    unit_cost: np.ndarray


def draw_vms(nodes: int, seed: int, ranges: ResourceRanges, known_count: np.ndarray | None = None) -> VmDraw:
    """VMs of ``nodes`` nodes. The graph has no part in it: other links leave the VMs as they are.

    ``known_count`` int64 [N] holds VM counts that are not to be drawn, -1 where they are; V grows to the largest.
    """
    rng = generator(seed, Stream.RESOURCES, 0)
    low, high = (int(bound) for bound in ranges.vms)
    count = rng.integers(low, high, size=nodes, endpoint=True)
    if known_count is not None:
        count = np.where(known_count >= 0, known_count, count)
        high = max(high, int(known_count.max()))
    exists = np.arange(high) < count[:, None]
    capacity = rng.uniform(*ranges.vm_capacity, size=(nodes, high))
    unit_cost = rng.uniform(*ranges.vm_unit_cost, size=(nodes, high))
    return VmDraw(count, np.where(exists, capacity, 0.0), np.where(exists, unit_cost, 0.0))


def draw_further_kinds(substrate: Substrate, kinds: Sequence[Resource], seed: int) -> Substrate:
    """The substrate with VMs that also offer the ``kinds`` after the first, drawn where it lacks them.

    Each kind has a generator of its own: one more leaves the others as they are.

    Raises:
        ScenarioError: the substrate has other kinds, or there is no interval to draw from.
    """
    names = tuple(kind.name for kind in kinds)
    if substrate.resources == names:
        return substrate
    if len(substrate.resources) > 1 or substrate.resources[0] not in (names[0], "cpu"):
        raise ScenarioError(
            f"resources: the network {substrate.name!r} has {', '.join(substrate.resources)}, the scenario "
            f"{', '.join(names)}; name the same kinds in the same order"
        )
    exists = np.arange(substrate.max_vms) < substrate.vm_count[:, None]
    tables = []
    for place, kind in enumerate(kinds[1:], start=2):
        if kind.vm_capacity is None or kind.vm_unit_cost is None:
            raise ScenarioError(
                f"resources.{kind.name}: needs vm_capacity and vm_unit_cost, [low, high] each, to draw from: the "
                "network does not say how much its VMs have"
            )
        rng = generator(seed, Stream.RESOURCES, place)
        ranges = kind.vm_capacity, kind.vm_unit_cost
        tables.append([np.where(exists, rng.uniform(*interval, size=exists.shape), 0.0) for interval in ranges])
    further: np.ndarray = np.array(tables).reshape(len(tables), 2, *exists.shape).transpose(1, 2, 3, 0)
    return dataclasses.replace(
        substrate,
        resources=names,
        extra_capacity=further[0] if tables else None,
        extra_unit_cost=further[1] if tables else None,
    )


def draw_links(links: int, seed: int, ranges: ResourceRanges) -> LinkDraw:
    """Numbers of ``links`` links; the VMs have no part in it."""
    rng = generator(seed, Stream.RESOURCES, 1)
    capacity = rng.uniform(*ranges.link_capacity, size=links)
    delay = rng.uniform(*ranges.link_delay, size=links)
    return LinkDraw(capacity, delay, rng.uniform(*ranges.link_unit_cost, size=links))
