"""What other projects call the quantities of a network in GraphML, GML and JSON files.

A file whose attributes bear the marks of a project is read with that project's names and units. Names of this project
and what ``substrate.attributes`` says go before. What is assumed is said in the warning about the file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from nfv_torchrl.scenario.formats.graph import GraphFile
from nfv_torchrl.scenario.formats.topohub import is_topohub, read_graph_demands, read_places
from nfv_torchrl.scenario.quantities import QUANTITIES, Unit, Unreadable, parse_value


@dataclass(frozen=True)
class Dialect:
    """Names that one project gives quantities.

    Attributes:
        name: the project, for people.
        marks: whether a file has them.
        names: as ``substrate.attributes``.
        one_vm: a node's capacity is that of its only VM.
        says_units: its files, or its documentation, leave no doubt about the units.
    """

    name: str
    marks: Callable[[GraphFile], bool]
    names: Mapping[str, Any] = field(default_factory=dict)
    one_vm: bool = False
    says_units: bool = False


def _has(nodes: set[str], links: set[str]) -> Callable[[GraphFile], bool]:
    """Whether some node has a number under each of the names ``nodes`` and some link under each of ``links``."""

    def marks(file: GraphFile) -> bool:
        there = {(owner, name) for owner, entries in _owners(file) for data in entries for name in data}
        return {("node", name) for name in nodes} | {("link", name) for name in links} <= there

    return marks


def _has_distances_only(file: GraphFile) -> bool:
    """Whether this is JSON whose links have a ``distance`` each and nothing else."""
    return file.source.endswith(".json") and bool(file.links) and all(set(link) == {"distance"} for link in file.links)


def _owners(file: GraphFile) -> tuple[tuple[str, list[dict[str, Any]]], ...]:
    return ("node", file.nodes), ("link", file.links)


DIALECTS = (
    Dialect("TopoHub", is_topohub, {"delay": {"name": "dist", "unit": "great-circle km"}}, says_units=True),
    Dialect("Virne", _has({"cpu"}, {"bw"}), {"vm_capacity": "cpu", "capacity": "bw"}, one_vm=True),
    Dialect(
        "RealVNF",
        _has({"NodeCap"}, {"LinkFwdCap"}),
        {"vm_capacity": "NodeCap", "capacity": "LinkFwdCap", "delay": "LinkDelay"},
        one_vm=True,
    ),
    Dialect("XLRON", _has_distances_only, {"delay": {"name": "distance", "unit": "km"}}),
)
PLACES = (("lat", "lon"), ("lat", "lng"))
"""Names of latitude and longitude in degrees, in files of any origin."""


def translate(file: GraphFile, mapped: Collection[str] = ()) -> GraphFile:
    """``file`` with the names, demands and labels that its project's files are known to have.

    ``mapped`` are the quantities of which the user says where to read them.

    Raises:
        ScenarioError: demands of a form that is not known.
    """
    names, notes, nodes = dict(file.names), list(file.notes), file.nodes
    for dialect in DIALECTS:
        if not dialect.marks(file):
            continue
        if dialect.marks is is_topohub:
            nodes = read_places(file)
        read = {key: name for key, name in dialect.names.items() if key not in mapped and _is_free(file, key, name)}
        names = {**read, **names}
        alone = dialect.one_vm and "vm_count" not in mapped and not any("vm_count" in node for node in nodes)
        if alone:
            nodes = [{**node, "vm_count": 1} for node in nodes]
        notes += _note(dialect, read, alone)
    for latitude, longitude in PLACES:
        if _is_place(file, "latitude", latitude) and _is_place(file, "longitude", longitude):
            names = {"latitude": latitude, "longitude": longitude, **names}
    names = {key: name for key, name in names.items() if _has_name(file, nodes, key, name)}
    demands = file.demands or read_graph_demands(file)
    nodes = [_labelled(node, name) for node, name in zip(nodes, file.ids, strict=True)]
    return dataclasses.replace(file, nodes=nodes, names=names, notes=tuple(notes), demands=demands)


def _note(dialect: Dialect, read: Mapping[str, Any], alone: bool) -> list[str]:
    """What is assumed about a file of ``dialect``."""
    parts = [] if dialect.says_units else [_meaning(key, name) for key, name in read.items()]
    parts += ["one VM a node"] if alone else []
    return [f"read as {dialect.name}'s files, which name no units: {', '.join(parts)}"] if parts else []


def _meaning(key: str, name: Any) -> str:
    """Which attribute is ``key`` in which unit."""
    said = {"name": name} if isinstance(name, str) else name
    return f"{said['name']} as {key} in {said.get('unit', QUANTITIES[key].unit)}"


def _has_name(file: GraphFile, nodes: list[dict[str, Any]], key: str, name: Any) -> bool:
    """Whether some link or node has the attribute that ``name`` says."""
    there = name if isinstance(name, str) else name["name"]
    return any(there in data for data in (file.links if QUANTITIES[key].owner == "link" else nodes))


def _is_free(file: GraphFile, key: str, name: Any) -> bool:
    """Whether no entry has ``key`` under this project's name, and some under the project's ``name``."""
    entries = file.links if QUANTITIES[key].owner == "link" else file.nodes
    return _has_name(file, file.nodes, key, name) and not any(key in data for data in entries)


def _is_place(file: GraphFile, key: str, name: str) -> bool:
    quantity = QUANTITIES[key]
    if not _is_free(file, key, name) or any(zoo in node for node in file.nodes for zoo in quantity.zoo):
        return False
    try:
        values = [parse_value(node.get(name), Unit(), {}) for node in file.nodes]
    except Unreadable:
        return False
    return all(math.isnan(value) or quantity.least <= value <= quantity.most for value in values)


def _labelled(node: dict[str, Any], name: Any) -> dict[str, Any]:
    """``node`` with its ``name`` for a label, where it has none but its id."""
    own = node.get("name")
    if isinstance(own, str) and own.strip() and str(node.get("label", name)) in ("", str(name)):
        return {**node, "label": own}
    return node
