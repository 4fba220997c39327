"""XML read safely: no entities, bounded depth and size, elements that know their line."""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.quoting import one_line

MAX_DEPTH = 50
"""Elements within elements; a link's data is 4 deep, yEd's drawings some 10."""
MAX_ENTRIES = 1_500_000
"""Elements of a document; an element takes up to 1 kB."""


def invalid(source: str, reason: str, kind: str = "GraphML") -> ScenarioError:
    """The error of a file that is not what its suffix says."""
    return ScenarioError(f"{source}: is not valid {kind} ({one_line(reason)}); repair or replace the file")


def line_of(element: Element) -> str:
    """The line on which ``element`` begins."""
    return element.attrib[" line"]


def parse_xml(content: bytes, source: str, namespace: str, kind: str = "GraphML") -> Element:
    """The root of a document of format ``kind``; tags without ``namespace``, each element with its line.

    Raises:
        ScenarioError: no well-formed XML, an entity, or a document too deep or too large.
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    builder = TreeBuilder()
    depth = entries = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, entries
        depth, entries = depth + 1, entries + 1
        if entries > MAX_ENTRIES:
            raise ScenarioError(f"{source}: has more than {MAX_ENTRIES:,} elements; networks this large are not read")
        if depth > MAX_DEPTH:
            raise invalid(source, f"line {parser.CurrentLineNumber}: elements {depth} deep", kind)
        builder.start(tag.removeprefix(f"{namespace} "), {**attributes, " line": str(parser.CurrentLineNumber)})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag.removeprefix(f"{namespace} "))

    def refuse_entity(name: str, *_: Any) -> None:
        raise invalid(source, f"line {parser.CurrentLineNumber}: entity {name!r}, which is never expanded", kind)

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
        raise invalid(source, str(error), kind) from error
