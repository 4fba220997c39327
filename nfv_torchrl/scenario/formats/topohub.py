"""Networks of TopoHub (github.com/piotrjurkiewicz/topohub): by their key, through its package, or from its files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.formats.demands import DemandMatrix, demand_matrix
from nfv_torchrl.scenario.formats.geodesy import great_circle_km
from nfv_torchrl.scenario.formats.graph import GraphFile
from nfv_torchrl.scenario.quoting import shown

PREFIX = "topohub:"
_KEY = re.compile(r"[\w-]+(?:/[\w-]+)+")


def topohub_file(key: str) -> Path:
    """The JSON file that TopoHub's package has for ``key``, such as ``sndlib/germany50``.

    Raises:
        ScenarioError: the package is not installed, or has no such network.
    """
    data = _folder(key)
    path = data / f"{key}.json"
    if not _KEY.fullmatch(key) or not path.is_file():
        groups = sorted(folder.name for folder in data.iterdir() if folder.is_dir())
        raise ScenarioError(
            f"substrate.path: TopoHub has no network {shown(key)}; keys are a group and a name, such as "
            f"sndlib/germany50 or gabriel/25/0, of the groups {', '.join(groups)}"
        )
    return path


def topohub_keys(group: str) -> list[str]:
    """The keys of all networks in a group of TopoHub, such as ``sndlib``, in order.

    Raises:
        ScenarioError: the package is not installed, or has no such group.
    """
    data = _folder(group)
    keys = sorted(str(path.relative_to(data).with_suffix("").as_posix()) for path in data.rglob("*.json"))
    found = [key for key in keys if key.startswith(f"{group}/")]
    if not found:
        groups = ", ".join(sorted({key.split("/")[0] for key in keys}))
        raise ScenarioError(f"{PREFIX}{group}: TopoHub has no such group; it has {groups}")
    return found


def _folder(key: str) -> Path:
    """The package's folder of JSON files."""
    try:
        return Path(str(resources.files("topohub") / "data"))
    except ModuleNotFoundError:
        raise ScenarioError(
            f"substrate.path: {PREFIX}{key} needs the package topohub; install it with pip install topohub, or give "
            "one of its JSON files by path"
        ) from None


def is_topohub(file: GraphFile) -> bool:
    """Whether ``file`` has the marks of TopoHub: places of nodes, ``dist`` of links."""
    placed = any("pos" in node or {"lat", "lon"} <= set(node) for node in file.nodes)
    return placed and any("dist" in link for link in file.links)


def read_places(file: GraphFile) -> list[dict[str, Any]]:
    """The nodes with ``pos``, which holds longitude and latitude, told apart as these.

    Of its random graphs ``pos`` are km in a plane. It is degrees where the great circles between the ends of links
    agree with ``dist`` better than straight lines do.
    """
    known = [_pair(node.get("pos")) for node in file.nodes]
    if not _are_degrees(file, known):
        return file.nodes
    return [
        node if place is None else {**_without(node, "pos"), "longitude": place[0], "latitude": place[1]}
        for node, place in zip(file.nodes, known, strict=True)
    ]


def _pair(value: Any) -> tuple[float, float] | None:
    numbers = isinstance(value, list | tuple) and len(value) == 2
    if not numbers or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in value):
        return None
    return float(value[0]), float(value[1])


def _are_degrees(file: GraphFile, places: list[tuple[float, float] | None]) -> bool:
    there = [place for place in places if place is not None]
    if not there or not all(abs(lon) <= 180 and abs(lat) <= 90 for lon, lat in there):
        return False
    rows = []
    for (u, v), link in zip(file.ends, file.links, strict=True):
        here, other, dist = places[u], places[v], link.get("dist")
        if here is not None and other is not None and isinstance(dist, int | float):
            rows.append([*here, *other, dist])
    if not rows:
        return True
    lon, lat, lon2, lat2, dist = np.array(rows, np.float64).T
    globe = great_circle_km(np.stack([lat, lon], axis=1), np.stack([lat2, lon2], axis=1))
    plane = np.hypot(lon2 - lon, lat2 - lat)
    return bool(np.median(np.abs(globe - dist)) <= np.median(np.abs(plane - dist)))


def read_graph_demands(file: GraphFile) -> DemandMatrix | None:
    """``demands`` of the graph, ``{source: {target: amount}}`` by ids, without a unit; None if there are none.

    Raises:
        ScenarioError: they are of another form, or name a node that is not there.
    """
    demands = file.attributes.get("demands")
    if not demands:
        return None
    rows = []
    for start, targets in demands.items() if isinstance(demands, Mapping) else ():
        for end, value in targets.items() if isinstance(targets, Mapping) else ():
            if isinstance(value, int | float) and not isinstance(value, bool):
                rows.append((str(start), str(end), float(value)))
    if not rows:
        raise ScenarioError(f"{file.source}: 'demands' of the graph is {shown(demands)}; remove or correct it")
    return demand_matrix(file.source, map(str, file.ids), rows)


def _without(node: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in node.items() if key != name}
