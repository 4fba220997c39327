"""The attributes of a network file as numbers in this project's units.

No number of a file goes unused, and none is made up for some links only, without a word: see ``FileNumbers.warn``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario.graph_files import GraphFile
from nfv_torchrl.scenario.quantities import (
    LEAST_POSITIVE,
    QUANTITIES,
    Quantity,
    Source,
    Unit,
    Unreadable,
    is_plain_number,
    parse_value,
    units_of,
)
from nfv_torchrl.scenario.quoting import shown

BOOKKEEPING = {"id", "key", "Internal", "hyperedge", "geocode_id", "file_id", "label", "vms"}
"""Attributes of files of the collection, and of ours, that are no quantities; they go without a warning."""
DRAWN = "drawn with the scenario seed"
NAMED = 10
"""Links or nodes that one warning names."""


@dataclass
class FileNumbers:
    """Numbers of a file by quantity, float64 [E] or [N], NaN where it has none; and what there is to say about it."""

    file: GraphFile
    values: dict[str, np.ndarray] = field(default_factory=dict)
    used: dict[str, set[str]] = field(default_factory=lambda: {"link": set(), "node": set()})
    unreadable: dict[str, list[str]] = field(default_factory=dict)
    with_unit: list[str] = field(default_factory=list)

    # ---------------------------------------------------------------- warnings

    def warn(self, origins: Mapping[str, str]) -> None:
        """Say which numbers were not used, not read, or read from text.

        ``origins`` tells by quantity where numbers that the file lacks come from, if not from the scenario seed.
        """
        lacking = [key for key in ("capacity", "delay", "unit_cost", "vm_capacity", "vm_unit_cost") if self._gaps(key)]
        for key in lacking:
            self._warn_of_gaps(key, origins.get(key, DRAWN))
        unused = [f"{name} ({owner}s)" for owner in ("link", "node") for name in self._unused(owner)]
        parts = list(self.file.notes)
        if self.file.demands is not None:
            parts.append(f"its {len(self.file.demands):,} demands are used by arrivals: matrix only")
        if unused:
            by_origin: dict[str, list[str]] = {}
            for key in lacking:
                by_origin.setdefault(origins.get(key, DRAWN), []).append(key)
            taken = ", ".join(f"{', '.join(keys)} {origin}" for origin, keys in by_origin.items())
            parts.append(
                f"numbers of the file that are not used: {', '.join(unused)}; instead: "
                f"{taken or 'others of the file'}; scenario.substrate.attributes says what a name means"
            )
        if parts:
            self.say("; ".join(parts))
        if self.with_unit:
            self.say(f"text with a unit read as a number: {some(self.with_unit)}")

    def _gaps(self, key: str) -> list[int]:
        """Links or nodes without a number of ``key``; a node that lists its VMs has those."""
        missing = np.flatnonzero(np.isnan(self.values[key])).tolist()
        if key in ("vm_capacity", "vm_unit_cost"):
            return [node for node in missing if self.file.nodes[node].get("vms") is None]
        return missing

    def _warn_of_gaps(self, key: str, origin: str) -> None:
        """Say what lacks a number of ``key`` unless all do, as where a file is a topology only."""
        missing, texts = self._gaps(key), self.unreadable.get(key, [])
        if texts or not np.isnan(self.values[key]).all():
            name = self.file.link_name if QUANTITIES[key].owner == "link" else self.file.node_name
            self.say_gaps(key, [name(entry) for entry in missing], origin, texts)

    def say_gaps(self, what: str, names: list[str], origin: str, texts: Sequence[str] = ()) -> None:
        """Say that links or nodes ``names`` have no ``what`` that can be read, and where theirs comes from."""
        reason = f" ({some(texts)}: no number with a clear unit)" if texts else ""
        self.say(f"no {what} of {some(names)}{reason}; {origin}")

    def say(self, message: str) -> None:
        """Warn of something about the file."""
        warnings.warn(f"{self.file.source}: {message}", ScenarioWarning, stacklevel=2)

    def _unused(self, owner: str) -> list[str]:
        """Names of attributes that hold a number somewhere and served for nothing."""
        entries = self.file.links if owner == "link" else self.file.nodes
        names = {name: None for data in entries for name, value in data.items() if _holds_number(value)}
        return [shown(name)[1:-1] for name in names if name not in self.used[owner] | BOOKKEEPING]


def _holds_number(value: Any) -> bool:
    """Whether ``value`` is a number, or a list or object that holds one, as drawings and vectors do."""
    if isinstance(value, Mapping):
        return any(map(_holds_number, value.values()))
    if isinstance(value, list | tuple):
        return any(map(_holds_number, value))
    return is_plain_number(value)


def some(names: Sequence[str]) -> str:
    """The first of ``names`` and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def read_numbers(file: GraphFile, mapping: Mapping[str, Source], km_per_ms: float) -> FileNumbers:
    """All quantities of ``file``, read from this project's names, the Topology Zoo's, or those that ``mapping`` gives.

    Raises:
        ScenarioError: a number out of range, a mapped name that no entry has, or text where this project's or a mapped
            name holds a number.
    """
    numbers = FileNumbers(file)
    for key, quantity in QUANTITIES.items():
        entries = file.links if quantity.owner == "link" else file.nodes
        if key in mapping:
            _check_there(mapping[key].name, key, entries, file)
            sources = [mapping[key]]
        else:
            sources = [Source(key, Unit()), *(Source(name, unit, True) for name, unit in quantity.zoo.items())]
            if key == "capacity":
                sources.append(Source("LinkSpeed", None, True))
        units = units_of(key, km_per_ms)
        numbers.values[key] = np.array(
            [_read(numbers, key, entry, data, sources, units) for entry, data in enumerate(entries)], np.float64
        )
    return numbers


