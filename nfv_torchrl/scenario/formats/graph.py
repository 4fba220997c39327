"""A graph as a file of any format has it: nodes, links, attributes, before anyone asks what they mean."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import networkx as nx

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.formats.demands import DemandMatrix
from nfv_torchrl.scenario.limits import MAX_NODES
from nfv_torchrl.scenario.quoting import shown

MAX_NETWORK_BYTES = 64 * 10**6
"""Largest network file that is read; parsed it takes at most some 2 GB."""
MAX_LINKS = 200_000


@dataclass(frozen=True)
class GraphFile:
    """A graph as its file has it; nodes are numbered in the file's order.

    Attributes:
        source: the file, for messages.
        ids: what the file calls its nodes: text, numbers or tuples of them.
        nodes: attributes of each node.
        ends: source and target of each link.
        links: attributes of each link.
        directed: links are arcs from source to target.
        attributes: those of the graph.
        names: by quantity, which attribute holds it and in which unit, where the file's format says so; as
            ``substrate.attributes``, which goes before.
        notes: what was assumed where the file leaves it open, for the warning about the file.
        demands: traffic that the file asks for, None if it names none.
    """

    source: str
    ids: list[Any]
    nodes: list[dict[str, Any]]
    ends: list[tuple[int, int]]
    links: list[dict[str, Any]]
    directed: bool = False
    attributes: dict[str, Any] = field(default_factory=dict)
    names: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    demands: DemandMatrix | None = None

    def to_networkx(self) -> nx.MultiGraph:
        """The graph by the file's ids, with all attributes."""
        graph = nx.MultiDiGraph() if self.directed else nx.MultiGraph()
        graph.graph.update(self.attributes)
        graph.add_nodes_from(zip(self.ids, self.nodes, strict=True))
        ends = [(self.ids[u], self.ids[v]) for u, v in self.ends]
        graph.add_edges_from((u, v, data) for (u, v), data in zip(ends, self.links, strict=True))
        return graph

    def node_name(self, node: int) -> str:
        """Node ``node`` in a message."""
        return f"node {shown(self.ids[node])}"

    def link_name(self, link: int) -> str:
        """Link ``link`` in a message."""
        u, v = self.ends[link]
        return f"link {shown(self.ids[u])} - {shown(self.ids[v])}"


def assemble(
    source: str,
    ids: list[Any],
    nodes: list[dict[str, Any]],
    ends: list[tuple[Any, Any]],
    links: list[dict[str, Any]],
    **rest: Any,
) -> GraphFile:
    """A graph file of links whose ``ends`` are ids."""
    if len(ids) > MAX_NODES:
        raise ScenarioError(
            f"{source}: has {len(ids):,} nodes, and one table of the delays between all of them would take "
            f"{8 * len(ids) ** 2 / 1e9:,.1f} GB; give a network of at most {MAX_NODES:,} nodes"
        )
    if len(ends) > MAX_LINKS:
        raise ScenarioError(f"{source}: has {len(ends):,} links; give a network of at most {MAX_LINKS:,}")
    index = {name: node for node, name in enumerate(ids)}
    if len(index) < len(ids):
        twice = next(name for node, name in enumerate(ids) if index[name] != node)
        raise ScenarioError(f"{source}: two nodes have the same 'id' {shown(twice)}; ids must differ")
    texts = {str(name).strip(): name for name in ids}
    if len(texts) < len(ids):
        twice = next(name for name in ids if texts[str(name).strip()] != name)
        raise ScenarioError(f"{source}: two nodes have the 'id' {shown(str(twice))}, one as text; ids must differ")
    for end in (end for pair in ends for end in pair):
        if end not in index:
            raise ScenarioError(
                f"{source}: a link names node {shown(end)}, which is not among 'nodes'; add it or correct the link"
            )
    return GraphFile(source, ids, nodes, [(index[u], index[v]) for u, v in ends], links, **rest)
