"""What network files say, before anyone asks what it means; GML and node-link JSON are read here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import networkx as nx

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import decode, read_bytes, read_json
from nfv_torchrl.scenario.formats.graph import MAX_NETWORK_BYTES, GraphFile, assemble
from nfv_torchrl.scenario.formats.repetita import parse_graph
from nfv_torchrl.scenario.formats.sndlib import parse_native, parse_sndlib_xml
from nfv_torchrl.scenario.formats.xml import MAX_ENTRIES
from nfv_torchrl.scenario.graphml import parse_graphml
from nfv_torchrl.scenario.quoting import one_line, shown

SUFFIXES = (".json", ".graphml", ".gml", ".xml", ".txt", ".graph")
MAX_DEPTH = 50
"""Brackets within brackets of a GML file; files of the collection have 3."""


def read_graph_file(path: Path) -> GraphFile:
    """The graph of ``path``, by its suffix GraphML, GML, node-link JSON, of SNDlib (.xml, .txt) or Repetita (.graph).

    Raises:
        ScenarioError: the file cannot be read or parsed, two nodes share an id, or a link names a node that is not
            there; the message names the entry.
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_node_link(path)
    content = read_bytes(path, MAX_NETWORK_BYTES)
    if suffix == ".gml":
        return _parse_gml(content, str(path))
    if suffix in _OTHERS:
        return _OTHERS[suffix](content, str(path))
    parsed = parse_graphml(content, str(path))
    return assemble(str(path), parsed.ids, parsed.nodes, parsed.ends, parsed.links, directed=parsed.directed)


_OTHERS = {".xml": parse_sndlib_xml, ".txt": parse_native, ".graph": parse_graph}


# -------------------------------------------------------------------- GML

# Strings and comments, which stay as they are, before what is changed or counted outside them.
_GML_TOKEN = re.compile(
    r"""
    "[^"]*" | \#.*$
    | \b(?:key|multigraph)\s+(?:"[^"]*"|[^\s\[\]"]+)
    | (?<!\S)graph\s*\[
    | [\[\]]
    """,
    re.MULTILINE | re.VERBOSE,
)
# What networkx's parser raises on files that are not what they claim to be.
_GML_ERRORS = (nx.NetworkXException, ValueError, KeyError, TypeError, IndexError, AttributeError)


def _parse_gml(content: bytes, source: str) -> GraphFile:
    text = _as_multigraph(_gml_text(content, source), source)
    try:
        graph = nx.parse_gml(text.splitlines(), label="id")
    except _GML_ERRORS as error:
        raise ScenarioError(
            f"{source}: is not valid GML ({one_line(str(error))}); repair or replace the file"
        ) from error
    edges = list(graph.edges(data=True))
    return assemble(
        source,
        list(graph.nodes),
        [dict(data) for _, data in graph.nodes(data=True)],
        [(u, v) for u, v, _ in edges],
        [data for *_, data in edges],
        directed=graph.is_directed(),
        attributes=graph.graph,
    )


def _gml_text(content: bytes, source: str) -> str:
    """UTF-8, UTF-16 with a byte order mark, or what GML was defined with and the collection has: Latin-1."""
    try:
        return decode(content, source)
    except ScenarioError:
        text = content.decode("latin-1")
        if re.search(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]", text):
            raise ScenarioError(
                f"{source}: is not valid GML (text in neither UTF-8 nor Latin-1); convert it to UTF-8"
            ) from None
        return text


def _as_multigraph(gml: str, source: str) -> str:
    """A GML text that says it has parallel edges: many files have some and do not say so.

    The keys of edges go: networkx takes them for the identity of a parallel edge, files repeat them where they are not.
    Lines stay where they are. Deeply nested brackets are refused, since networkx's parser recurses.
    """
    depth, marked = 0, False
    if gml.count("[") > MAX_ENTRIES:
        raise ScenarioError(f"{source}: has more than {MAX_ENTRIES:,} brackets; networks this large are not read")

    def edit(match: re.Match[str]) -> str:
        nonlocal depth, marked
        token = match[0]
        depth += (token[-1] == "[") - (token == "]")
        if depth > MAX_DEPTH:
            raise ScenarioError(f"{source}: is not valid GML (brackets {depth} deep); repair or replace the file")
        if token.startswith(("key", "multigraph")):
            return "\n" * token.count("\n")
        if token.startswith("graph") and not marked:
            marked = True
            return token + " multigraph 1 "
        return token

    return _GML_TOKEN.sub(edit, gml)


