"""Real topologies: GraphML and GML files as those of the Internet Topology Zoo, a dozen of which ship here."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import networkx as nx
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_bytes
from nfv_torchrl.scenario.links import Links, merge_links
from nfv_torchrl.scenario.resources import ResourceRanges, draw_links, draw_vms
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY

TOPOLOGIES = Path(__file__).parent / "topologies"
EARTH_RADIUS_KM = 6371.0
LEAST_DELAY = 0.01
"""ms; floor of a link's delay, for nodes at one place (2 km of fibre)."""

# What networkx's parsers raise on files that are not what they claim to be.
_PARSE_ERRORS = (nx.NetworkXException, ParseError, ValueError, KeyError, TypeError, IndexError, AttributeError)


def shipped_topologies() -> list[str]:
    """Names that :func:`read_topology` takes besides paths: those of the files in this package, in lower case."""
    return sorted(path.stem.lower() for path in TOPOLOGIES.glob("*.graphml"))


def read_topology(
    path: str | os.PathLike[str],
    seed: int,
    *,
    fibre_km_per_ms: float = 200.0,
    detour: float = 1.0,
    largest_component: bool = False,
    **ranges: Any,
) -> Substrate:
    """The network of a ``.graphml`` or ``.gml`` file, or of a topology that ships here, with VMs drawn.

    Links: capacity from ``LinkSpeedRaw`` (bit/s) as it stands, drawn where that is missing; delay from the great circle
    between ``Latitude`` and ``Longitude`` of the ends times ``detour`` over ``fibre_km_per_ms``, at least 0.01 ms;
    unit cost drawn. Parallel links are merged: capacities add, the smallest delay and unit cost stay. Links from a node
    to itself are dropped with a warning. Nodes without coordinates get the mean of their neighbours', with a warning
    that names them; if no node has any, delays are drawn. Equal labels are told apart by a number, as ``Oslo (2)``.

    Args:
        path: file, or one of :func:`shipped_topologies` (in any case).
        seed: scenario seed, for what is drawn.
        fibre_km_per_ms: speed of light in fibre.
        detour: length of a fibre over the great circle's.
        largest_component: keep only the largest connected component (of several the first) of a disconnected file.
        ranges: any field of :class:`ResourceRanges`.

    Raises:
        ScenarioError: the file is missing, cannot be parsed, is directed, disconnected or has no links; or an argument
            is out of range.
    """
    for name, value in (("fibre_km_per_ms", fibre_km_per_ms), ("detour", detour)):
        if not (math.isfinite(value) and value > 0):
            raise ScenarioError(f"{name}: {value}; use a positive number")
    drawn_from = ResourceRanges(**ranges)
    file = _find(path)
    graph = _connected(_read_graph(file), file, largest_component)
    labels = _distinct(_label(data) for _, data in graph.nodes(data=True))
    coordinates = _coordinates(graph, labels, file)
    links = _links(graph, coordinates, drawn_from, seed, km_per_ms=fibre_km_per_ms / detour, source=str(file))
    vms = draw_vms(len(graph), seed, drawn_from)
    return Substrate(
        name=file.stem,
        labels=labels,
        vm_count=vms.vm_count,
        vm_capacity=vms.capacity,
        vm_unit_cost=vms.unit_cost,
        links=links.ends,
        link_capacity=links.capacity,
        link_delay=links.delay,
        link_unit_cost=links.unit_cost,
        coordinates=coordinates,
        ids=tuple(str(data["id"]) for _, data in graph.nodes(data=True)),
    )


# -------------------------------------------------------------------- files


def _find(path: str | os.PathLike[str]) -> Path:
    """The file of ``path``, be it a path or a shipped name."""
    shipped = {file.stem.lower(): file for file in TOPOLOGIES.glob("*.graphml")}
    if str(path).lower() in shipped:
        return shipped[str(path).lower()]
    if Path(path).suffix.lower() not in (".graphml", ".gml"):
        raise ScenarioError(
            f"substrate.path: {str(path)!r} is neither a file ending in .json, .graphml or .gml nor a topology that "
            f"ships here; those are {', '.join(sorted(shipped))}"
        )
    return Path(path)


def _read_graph(file: Path) -> nx.MultiGraph:
    """The file's graph with nodes renamed 0 .. N-1 in the file's order; ``id`` keeps what the file calls them."""
    content = read_bytes(file)
    try:
        if file.suffix.lower() == ".gml":
            graph = nx.parse_gml(_as_multigraph(content.decode(errors="replace")).splitlines(), label="id")
        else:
            # Bytes, because only they may declare an encoding.
            graph = nx.parse_graphml(content, force_multigraph=True)
    except _PARSE_ERRORS as error:
        kind = "GML" if file.suffix.lower() == ".gml" else "GraphML"
        raise ScenarioError(f"{file}: is not valid {kind} ({error}); repair or replace the file") from error
    if graph.is_directed():
        raise ScenarioError(f"{file}: is directed; links serve both directions, so give an undirected graph")
    return nx.convert_node_labels_to_integers(nx.MultiGraph(graph), label_attribute="id")


def _as_multigraph(gml: str) -> str:
    """A GML text that says it has parallel edges: many files have some and do not say so.

    The keys of edges go: networkx takes them for the identity of a parallel edge, files repeat them where they are not.
    """
    gml = re.sub(r"(?m)^\s*(key|multigraph)\s+\S+\s*$", "", gml)
    return re.sub(r"(^|\s)graph\s*\[", r"\1graph [ multigraph 1 ", gml, count=1)


