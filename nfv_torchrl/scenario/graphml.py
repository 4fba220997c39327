"""GraphML read safely: no document types, no entities, no nesting, key defaults applied.

networkx reads GraphML too, but leaves key defaults out, adds nodes that a link misspells, drops parallel links that
share an id and expands entities.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

from nfv_torchrl.scenario.formats.xml import invalid, line_of, parse_xml

NAMESPACE = "http://graphml.graphdrawing.org/xmlns"
YED_LABEL = "http://www.yworks.com/xml/graphml NodeLabel"


class ParsedGraphML(NamedTuple):
    """Nodes and links in the file's order; attribute values are text."""

    ids: list[str]
    nodes: list[dict[str, Any]]
    ends: list[tuple[str, str]]
    links: list[dict[str, Any]]
    directed: bool


class _Key(NamedTuple):
    """A ``<key>``: the name of an attribute, what has it (``node``, ``edge``, ``all``), its default."""

    name: str
    owner: str
    default: str | None


def parse_graphml(content: bytes, source: str) -> ParsedGraphML:
    """The graph of a GraphML document, which may leave the namespace out.

    Raises:
        ScenarioError: no such document; hyperedges, ports, nested graphs or several graphs.
    """
    root = parse_xml(content, source, NAMESPACE)
    if root.tag != "graphml":
        raise invalid(source, f"the outermost element is <{root.tag}> where <graphml> was expected")
    graphs = root.findall("graph")
    if len(graphs) != 1:
        raise invalid(source, f"it holds {len(graphs)} graphs where one was expected")
    graph = graphs[0]
    for element in graph.iter():
        if element.tag in ("hyperedge", "port", "graph") and element is not graph:
            raise invalid(source, f"line {line_of(element)}: a <{element.tag}> inside a graph, which is not supported")
    keys = {_attribute(key, "id", source): _key(key, source) for key in root.findall("key")}
    nodes, edges = graph.findall("node"), graph.findall("edge")
    return ParsedGraphML(
        ids=[_attribute(node, "id", source) for node in nodes],
        nodes=[_data(node, keys, source) for node in nodes],
        ends=[(_attribute(edge, "source", source), _attribute(edge, "target", source)) for edge in edges],
        links=[_data(edge, keys, source) for edge in edges],
        directed=_directed(graph, edges, source),
    )


# -------------------------------------------------------------------- keys and data


def _attribute(element: Element, name: str, source: str) -> str:
    try:
        return element.attrib[name]
    except KeyError:
        raise invalid(source, f"line {line_of(element)}: a <{element.tag}> without {name!r}") from None


def _key(element: Element, source: str) -> _Key:
    # yEd declares keys of drawings without a name.
    name = element.get("attr.name") or element.get("yfiles.type") or _attribute(element, "id", source)
    return _Key(name, element.get("for", "all"), _text(element.find("default")))


def _text(element: Element | None) -> str | None:
    """What an element says, blanks around it left out; None if it is missing or says nothing."""
    return None if element is None else "".join(element.itertext()).strip() or None


def _data(element: Element, keys: dict[str, _Key], source: str) -> dict[str, Any]:
    """Attributes of a node or edge: defaults of keys, then its own; empty ones are left out."""
    values: dict[str, Any] = {key.name: key.default for key in keys.values() if key.owner in (element.tag, "all")}
    for data in element.findall("data"):
        name = _attribute(data, "key", source)
        if name not in keys:
            raise invalid(source, f"line {line_of(data)}: key {name!r} is not declared by any <key>")
        if len(data) == 0:
            values[keys[name].name] = _text(data)
            continue
        # A drawing of yEd, which is no value but may hold the label; networkx takes that, too.
        for drawn in data.iter(YED_LABEL):
            values.setdefault("label", _text(drawn))
        values[keys[name].name] = _numbers_in(data)
    return {name: value for name, value in values.items() if value is not None}


def _numbers_in(data: Element) -> dict[str, str] | None:
    """Attributes of the elements in ``data``, so that a warning can name a drawing whose numbers go unused."""
    found = {name: value for part in data.iter() if part is not data for name, value in part.attrib.items()}
    return {name: value for name, value in found.items() if name != " line"} or None


def _directed(graph: Element, edges: list[Element], source: str) -> bool:
    """Whether the edges are arcs; all of them or none."""
    default = graph.get("edgedefault", "undirected") == "directed"
    directed = {edge.get("directed", str(default).lower()) == "true" for edge in edges} or {default}
    if len(directed) > 1:
        raise invalid(source, "some edges are directed and others are not, which is not supported")
    return directed.pop()
