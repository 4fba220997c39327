"""Networks and demand matrices of SNDlib (sndlib.zib.de), in its native text form and in XML.

A link's capacity is what is installed. Where that is nothing, as in files for network design, it is the largest module
that may be installed. What a link costs is kept under its name, for ``substrate.attributes`` to map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

from nfv_torchrl.files import decode
from nfv_torchrl.scenario.formats.demands import demand_matrix
from nfv_torchrl.scenario.formats.graph import GraphFile, assemble
from nfv_torchrl.scenario.formats.places import place_nodes
from nfv_torchrl.scenario.formats.xml import invalid, line_of, parse_xml
from nfv_torchrl.scenario.quoting import shown

HEADER = "?SNDlib native format"
NAMESPACE = "http://sndlib.zib.de/network"
UNITS = {"BITPERSEC": "bit/s", "KBITPERSEC": "kbit/s", "MBITPERSEC": "Mbit/s", "GBITPERSEC": "Gbit/s"}
SECTIONS = ("META", "NODES", "LINKS", "DEMANDS", "ADMISSIBLE_PATHS")


@dataclass
class _Parts:
    """A network as both forms have it."""

    ids: list[str] = field(default_factory=list)
    places: list[tuple[float, float] | None] = field(default_factory=list)
    geographical: bool | None = None
    ends: list[tuple[str, str]] = field(default_factory=list)
    links: list[dict[str, Any]] = field(default_factory=list)
    modules: int = 0
    demands: list[tuple[str, str, float]] = field(default_factory=list)
    meta: dict[str, str] = field(default_factory=dict)

    def add_link(self, ends: tuple[str, str], installed: Any, modules: list[tuple[float, float]], **costs: Any) -> None:
        """A link of capacity ``installed`` that may get one of ``modules``, each capacity and cost."""
        data = {name: cost for name, cost in costs.items() if cost is not None}
        if modules:
            data["module_capacity"], data["module_cost"] = map(list, zip(*modules, strict=True))
        # None: the file does not say. UNLIMITED is no number to divide by, either.
        if installed and math.isfinite(installed):
            data["capacity"] = installed
        elif installed is not None and not installed and modules and (largest := max(modules)[0]) > 0:
            data["capacity"] = largest
            self.modules += 1
        self.ends.append(ends)
        self.links.append(data)


def parse_native(content: bytes, source: str) -> GraphFile:
    """The network of a file in SNDlib's native text form; it may have no links, as demand matrices do.

    Raises:
        ScenarioError: not of that form; the message names the line.
    """
    parts = _Parts()
    read = {"NODES": _native_node, "LINKS": _native_link, "DEMANDS": _native_demand}
    for section, line, words in _entries(decode(content, source), source):
        if section == "META":
            name, _, value = " ".join(words).partition("=")
            parts.meta[name.strip()] = value.strip()
        elif section in read:
            try:
                read[section](parts, words)
            except (ValueError, IndexError) as error:
                raise invalid(source, f"line {line}: {' '.join(words)!r} is no entry of {section}", "SNDlib") from error
    return _graph(parts, source)


def _entries(text: str, source: str) -> Iterable[tuple[str, int, list[str]]]:
    """Section, line number and words of each entry; brackets are words."""
    lines = text.lstrip("\ufeff").splitlines()
    if not lines or not lines[0].startswith(HEADER) or "type: network" not in lines[0]:
        raise invalid(source, f"the first line does not begin with '{HEADER}; type: network'", "SNDlib")
    section, depth = "", 0
    for number, line in enumerate(lines[1:], 2):
        words = line.partition("#")[0].replace("(", " ( ").replace(")", " ) ").split()
        if not words:
            continue
        if not section:
            section = words[0]
            if section not in SECTIONS or words[1:2] != ["("]:
                raise invalid(source, f"line {number}: {shown(line)} where a section was expected", "SNDlib")
            words, depth = words[2:], 1
        if section == "META" and words != [")"]:
            yield section, number, words  # free text, whose brackets do not count
            continue
        depth += words.count("(") - words.count(")")
        if depth <= 0:
            section = ""
        elif words:
            yield section, number, words
    if section:
        raise invalid(source, f"the section {section} does not end", "SNDlib")


def _native_node(parts: _Parts, words: list[str]) -> None:
    parts.ids.append(words[0])
    parts.places.append((float(words[2]), float(words[3])) if len(words) == 5 else None)


def _native_link(parts: _Parts, words: list[str]) -> None:
    _, left, source, target, right, installed, cost, routing, setup, *rest = words
    if (left, right) != ("(", ")") or rest[:1] + rest[-1:] != ["(", ")"]:
        raise ValueError
    modules = [_number(word) for word in rest[1:-1]]
    pairs = list(zip(modules[::2], modules[1::2], strict=True))
    costs = {"pre_installed_cost": _number(cost), "routing_cost": _number(routing), "setup_cost": _number(setup)}
    parts.add_link((source, target), _number(installed), pairs, **costs)


def _native_demand(parts: _Parts, words: list[str]) -> None:
    _, left, source, target, right, routing_unit, value, *_ = words
    if (left, right) != ("(", ")"):
        raise ValueError
    parts.demands.append((source, target, float(routing_unit) * float(value)))


def _number(word: str) -> float:
    """A number; UNLIMITED is infinite."""
    return math.inf if word == "UNLIMITED" else float(word)


# -------------------------------------------------------------------- XML


def parse_sndlib_xml(content: bytes, source: str) -> GraphFile:
    """The network of a file in SNDlib's XML form; it may have no links, as demand matrices do.

    Raises:
        ScenarioError: not of that form; the message names the line.
    """
    root = parse_xml(content, source, NAMESPACE, "SNDlib XML")
    structure = root.find("networkStructure")
    if root.tag != "network" or structure is None:
        raise invalid(source, f"<{root.tag}> where <network> with a <networkStructure> was expected", "SNDlib XML")
    parts = _Parts(meta={element.tag: (element.text or "").strip() for element in root.iterfind("meta/*")})
    nodes = structure.find("nodes")
    if nodes is not None and "coordinatesType" in nodes.attrib:
        parts.geographical = nodes.attrib["coordinatesType"] == "geographical"
    for node in structure.iterfind("nodes/node"):
        parts.ids.append(_id(node, source))
        x, y = (_value(node, f"coordinates/{axis}", source) for axis in "xy")
        parts.places.append(None if x is None or y is None else (x, y))
    for link in structure.iterfind("links/link"):
        _xml_link(parts, link, source)
    for demand in root.iterfind("demands/demand"):
        value, routing_unit = (_value(demand, name, source) for name in ("demandValue", "routingUnit"))
        if value is None:
            raise invalid(source, f"line {line_of(demand)}: a demand without a demandValue", "SNDlib XML")
        parts.demands.append((*_ends(demand, source), value * (1.0 if routing_unit is None else routing_unit)))
    return _graph(parts, source)


def _xml_link(parts: _Parts, link: Element, source: str) -> None:
    installed = _value(link, "preInstalledModule/capacity", source)
    modules = [
        (_value(module, "capacity", source) or 0.0, _value(module, "cost", source) or 0.0)
        for module in link.iterfind("additionalModules/addModule")
    ]
    costs = {
        "pre_installed_cost": _value(link, "preInstalledModule/cost", source),
        "routing_cost": _value(link, "routingCost", source),
        "setup_cost": _value(link, "setupCost", source),
    }
    parts.add_link(_ends(link, source), 0.0 if installed is None and modules else installed, modules, **costs)


def _id(element: Element, source: str) -> str:
    if "id" not in element.attrib:
        raise invalid(source, f"line {line_of(element)}: a <{element.tag}> without 'id'", "SNDlib XML")
    return element.attrib["id"]


def _ends(element: Element, source: str) -> tuple[str, str]:
    ends = [(element.findtext(name) or "").strip() for name in ("source", "target")]
    if not all(ends):
        line = line_of(element)
        raise invalid(source, f"line {line}: a <{element.tag}> without a source or a target", "SNDlib XML")
    return ends[0], ends[1]


def _value(element: Element, path: str, source: str) -> float | None:
    """The number that ``path`` below ``element`` holds, None if it is not there."""
    text = (element.findtext(path) or "").strip()
    try:
        return _number(text) if text else None
    except ValueError:
        line = line_of(element)
        raise invalid(
            source, f"line {line}: {path} is {shown(text)} where a number was expected", "SNDlib XML"
        ) from None


# -------------------------------------------------------------------- both


def _graph(parts: _Parts, source: str) -> GraphFile:
    said = parts.meta.get("unit", "")
    unit = UNITS.get(said.upper(), said)
    notes = []
    if parts.modules:
        notes.append(f"{parts.modules} links have nothing installed: their largest module is taken for the capacity")
    if any("capacity" in link for link in parts.links) and unit not in UNITS.values():
        notes.append(
            "capacities are taken for Mbit/s, " + (f"since {shown(said)} is no known unit" if said else "none said")
        )
    nodes, place_notes = place_nodes(parts.places, parts.geographical)
    names = {"capacity": {"name": "capacity", "unit": unit}} if unit in UNITS.values() else {}
    demands = demand_matrix(source, parts.ids, parts.demands, unit, parts.meta.get("time", ""))
    return assemble(
        source,
        parts.ids,
        nodes,
        parts.ends,
        parts.links,
        # The form does not say what its links are: those of both directions of a pair are arcs.
        directed=not {(v, u) for u, v in parts.ends if u != v}.isdisjoint(parts.ends),
        attributes=dict(parts.meta),
        names=names,
        notes=(*notes, *place_notes),
        demands=demands if len(demands) else None,
    )


def is_native(content: bytes) -> bool:
    """Whether ``content`` begins as SNDlib's native files do."""
    return content[:40].lstrip(b"\xef\xbb\xbf").startswith(HEADER.encode())
