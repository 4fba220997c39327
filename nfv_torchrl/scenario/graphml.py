"""GraphML read safely: no document types, no entities, no nesting, key defaults applied.

networkx reads GraphML too, but leaves key defaults out, adds nodes that a link misspells, drops parallel links that
share an id and expands entities.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.quoting import one_line

NAMESPACE = "http://graphml.graphdrawing.org/xmlns"
YED_LABEL = "http://www.yworks.com/xml/graphml NodeLabel"
MAX_DEPTH = 50
"""Elements within elements; a link's data is 4 deep, yEd's drawings some 10."""
MAX_ENTRIES = 1_500_000
"""Elements of a document; an element takes up to 1 kB."""


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
    root = _parse_xml(content, source)
    if root.tag != "graphml":
        raise _invalid(source, f"the outermost element is <{root.tag}> where <graphml> was expected")
    graphs = root.findall("graph")
    if len(graphs) != 1:
        raise _invalid(source, f"it holds {len(graphs)} graphs where one was expected")
    graph = graphs[0]
    for element in graph.iter():
        if element.tag in ("hyperedge", "port", "graph") and element is not graph:
            raise _invalid(source, f"line {_line(element)}: a <{element.tag}> inside a graph, which is not supported")
    keys = {_attribute(key, "id", source): _key(key, source) for key in root.findall("key")}
    nodes, edges = graph.findall("node"), graph.findall("edge")
    return ParsedGraphML(
        ids=[_attribute(node, "id", source) for node in nodes],
        nodes=[_data(node, keys, source) for node in nodes],
        ends=[(_attribute(edge, "source", source), _attribute(edge, "target", source)) for edge in edges],
        links=[_data(edge, keys, source) for edge in edges],
        directed=_directed(graph, edges, source),
    )


def _invalid(source: str, reason: str) -> ScenarioError:
    return ScenarioError(f"{source}: is not valid GraphML ({one_line(reason)}); repair or replace the file")


# -------------------------------------------------------------------- XML


def _parse_xml(content: bytes, source: str) -> Element:
    """The document's root; tags without the GraphML namespace, each element with its ``line``."""
    parser = expat.ParserCreate(namespace_separator=" ")
    builder = TreeBuilder()
    depth = entries = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, entries
        depth, entries = depth + 1, entries + 1
        if entries > MAX_ENTRIES:
            raise ScenarioError(f"{source}: has more than {MAX_ENTRIES:,} elements; networks this large are not read")
        if depth > MAX_DEPTH:
            raise _invalid(source, f"line {parser.CurrentLineNumber}: elements {depth} deep")
        builder.start(tag.removeprefix(f"{NAMESPACE} "), {**attributes, " line": str(parser.CurrentLineNumber)})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag.removeprefix(f"{NAMESPACE} "))

    def refuse_entity(name: str, *_: Any) -> None:
        raise _invalid(source, f"line {parser.CurrentLineNumber}: entity {name!r}, which is never expanded")

    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = refuse_entity
    parser.SkippedEntityHandler = refuse_entity
    try:
        parser.Parse(content, True)
        return builder.close()
    except ScenarioError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # the last two: an encoding that Python lacks
        raise _invalid(source, str(error)) from error


def _line(element: Element) -> str:
    return element.attrib[" line"]


# -------------------------------------------------------------------- keys and data


def _attribute(element: Element, name: str, source: str) -> str:
    try:
        return element.attrib[name]
    except KeyError:
        raise _invalid(source, f"line {_line(element)}: a <{element.tag}> without {name!r}") from None


def _key(element: Element, source: str) -> _Key:
    # yEd declares keys of drawings without a name.
    name = element.get("attr.name") or _attribute(element, "id", source)
    return _Key(name, element.get("for", "all"), _text(element.find("default")))


def _text(element: Element | None) -> str | None:
    """What an element says, blanks around it left out; None if it is missing or says nothing."""
    return None if element is None else "".join(element.itertext()).strip() or None


def _data(element: Element, keys: dict[str, _Key], source: str) -> dict[str, Any]:
    """Attributes of a node or edge: defaults of keys, then its own; empty ones are left out."""
    values = {key.name: key.default for key in keys.values() if key.owner in (element.tag, "all")}
    for data in element.findall("data"):
        name = _attribute(data, "key", source)
        if name not in keys:
            raise _invalid(source, f"line {_line(data)}: key {name!r} is not declared by any <key>")
        if len(data) == 0:
            values[keys[name].name] = _text(data)
            continue
        # A drawing of yEd, which is no value but may hold the label; networkx takes that, too.
        for drawn in data.iter(YED_LABEL):
            values.setdefault("label", _text(drawn))
    return {name: value for name, value in values.items() if value is not None}


def _directed(graph: Element, edges: list[Element], source: str) -> bool:
    """Whether the edges are arcs; all of them or none."""
    default = graph.get("edgedefault", "undirected") == "directed"
    directed = {edge.get("directed", str(default).lower()) == "true" for edge in edges} or {default}
    if len(directed) > 1:
        raise _invalid(source, "some edges are directed and others are not, which is not supported")
    return directed.pop()
