"""Virne's folders of requests (github.com/GeminiLight/virne): ``v_nets/*.gml`` and ``events.yaml``.

Each GML file is one virtual network: nodes with what they take of each kind of resource, links with ``bw``, an
``arrival_time`` and a ``lifetime``. ``events.yaml`` lists when each comes and goes. Times have no unit; they are read
as seconds, bandwidths as Mbit/s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_text
from nfv_torchrl.scenario.formats.graph import GraphFile
from nfv_torchrl.scenario.formats.requests import Asked, RequestSet
from nfv_torchrl.scenario.graph_files import read_graph_file
from nfv_torchrl.scenario.quoting import one_line, shown

FOLDER, EVENTS = "v_nets", "events.yaml"
ARRIVES, LEAVES = 1, 0
"""``type`` of an event."""
RATE = "bw"
SAME_TIME = 1e-6
"""Relative difference of a departure that is the same: arrival and lifetime were added by others."""
BOOKKEEPING = {"label", "id"}


def read_virne(folder: Path, kinds: Sequence[str]) -> RequestSet:
    """The requests of a folder that has ``v_nets/`` (and ``events.yaml``), or of that ``v_nets`` itself.

    Args:
        folder: the folder.
        kinds: names of the resources that nodes take; each node has a number under each name.

    Raises:
        ScenarioError: no such files; a virtual network that is not a chain, which is named; a number that is missing or
            out of range; events that do not go with the networks.
    """
    networks = folder / FOLDER if (folder / FOLDER).is_dir() else folder
    paths = sorted(networks.glob("*.gml"))
    if not paths:
        raise ScenarioError(
            f"{folder}: holds no requests; give a folder of Virne's with {FOLDER}/*.gml, a CSV or a JSON file"
        )
    unused: set[str] = set()
    numbered = [_read_network(path, kinds, unused) for path in paths]
    events = next((path for path in (folder / EVENTS, networks.parent / EVENTS) if path.is_file()), None)
    if events is not None:
        _check_events(events, dict(numbered))
    # Of requests that come at the same time, the one with the smaller number is answered first, as Virne does.
    requests = [asked for _, asked in sorted(numbered, key=lambda pair: (pair[1].time, pair[0]))]
    return RequestSet(str(folder), requests, tuple(sorted(unused)))


def _read_network(path: Path, kinds: Sequence[str], unused: set[str]) -> tuple[int, Asked]:
    """Number and content of one virtual network; numbers that go unused are added to ``unused``."""
    file = read_graph_file(path)
    order, links = _chain(file)
    amounts = {
        kind: tuple(_number(file, file.nodes[node], kind, file.node_name(node)) for node in order) for kind in kinds
    }
    rates = [_number(file, file.links[link], RATE, file.link_name(link)) for link in links]
    unused |= {f"{key} (nodes)" for node in file.nodes for key in node.keys() - BOOKKEEPING - {*kinds}}
    unused |= {f"{key} (links)" for link in file.links for key in link.keys() - BOOKKEEPING - {RATE}}
    number = file.attributes.get("id")
    if isinstance(number, bool) or not isinstance(number, int):
        raise ScenarioError(f"{path}: the graph's id is {shown(number)}; an integer was expected")
    time, lifetime = (_number(file, file.attributes, key, "the graph") for key in ("arrival_time", "lifetime"))
    if lifetime <= 0:
        raise ScenarioError(f"{path}: its lifetime is {lifetime:g}; use a positive number")
    nothing = (0.0,) * len(order)
    return number, Asked(str(path), time, lifetime, amounts, (0.0, *rates, 0.0), None, nothing)


def _chain(file: GraphFile) -> tuple[list[int], list[int]]:
    """Nodes and links of a chain in order, from the end that the file has first.

    Raises:
        ScenarioError: the network is no chain.
    """
    around: list[list[tuple[int, int]]] = [[] for _ in file.ids]
    for link, (u, v) in enumerate(file.ends):
        around[u].append((v, link))
        around[v].append((u, link))
    why = "only chains are read: every function but the first and the last has two links, and there is no other part"
    for node, links in enumerate(around):
        if len(links) > 2:
            raise ScenarioError(f"{file.source}: is no chain, {file.node_name(node)} has {len(links)} links; {why}")
    ends = [node for node, links in enumerate(around) if len(links) < 2]
    if not ends:
        raise ScenarioError(f"{file.source}: is no chain, it has no end; {why}")
    order, taken = [ends[0]], list[int]()
    while following := [(node, link) for node, link in around[order[-1]] if link not in taken[-1:]]:
        order.append(following[0][0])
        taken.append(following[0][1])
    if len(order) < len(file.ids):
        raise ScenarioError(f"{file.source}: is no chain, it has {len(file.ids)} nodes in several parts; {why}")
    return order, taken


def _number(file: GraphFile, data: dict[str, Any], key: str, owner: str) -> float:
    """``data[key]``, a number of at least 0."""
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScenarioError(f"{file.source}: {owner} has {key} {shown(value)}; a number was expected")
    if not 0 <= value < math.inf:
        raise ScenarioError(f"{file.source}: {owner} has {key} {value:g}; use a finite number of at least 0")
    return float(value)


def _check_events(path: Path, requests: dict[int, Asked]) -> None:
    """Refuse ``events.yaml`` whose arrivals and departures are not those of the virtual networks."""
    times: dict[tuple[Any, Any], Any] = {}
    for place, event in enumerate(_parse_events(path)):
        if not isinstance(event, dict) or not {"v_net_id", "type", "time"} <= event.keys():
            raise ScenarioError(f"{path}: event {place} is {shown(event)}; v_net_id, type and time are needed")
        times[event["v_net_id"], event["type"]] = event["time"]
    for number, asked in requests.items():
        for kind, word, due in ((ARRIVES, "arrives", asked.time), (LEAVES, "leaves", asked.time + asked.lifetime)):
            time = times.pop((number, kind), None)
            if not isinstance(time, int | float) or not math.isclose(time, due, rel_tol=SAME_TIME):
                raise ScenarioError(
                    f"{path}: virtual network {number} {word} at {shown(time)}, by {asked.name} at {due!r}; give the "
                    "two of one set"
                )
    if times:
        raise ScenarioError(f"{path}: names virtual network {shown(next(iter(times))[0])}, which has no file here")


def _parse_events(path: Path) -> list[Any]:
    try:
        events = yaml.load(read_text(path), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{path}: is not valid YAML ({one_line(str(error))}); repair or remove it") from error
    if not isinstance(events, list):
        raise ScenarioError(f"{path}: holds a {type(events).__name__}; a list of events was expected")
    return events