# -------------------------------------------------------------------- JSON


def read_node_link(path: Path) -> GraphFile:
    """The graph of a file in networkx's ``node_link_data`` form, links under ``links`` or ``edges``.

    Raises:
        ScenarioError: as ``read_graph_file``.
    """
    data = read_json(path, MAX_NETWORK_BYTES)
    nodes = _entries(data, "nodes", path)
    if "links" in data and "edges" in data:
        raise ScenarioError(f"{path}: has both 'links' and 'edges'; keep one")
    key = "edges" if "edges" in data else "links"
    links = _entries(data, key, path)
    nodes = _with_ids(nodes, links)
    ids = [_id_of(node, "id", f"{path}: nodes[{place}]") for place, node in enumerate(nodes)]
    if set(ids) == set(range(len(ids))):  # in any order, they are the nodes' numbers
        nodes = [node for _, node in sorted(zip(ids, nodes, strict=True), key=lambda pair: pair[0])]
        ids.sort()
    ends = [
        (_id_of(link, "source", f"{path}: {key}[{place}]"), _id_of(link, "target", f"{path}: {key}[{place}]"))
        for place, link in enumerate(links)
    ]
    attributes = data.get("graph", {})
    if not isinstance(attributes, dict):
        raise ScenarioError(f"{path}: 'graph' is {shown(attributes)}; an object of attributes was expected")
    file = assemble(
        str(path),
        ids,
        [_without(node, "id") for node in nodes],
        ends,
        [_without(link, "source", "target", "key") for link in links],
        directed=_flag(data, "directed", path),
        attributes=attributes,
    )
    if "multigraph" in data and not _flag(data, "multigraph", path):
        _check_simple(file)
    return file


def _entries(data: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    entries = data.get(key)
    if not isinstance(entries, list):
        raise ScenarioError(f"{path}: needs the lists 'nodes' and 'links' of networkx's node_link_data form")
    for place, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ScenarioError(f"{path}: {key}[{place}] is {shown(entry)}; an object {{...}} was expected")
    return entries


def _with_ids(nodes: list[dict[str, Any]], links: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """``nodes`` with an ``id`` each, where none has one: D3's links call nodes by their place, or by their name."""
    if not links or any("id" in node for node in nodes):
        return nodes
    ends = [link.get(end) for link in links for end in ("source", "target")]
    if all(isinstance(end, int) and not isinstance(end, bool) for end in ends):
        return [{"id": place, **node} for place, node in enumerate(nodes)]
    return [{"id": node["name"], **node} if "name" in node else node for node in nodes]


def _id_of(entry: dict[str, Any], key: str, where: str) -> Any:
    """An id, a list in JSON being a tuple in networkx."""
    if key not in entry:
        raise ScenarioError(
            f"{where}: {key!r} is missing; each node needs an 'id', each link a 'source' and a 'target'"
        )
    name = _hashable(entry[key])
    if name is None:
        raise ScenarioError(f"{where}: {key!r} is {shown(entry[key])}; use text, a number or a list of these")
    return name


def _hashable(value: Any, depth: int = 0) -> Any:
    """``value`` as an id, None if it is none."""
    if isinstance(value, list) and depth < 3:
        parts = tuple(_hashable(part, depth + 1) for part in value)
        return None if None in parts else parts
    if isinstance(value, str) or (
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    ):
        return value
    return None


def _without(entry: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in keys}


def _flag(data: dict[str, Any], key: str, path: Path) -> bool:
    value = data.get(key, False)
    if not isinstance(value, bool):
        raise ScenarioError(f"{path}: {key!r} is {shown(value)}; use true or false")
    return value


def _check_simple(file: GraphFile) -> None:
    """Refuse parallel links in a file that says it has none; networkx would keep the last and forget the others."""
    seen = set()
    for link, (u, v) in enumerate(file.ends):
        pair = (u, v) if file.directed or u <= v else (v, u)
        if pair in seen:
            raise ScenarioError(
                f"{file.source}: {file.link_name(link)} is there twice though 'multigraph' is false; remove one, or "
                "set 'multigraph' to true to merge them (capacities add)"
            )
        seen.add(pair)
