"""What links and nodes of a network file may have numbers of, under which names, in which units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.limits import MAX_VMS
from nfv_torchrl.scenario.quoting import shown
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY


class Unit(NamedTuple):
    """A value in it is ``value * factor / divisor`` in this project's unit of the quantity."""

    factor: float = 1.0
    divisor: float = 1.0


SPEEDS = {
    "bit/s": Unit(divisor=1e6),
    "kbit/s": Unit(divisor=1e3),
    "Mbit/s": Unit(),
    "Gbit/s": Unit(1e3),
    "Tbit/s": Unit(1e6),
}
LEAST_POSITIVE = 5e-324
TIMES = {"s": Unit(1e3), "ms": Unit(), "us": Unit(divisor=1e3)}


@dataclass(frozen=True)
class Quantity:
    """What a link or a node has a number of.

    Attributes:
        key: its name, in this project's files and in ``substrate.attributes``.
        owner: ``link`` or ``node``.
        unit: this project's, for people.
        units: those a file may use, by name.
        least, most: the range of values in this project's unit.
        none_at: a value out of the range that says that there is no such thing.
        zoo: names of the Internet Topology Zoo, with their units, that are read after this project's own.
    """

    key: str
    owner: str
    unit: str
    units: Mapping[str, Unit] = field(default_factory=dict)
    least: float = LEAST_POSITIVE
    most: float = MAX_CAPACITY
    zoo: Mapping[str, Unit] = field(default_factory=dict)
    none_at: float | None = None


_ALL = (
    Quantity("capacity", "link", "Mbit/s", SPEEDS, least=1 / LEDGER_UNITS, zoo={"LinkSpeedRaw": SPEEDS["bit/s"]}),
    Quantity("delay", "link", "ms", TIMES, least=0.0),
    Quantity("unit_cost", "link", "$ per Mbit/s"),
    Quantity("latitude", "node", "degrees", least=-90.0, most=90.0, zoo={"Latitude": Unit()}),
    Quantity("longitude", "node", "degrees", least=-180.0, most=180.0, zoo={"Longitude": Unit()}),
    Quantity("vm_count", "node", "VMs", least=0.0, most=MAX_VMS),
    Quantity("vm_capacity", "node", "Mcycles/s", least=1 / LEDGER_UNITS, none_at=0.0),
    Quantity("vm_unit_cost", "node", "$ per Mcycles/s"),
)
QUANTITIES = {quantity.key: quantity for quantity in _ALL}

# -------------------------------------------------------------------- a user's names


class Source(NamedTuple):
    """An attribute that a quantity is read from; ``unit`` is None for ``LinkSpeed``, whose unit stands beside it.

    Text that is no number is refused, but of names that are the Topology Zoo's (``lenient``): its files have such text.
    """

    name: str
    unit: Unit | None
    lenient: bool = False


def parse_mapping(mapping: Mapping[str, Any], km_per_ms: float, detour: float = 1.0) -> dict[str, Source]:
    """Where ``substrate.attributes`` says that quantities are read from.

    Args:
        mapping: from quantities to a name, or to ``{name: NAME, unit: UNIT}``.
        km_per_ms: speed of light in fibre, for delays given as the length of a link in km.
        detour: length of a fibre over the great circle's, for delays given as the latter.

    Raises:
        ScenarioError: a quantity or a unit that does not exist, or no name.
    """
    sources = {}
    for key, value in mapping.items():
        where = f"substrate.attributes.{key}"
        if key not in QUANTITIES:
            raise ScenarioError(f"{where}: unknown quantity; use some of {', '.join(QUANTITIES)}")
        entry = {"name": value} if isinstance(value, str) else value
        if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str) or set(entry) - {"name", "unit"}:
            raise ScenarioError(
                f"{where}: {shown(value)}; give the name of an attribute, or {{name: NAME, unit: UNIT}}"
            )
        sources[key] = Source(entry["name"], _unit(key, entry.get("unit"), units_of(key, km_per_ms, detour), where))
    return sources


def units_of(key: str, km_per_ms: float, detour: float = 1.0) -> dict[str, Unit]:
    """The units that a file may give ``key`` in."""
    units = dict(QUANTITIES[key].units)
    if key == "delay":
        units |= {"km": Unit(divisor=km_per_ms), "great-circle km": Unit(detour, km_per_ms)}
    return units


def _unit(key: str, name: Any, units: Mapping[str, Unit], where: str) -> Unit:
    if name is None:
        return Unit()
    if name not in units:
        choice = f"use one of {', '.join(units)}" if units else "leave it out, this quantity has one unit only"
        raise ScenarioError(f"{where}.unit: {shown(name)} is unknown; {choice}")
    return units[name]


# -------------------------------------------------------------------- values


class Unreadable(ValueError):
    """A value that is no number."""


_TEXT = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*)")
_SPEED = re.compile(r"([kKmMgGtT]?)(?:bit/s|bits/s|b/s|bps|bit/sec)|([kKmMgGtT])")


def parse_value(value: Any, unit: Unit, units: Mapping[str, Unit]) -> float:
    """``value`` in this project's unit; NaN if the file has none, infinite if it is too large for a float.

    A bare number is in ``unit``; text may bring one of ``units`` itself, such as ``10 Gbps`` or ``5 ms``.

    Raises:
        Unreadable: it is no number, or text whose unit is not clear.
    """
    if value is None or (isinstance(value, str) and not value.strip()):
        return math.nan
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            value, unit = _with_unit(value, units)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Unreadable
    try:
        number = float(value) * unit.factor / unit.divisor
    except OverflowError:
        return math.inf
    return math.inf if math.isnan(number) else number


def _with_unit(text: str, units: Mapping[str, Unit]) -> tuple[float, Unit]:
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise Unreadable
    name = match[2].strip()
    if "bit/s" in units and (speed := _SPEED.fullmatch(name)):
        prefix = (speed[1] or speed[2] or "").upper().replace("K", "k")
        name = f"{prefix}bit/s"
    name = {"µs": "us", "μs": "us"}.get(name, name)
    if name not in units:
        raise Unreadable
    return float(match[1]), units[name]


def is_plain_number(value: Any) -> bool:
    """Whether ``value`` is a finite number, or text that is one, without a unit."""
    try:
        return math.isfinite(parse_value(value, Unit(), {}))
    except Unreadable:
        return False
