"""Networks from files of many formats, and a dozen of the Internet Topology Zoo that ship here."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.attributes import DRAWN, FileNumbers, read_numbers, some
from nfv_torchrl.scenario.config import SubstrateConfig
from nfv_torchrl.scenario.file_vms import file_vms
from nfv_torchrl.scenario.formats.dialects import translate
from nfv_torchrl.scenario.formats.geodesy import great_circle_km
from nfv_torchrl.scenario.formats.graph import GraphFile
from nfv_torchrl.scenario.formats.topohub import PREFIX, topohub_file
from nfv_torchrl.scenario.graph_files import SUFFIXES, read_graph_file
from nfv_torchrl.scenario.links import DIRECTED, Links, has_way_back, merge_links, pair_arcs
from nfv_torchrl.scenario.quantities import parse_mapping
from nfv_torchrl.scenario.resources import ResourceRanges, draw_links
from nfv_torchrl.scenario.substrate import Substrate, back_capacities, label_of

TOPOLOGIES = Path(__file__).parent / "topologies"
LEAST_DELAY = 0.01
"""ms; floor of a link's delay, for nodes at one place (2 km of fibre)."""

LINK_NUMBERS = ("capacity", "delay", "unit_cost")


def shipped_topologies() -> list[str]:
    """Names that ``read_network`` takes besides paths: those of the files in this package, in lower case."""
    return sorted(path.stem.lower() for path in TOPOLOGIES.glob("*.graphml"))


class NetworkFile(NamedTuple):
    """A network from a file, and what the file said: numbers by quantity, NaN where it had none, and its demands."""

    substrate: Substrate
    numbers: FileNumbers


def read_topology(path: str | os.PathLike[str], seed: int, **options: Any) -> Substrate:
    """The network that ``read_network`` reads, whose ``options`` these are."""
    return read_network(path, seed, **options).substrate


def read_network(
    path: str | os.PathLike[str],
    seed: int,
    *,
    fibre_km_per_ms: float = SubstrateConfig.fibre_km_per_ms,
    detour: float = SubstrateConfig.detour,
    largest_component: bool = False,
    directed: str = "pairs",
    attributes: Mapping[str, Any] | None = None,
    **ranges: Any,
) -> NetworkFile:
    """The network of a file, of TopoHub's package, or of a topology that ships here.

    A file is GraphML (``.graphml``), GML (``.gml``), node-link JSON (``.json``), of SNDlib (``.txt``, ``.xml``) or of
    Repetita (``.graph``).

    The file's numbers are kept, see ``docs/data.md`` for their names and units; what it lacks is drawn. A link without
    a delay whose file has coordinates gets that of the great circle between its ends times ``detour`` over
    ``fibre_km_per_ms``, at least 0.01 ms. Parallel links are merged: capacities add, the smallest delay and unit cost
    stay. Links from a node to itself are dropped. Nodes without coordinates get the mean of their neighbours'. Equal
    labels are told apart by a number, as ``Oslo (2)``. What is dropped, filled in, or drawn for some links only, and
    numbers of the file that are not used, are named by a ``ScenarioWarning``.

    Args:
        path: file, one of ``shipped_topologies`` (in any case), or a key of TopoHub, as ``topohub:sndlib/germany50``.
        seed: scenario seed, for what is drawn.
        fibre_km_per_ms: speed of light in fibre.
        detour: length of a fibre over the great circle's.
        largest_component: keep only the largest connected component (of several the first) of a disconnected file.
        directed: how arcs of a directed file become links, see ``pair_arcs``.
        attributes: by quantity, the file's name of it, or ``{name: NAME, unit: UNIT}``.
        ranges: any field of ``ResourceRanges``.

    Raises:
        ScenarioError: the file is missing, cannot be parsed, holds a number out of range, is disconnected or has no
            links; or an argument is out of range.
    """
    for name, value in (("fibre_km_per_ms", fibre_km_per_ms), ("detour", detour)):
        if not (math.isfinite(value) and value > 0):
            raise ScenarioError(f"{name}: {value}; use a positive number")
    if directed not in DIRECTED:
        raise ScenarioError(f"substrate.directed: {directed!r} is unknown; use one of {', '.join(DIRECTED)}")
    drawn_from = ResourceRanges(**ranges)
    parse_mapping(attributes or {}, fibre_km_per_ms)  # before a file is read
    file = read_network_file(path, attributes or {})
    path = find_network(path)
    sources = parse_mapping({**file.names, **(attributes or {})}, fibre_km_per_ms, detour)
    numbers = read_numbers(file, sources, fibre_km_per_ms)
    graph = _connected(_graph(file, numbers, directed), path, largest_component)
    kept = [data["place"] for _, data in graph.nodes(data=True)]
    labels = _distinct(label_of(file.nodes[place], file.ids[place]) for place in kept)
    coordinates = _coordinates(graph, numbers, kept, labels)
    links = _links(graph, coordinates, drawn_from, seed, km_per_ms=fibre_km_per_ms / detour, source=file.source)
    vms = file_vms(numbers, kept, drawn_from, seed)
    node_of = {place: node for node, place in enumerate(kept)}
    arcs = [(node_of[u], node_of[v], data) for (u, v), data in zip(file.ends, file.links, strict=True) if u in node_of]
    back = None if file.directed else back_capacities(arcs, links.ends, file.source)
    numbers.used["link"].update([] if back is None else ["back_capacity"])
    numbers.warn({"delay": DRAWN if coordinates is None else "from the coordinates of its ends"})
    substrate = Substrate(
        name=_name(file, path),
        labels=labels,
        **vms._asdict(),
        links=links.ends,
        link_capacity=links.capacity,
        link_delay=links.delay,
        link_unit_cost=links.unit_cost,
        coordinates=coordinates,
        back_capacity=back,
        ids=tuple(str(file.ids[place]) for place in kept),
    )
    return NetworkFile(substrate, numbers)