def _connected(graph: nx.MultiGraph, file: Path, largest_component: bool) -> nx.MultiGraph:
    if graph.number_of_nodes() < 2:
        raise ScenarioError(f"{file}: has {graph.number_of_nodes()} node(s); a network needs at least 2")
    parts = list(nx.connected_components(graph))
    if len(parts) == 1:
        return graph
    largest = max(parts, key=lambda part: len(part))
    if not largest_component:
        raise ScenarioError(
            f"{file}: is not connected ({len(parts)} parts, the largest of {len(largest)} of "
            f"{len(graph)} nodes); set substrate.largest_component=true to keep that one"
        )
    kept = graph.subgraph(sorted(largest))
    if len(kept) < 2:
        raise ScenarioError(f"{file}: has no links; a network needs at least one")
    return nx.convert_node_labels_to_integers(kept, ordering="sorted")


def _label(data: dict[str, Any]) -> str:
    label = data.get("label")
    return str(data["id"] if label in (None, "") else label)


def _distinct(labels: Iterable[str]) -> tuple[str, ...]:
    """``labels`` made unique: the second ``Oslo`` becomes ``Oslo (2)``."""
    result: list[str] = []
    taken: set[str] = set()
    for label in labels:
        unique, number = label, 1
        while unique in taken:
            number += 1
            unique = f"{label} ({number})"
        taken.add(unique)
        result.append(unique)
    return tuple(result)


# -------------------------------------------------------------------- links


def _links(
    graph: nx.MultiGraph,
    coordinates: np.ndarray | None,
    drawn_from: ResourceRanges,
    seed: int,
    *,
    km_per_ms: float,
    source: str,
) -> Links:
    """The graph's links, parallel ones merged."""
    edges = list(graph.edges(data=True))
    ends = np.array([edge[:2] for edge in edges], np.int64).reshape(-1, 2)
    drawn = draw_links(len(edges), seed, drawn_from)
    speed = np.array([_number(data, "LinkSpeedRaw", least=1.0, most=MAX_CAPACITY * LEDGER_UNITS) for *_, data in edges])
    delay = drawn.delay
    if coordinates is not None:
        kilometres = great_circle_km(coordinates[ends[:, 0]], coordinates[ends[:, 1]])
        delay = np.maximum(kilometres / km_per_ms, LEAST_DELAY)
    capacity = np.where(np.isnan(speed), drawn.capacity, speed / LEDGER_UNITS)
    return merge_links(Links(ends, capacity, delay, drawn.unit_cost), source)


def great_circle_km(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Kilometres along the globe between points of latitude and longitude in degrees, float64 [..., 2] to [...]."""
    (lat, lon), (lat2, lon2) = np.radians(here).T, np.radians(there).T
    haversine = np.sin((lat2 - lat) / 2) ** 2 + np.cos(lat) * np.cos(lat2) * np.sin((lon2 - lon) / 2) ** 2
    return (2 * EARTH_RADIUS_KM * np.arcsin(np.sqrt(np.clip(haversine, 0, 1)))).T


def _number(data: dict[str, Any], key: str, *, least: float, most: float) -> float:
    """``data[key]``, or NaN if it is missing, no number or outside [least, most]."""
    try:
        value = float(data.get(key, math.nan))
    except (TypeError, ValueError):
        return math.nan
    return value if least <= value <= most else math.nan


# -------------------------------------------------------------------- coordinates


def _coordinates(graph: nx.MultiGraph, labels: tuple[str, ...], file: Path) -> np.ndarray | None:
    """Latitude and longitude float64 [N, 2], gaps filled from neighbours; None if the file has none at all."""
    known = np.array(
        [
            (_number(data, "Latitude", least=-90, most=90), _number(data, "Longitude", least=-180, most=180))
            for _, data in graph.nodes(data=True)
        ]
    )
    known[np.isnan(known).any(axis=1)] = np.nan
    missing = np.flatnonzero(np.isnan(known[:, 0]))
    if len(missing) == len(known):
        return None
    if len(missing):
        names = ", ".join(f"{node} ({labels[node]})" for node in missing)
        warnings.warn(f"{file}: no coordinates of nodes {names}; set to the mean of their neighbours'", stacklevel=3)
        _fill_from_neighbours(known, graph)
    return known


def _fill_from_neighbours(coordinates: np.ndarray, graph: nx.MultiGraph) -> None:
    """Fill NaN rows of ``coordinates`` in place, those next to known nodes first. The graph is connected."""
    while np.isnan(coordinates).any():
        found = {}
        for node in np.flatnonzero(np.isnan(coordinates[:, 0])).tolist():
            around = coordinates[sorted(graph.neighbors(node))]
            around = around[~np.isnan(around[:, 0])]
            if len(around):
                found[node] = _mean_place(around)
        for node, place in found.items():
            coordinates[node] = place


def _mean_place(places: np.ndarray) -> np.ndarray:
    """Middle of ``places`` float64 [n, 2] on the globe (also across the date line), float64 [2]."""
    lat, lon = np.radians(places).T
    x, y, z = (np.cos(lat) * np.cos(lon)).mean(), (np.cos(lat) * np.sin(lon)).mean(), np.sin(lat).mean()
    return np.degrees([math.atan2(z, math.hypot(x, y)), math.atan2(y, x)])