def _check_there(name: str, key: str, entries: list[dict[str, Any]], file: GraphFile) -> None:
    if not any(name in data for data in entries):
        names = sorted({name for data in entries for name in data})
        known = f"they have {some([shown(name)[1:-1] for name in names])}" if names else "they have none"
        raise ScenarioError(
            f"substrate.attributes.{key}: no {QUANTITIES[key].owner} of {file.source} has an attribute {shown(name)}; "
            f"{known}"
        )


def _read(
    numbers: FileNumbers, key: str, entry: int, data: dict[str, Any], sources: list[Source], units: Mapping[str, Unit]
) -> float:
    """The number of quantity ``key`` of one link or node, from the first of ``sources`` that has one."""
    quantity = QUANTITIES[key]
    for source in sources:
        if source.name not in data:
            continue
        text = data[source.name]
        try:
            value = parse_value(*_amount(data, source), units)
        except Unreadable:
            where = f"{source.name} of {_name(numbers.file, quantity, entry)} is {shown(text)}"
            if not source.lenient:
                raise ScenarioError(f"{numbers.file.source}: {where}; a number was expected") from None
            numbers.unreadable.setdefault(key, []).append(where)
            continue
        if math.isnan(value):
            continue
        _check_range(numbers.file, quantity, entry, source.name, text, value)
        numbers.used[quantity.owner].update(["LinkSpeed"] if source.name == "LinkSpeedRaw" else [], [source.name])
        if isinstance(text, str) and source.unit is not None and not is_plain_number(text):
            numbers.with_unit.append(
                f"{source.name} {shown(text)} of {_name(numbers.file, quantity, entry)} as {value:g}"
            )
        return value
    return math.nan


def _amount(data: dict[str, Any], source: Source) -> tuple[Any, Unit]:
    """A value and its unit, that of ``LinkSpeed`` standing in ``LinkSpeedUnits``."""
    value = data[source.name]
    if source.unit is not None:
        return value, source.unit
    unit = data.get("LinkSpeedUnits") or ""
    if not unit and is_plain_number(value):
        raise Unreadable
    return f"{value} {unit}", Unit()


def _name(file: GraphFile, quantity: Quantity, entry: int) -> str:
    return file.link_name(entry) if quantity.owner == "link" else file.node_name(entry)


def _check_range(file: GraphFile, quantity: Quantity, entry: int, name: str, text: Any, value: float) -> None:
    if not quantity.least <= value <= quantity.most and value != quantity.none_at:
        least = "above 0" if quantity.least == LEAST_POSITIVE else f"at least {quantity.least:g}"
        raise ScenarioError(
            f"{file.source}: {_name(file, quantity, entry)}: {name} is {shown(text)}; it must be {least} and at most "
            f"{quantity.most:g} {quantity.unit}; correct the file"
        )
