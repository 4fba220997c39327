"""Networks (``.graph``) and demands (``.demands``) of Repetita (github.com/svissicchio/Repetita).

The files name no units. Bandwidths are read as kbit/s: its networks from the Topology Zoo have 9,953,280 for an OC-192.
Delays are read as microseconds: those of its networks from the Topology Zoo are the distance of a link's ends over
twice the speed of light, so they are a third of what light in fibre needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from nfv_torchrl.files import decode
from nfv_torchrl.scenario.formats.demands import DemandMatrix, demand_matrix
from nfv_torchrl.scenario.formats.graph import GraphFile, assemble
from nfv_torchrl.scenario.formats.places import place_nodes
from nfv_torchrl.scenario.formats.xml import invalid
from nfv_torchrl.scenario.limits import MAX_NODES
from nfv_torchrl.scenario.quoting import shown

KIND = "Repetita"
NAMES = {"capacity": {"name": "bw", "unit": "kbit/s"}, "delay": {"name": "delay", "unit": "us"}}
NODE_COLUMNS = ["label", "x", "y"]
LINK_COLUMNS = ["label", "src", "dest", "weight", "bw", "delay"]
DEMAND_COLUMNS = ["label", "src", "dest", "bw"]


class _Lines:
    """The lines of a file that hold something."""

    def __init__(self, content: bytes, source: str) -> None:
        lines = enumerate(decode(content, source).splitlines(), 1)
        self._lines = ((number, line.split()) for number, line in lines if line.strip() and line.strip()[0] != "#")
        self._source = source

    def table(self, title: str, columns: list[str]) -> Iterator[tuple[int, list[str]]]:
        """Line number and fields of each row below ``TITLE count`` and a line of ``columns``."""
        number, words = self._next(title)
        if len(words) != 2 or words[0] != title or not words[1].isdecimal():
            raise self.error(number, words, f"{title} and a number")
        count = int(words[1])
        number, words = self._next(title)
        if words != columns:
            raise self.error(number, words, " ".join(columns))
        for _ in range(count):
            number, words = self._next(title)
            if len(words) != len(columns):
                raise self.error(number, words, f"{len(columns)} fields ({' '.join(columns)})")
            yield number, words

    def _next(self, title: str) -> tuple[int, list[str]]:
        try:
            return next(self._lines)
        except StopIteration:
            raise invalid(self._source, f"it ends before its {title} do", KIND) from None

    def end(self) -> None:
        """Refuse lines after the last table."""
        for number, words in self._lines:
            raise self.error(number, words, "the end")

    def number(self, line: int, word: str) -> float:
        """A number."""
        try:
            return float(word)
        except ValueError:
            raise self.error(line, [word], "a number") from None

    def error(self, line: int, words: list[str], expected: str) -> Exception:
        """What is wrong with a line."""
        return invalid(self._source, f"line {line}: {shown(' '.join(words))} where {expected} was expected", KIND)


def parse_graph(content: bytes, source: str) -> GraphFile:
    """The directed network of a ``.graph`` file; ids are the numbers 0 .. N-1 by which its edges name nodes.

    Raises:
        ScenarioError: not of that form; the message names the line.
    """
    lines = _Lines(content, source)
    labels, places = [], []
    for number, (label, x, y) in lines.table("NODES", NODE_COLUMNS):
        labels.append(label)
        places.append((lines.number(number, x), lines.number(number, y)))
    ends, links = [], []
    for number, (_, start, end, *values) in lines.table("EDGES", LINK_COLUMNS):
        ends.append((start, end))
        links.append({name: lines.number(number, word) for name, word in zip(LINK_COLUMNS[3:], values, strict=True)})
    lines.end()
    nodes, notes = place_nodes(places)
    labelled: list[dict[str, Any]] = [{"label": label, **node} for label, node in zip(labels, nodes, strict=True)]
    ids = [str(node) for node in range(len(labels))]
    notes.append("bw is taken for kbit/s and delay for us")
    return assemble(source, ids, labelled, ends, links, directed=True, names=NAMES, notes=tuple(notes))


def parse_demands(content: bytes, source: str) -> DemandMatrix:
    """The demands of a ``.demands`` file, between nodes called by their numbers.

    Raises:
        ScenarioError: not of that form; the message names the line.
    """
    lines = _Lines(content, source)
    rows = []
    for number, (_, start, end, value) in lines.table("DEMANDS", DEMAND_COLUMNS):
        if not (start.isdecimal() and end.isdecimal()):
            raise lines.error(number, [start, end], "the numbers of two nodes")
        rows.append((start, end, lines.number(number, value)))
    lines.end()
    last = max((int(end) for row in rows for end in row[:2]), default=-1)
    if last >= MAX_NODES:
        raise invalid(source, f"a demand names node {last:,}; networks have at most {MAX_NODES:,} nodes", KIND)
    return demand_matrix(source, map(str, range(last + 1)), rows, "kbit/s")