# -------------------------------------------------------------------- files


def read_network_file(path: str | os.PathLike[str], mapped: Collection[str] = ()) -> GraphFile:
    """What a file says, with its project's names and its demands; nothing is drawn and no number read yet.

    Args:
        path: as ``read_network``.
        mapped: quantities of which the user says where to read them.

    Raises:
        ScenarioError: the file is missing or cannot be parsed.
    """
    file = translate(read_graph_file(find_network(path)), mapped)
    return dataclasses.replace(file, source=str(path)) if str(path).startswith(PREFIX) else file


def find_network(path: str | os.PathLike[str]) -> Path:
    """The file of ``path``, be it a path, a key of TopoHub or a shipped name."""
    if str(path).startswith(PREFIX):
        return topohub_file(str(path).removeprefix(PREFIX))
    shipped = {file.stem.lower(): file for file in TOPOLOGIES.glob("*.graphml")}
    if str(path).lower() in shipped:
        return shipped[str(path).lower()]
    if Path(path).suffix.lower() not in SUFFIXES:
        raise ScenarioError(
            f"substrate.path: {str(path)!r} is neither a file ending in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, "
            f"nor {PREFIX} and a key, nor a topology that ships here; those are {', '.join(sorted(shipped))}"
        )
    return Path(path)


def _graph(file: GraphFile, numbers: FileNumbers, directed: str) -> nx.MultiGraph:
    """The undirected graph of nodes 0 .. N-1; ``place`` of a node is its place in the file, edges have ``numbers``."""
    links = Links(np.array(file.ends, np.int64).reshape(-1, 2), *(numbers.values[key] for key in LINK_NUMBERS))
    if file.directed and not has_way_back(links.ends):
        numbers.say("is directed, but no arc has one back: each is taken for a link that serves both directions")
    elif file.directed:
        links = pair_arcs(links, directed, file.source, file.link_name)
    graph = nx.MultiGraph()
    graph.add_nodes_from((place, {"place": place}) for place in range(len(file.ids)))
    rows = np.stack(links[1:], axis=1)
    graph.add_edges_from((u, v, {"numbers": row}) for (u, v), row in zip(links.ends.tolist(), rows, strict=True))
    return graph


def _name(file: GraphFile, path: Path) -> str:
    """The name that a JSON file gives its network, or the file's."""
    name = file.attributes.get("name") if path.suffix.lower() == ".json" else None
    return str(name or path.stem)


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
    """The graph's links, parallel ones merged, with numbers for those that the file lacks."""
    edges = list(graph.edges(data="numbers"))
    ends = np.array([edge[:2] for edge in edges], np.int64).reshape(-1, 2)
    capacity, delay, unit_cost = np.array([numbers for *_, numbers in edges], np.float64).reshape(-1, 3).T
    drawn = draw_links(len(edges), seed, drawn_from)
    other_delay = drawn.delay
    if coordinates is not None:
        kilometres = great_circle_km(coordinates[ends[:, 0]], coordinates[ends[:, 1]])
        other_delay = np.maximum(kilometres / km_per_ms, LEAST_DELAY)
    known = Links(
        ends,
        np.where(np.isnan(capacity), drawn.capacity, capacity),
        np.where(np.isnan(delay), other_delay, delay),
        np.where(np.isnan(unit_cost), drawn.unit_cost, unit_cost),
    )
    return merge_links(known, source)


# -------------------------------------------------------------------- coordinates


def _coordinates(
    graph: nx.MultiGraph, numbers: FileNumbers, kept: list[int], labels: tuple[str, ...]
) -> np.ndarray | None:
    """Latitude and longitude float64 [N, 2], gaps filled from neighbours; None if the file has none at all."""
    known = np.stack([numbers.values["latitude"], numbers.values["longitude"]], axis=1)[kept]
    known[np.isnan(known).any(axis=1)] = np.nan
    missing = np.flatnonzero(np.isnan(known[:, 0]))
    if len(missing) == len(known):
        return None
    if len(missing):
        names = some([f"{node} ({labels[node]})" for node in missing])
        numbers.say(f"no coordinates of nodes {names}; set to the mean of their neighbours'")
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
