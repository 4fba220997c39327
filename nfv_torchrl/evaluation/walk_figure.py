"""A picture of how one request was answered, one method beside another, on the network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nfv_torchrl.evaluation.network_figure import layout, outline
from nfv_torchrl.evaluation.records import FORWARD, RunRecord
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator.reasons import REASON_NAMES

EXAMPLES = 5
"""Requests whose walks are drawn."""
TRIED, TAKEN, PLACED = "tab:red", "tab:blue", "tab:orange"
CURVE, MOST_BENDS = 0.18, 3
"""How far a hop that was taken before bends away from the straight line, and how many such lines are told apart."""


@dataclass(frozen=True)
class Walk:
    """How a request was answered.

    Attributes:
        nodes: where the walk was, the ingress first.
        functions: of every step, the place in the chain of the function that it placed, ``FORWARD`` if it placed none.
        reason: why it was rejected; None: accepted.
        cost: $, NaN where rejected.
        delay_ms: ms, NaN where rejected.
    """

    nodes: tuple[int, ...]
    functions: tuple[int, ...]
    reason: str | None
    cost: float
    delay_ms: float

    def content(self) -> dict[str, Any]:
        """As plain values."""
        return {**asdict(self), "nodes": list(self.nodes), "functions": list(self.functions)}

    @classmethod
    def from_content(cls, content: Mapping[str, Any], nodes: int) -> Walk:
        """What ``content`` gave, on a network of so many nodes.

        Raises:
            ValueError: it cannot be.
        """
        walk = cls(tuple(content["nodes"]), tuple(content["functions"]), content["reason"],
                   float(content["cost"]), float(content["delay_ms"]))  # fmt: skip
        inside = all(type(node) is int and 0 <= node < nodes for node in walk.nodes)
        known = walk.reason is None or walk.reason in REASON_NAMES
        if not inside or not known or not walk.nodes or len(walk.functions) != len(walk.nodes) - 1:
            raise ValueError("no walk on this network")
        return walk

    @property
    def hops(self) -> int:
        """Links used, counted as often as they are used."""
        return sum(a != b for a, b in zip(self.nodes, self.nodes[1:], strict=False))

    def sentence(self) -> str:
        """What came of it, in two short lines."""
        if self.reason is not None:
            return f"rejected:\n{self.reason.replace('_', ' ')}"
        return f"{self.cost:.0f} $\n{self.hops} links, {self.delay_ms:.0f} ms"


def walk_of(record: RunRecord, request: int) -> Walk:
    """The walk of request number ``request``. Of a rejected one: what it tried, without a last step to nowhere."""
    steps = slice(int(record.step_offsets[request]), int(record.step_offsets[request + 1]))
    nodes, functions = record.step_node[steps].tolist(), record.step_function[steps].tolist()
    while nodes and nodes[-1] < 0:  # REJECT or NO_ACTION
        nodes, functions = nodes[:-1], functions[:-1]
    taken = bool(record.accepted[request])
    ingress = int(record.workload.ingress[request])
    begins = ingress if ingress >= 0 else next(iter(nodes), 0)  # a free ingress is where the first function stands
    return Walk(
        nodes=(begins, *nodes),
        functions=tuple(functions),
        reason=None if taken else REASON_NAMES[int(record.reason[request])],
        cost=float(record.cost[request]),
        delay_ms=float(record.delay_ms[request]),
    )


def example_requests(record: RunRecord) -> list[int]:
    """Numbers of up to ``EXAMPLES`` requests that ``record`` accepted, from the middle of the horizon on: the services
    in turn, so that all are there."""
    half = record.workload.slot >= record.scenario.horizon // 2
    usable = np.flatnonzero(record.accepted & half)
    if not len(usable):
        usable = np.flatnonzero(record.accepted)
    turns: dict[int, int] = {}
    ranks = []
    for request in usable.tolist():
        service = int(record.workload.service[request])
        turns[service] = turns.get(service, -1) + 1
        ranks.append((turns[service], request))
    return [request for _, request in sorted(ranks)[:EXAMPLES]]


def draw_walks(scenario: Scenario, title: str, walks: Mapping[str, Walk]) -> Figure:
    """The same request answered by several methods, one network beside the other.

    Args:
        scenario: where.
        title: which request.
        walks: by name of the method.
    """
    figure = Figure(figsize=(1.75 * len(walks), 3.0))
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.0, top=0.65, wspace=0.02)  # a layout engine takes longer
    for axes, (name, walk) in zip(np.ravel(figure.subplots(1, len(walks))), walks.items(), strict=True):
        _draw(axes, scenario, walk)
        axes.set_title(f"{name}: {walk.sentence()}", fontsize=9.5)
    figure.suptitle(title, fontsize=9.5, y=0.985)
    return figure


def _draw(axes: Axes, scenario: Scenario, walk: Walk) -> None:
    substrate = scenario.substrate
    graph, place = substrate.to_networkx(), layout(substrate)
    small = substrate.num_nodes <= 30
    nx.draw_networkx_edges(graph, place, ax=axes, edge_color="lightgrey", width=1.2)
    nx.draw_networkx_nodes(graph, place, ax=axes, node_size=150 if small else 20, node_color="white",
                           edgecolors="grey", linewidths=0.8)  # fmt: skip
    _arrows(axes, place, walk)
    ends = {walk.nodes[0]: "s", walk.nodes[-1]: "D"}
    for node, marker in ends.items():
        axes.scatter(*place[node], s=230 if small else 70, marker=marker, facecolors="none", edgecolors="black",
                     linewidths=1.6, zorder=4)  # fmt: skip
    if small:
        for label in nx.draw_networkx_labels(graph, place, ax=axes, font_size=9).values():
            label.set_path_effects(outline())
    _placements(axes, place, walk)
    axes.margins(0.2, 0.12)  # room for the functions, on the left and right, too
    axes.set_axis_off()


def _arrows(axes: Axes, place: Mapping[int, tuple[float, float]], walk: Walk) -> None:
    colour = TAKEN if walk.reason is None else TRIED
    used: dict[tuple[int, int], int] = {}
    for a, b in zip(walk.nodes, walk.nodes[1:], strict=False):
        if a == b:
            continue
        times = used[a, b] = used.get((a, b), 0) + 1
        bend = CURVE * min(times, MOST_BENDS) if times > 1 or (b, a) in used else 0.0
        axes.annotate("", place[b], place[a], zorder=3, arrowprops={
            "arrowstyle": "-|>", "color": colour, "linewidth": 1.7, "shrinkA": 8, "shrinkB": 8,
            "connectionstyle": f"arc3,rad={bend}"})  # fmt: skip


def _placements(axes: Axes, place: Mapping[int, tuple[float, float]], walk: Walk) -> None:
    """The functions above or below the nodes where they are, by their place in the chain, from 1."""
    at: dict[int, list[int]] = {}
    for node, function in zip(walk.nodes[1:], walk.functions, strict=True):
        if function != FORWARD:
            at.setdefault(node, []).append(function + 1)
    steps = [(a, b) for a, b in zip(walk.nodes, walk.nodes[1:], strict=False) if a != b]
    for node, functions in at.items():
        beside = [place[b if a == node else a][1] for a, b in steps if node in (a, b)]
        below = bool(beside) and float(np.mean(beside)) > place[node][1]  # where fewer arrows are
        text = axes.annotate(
            "f" + ",".join(map(str, functions)), place[node], xytext=(0, -9 if below else 9), fontsize=9.5,
            textcoords="offset points", ha="center", va="top" if below else "bottom", fontweight="bold", color=PLACED,
            zorder=5,
        )  # fmt: skip
        text.set_path_effects(outline())


def title_of(record: RunRecord, request: int) -> str:
    """Which request it is."""
    work, services = record.workload, record.scenario.catalogue.types
    service = services[int(work.service[request])]
    chain = ", ".join(f"f{k + 1} {name}" for k, name in enumerate(service.chain))
    ingress, egress = ("any" if end[request] < 0 else int(end[request]) for end in (work.ingress, work.egress))
    tolerable = float(record.scenario.profiles.tolerable_delay[work.profile[request]])
    limit = f"at most {tolerable:g} ms" if np.isfinite(tolerable) else "any delay"
    return f"{service.name}, request {request}, {limit}\nfrom node {ingress} to {egress}\n{chain}"
