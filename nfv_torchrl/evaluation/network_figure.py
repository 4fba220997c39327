"""A picture of the network, coloured by how much of it was used."""

from __future__ import annotations

import functools
from typing import NamedTuple

import networkx as nx
import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.scenario.substrate import Substrate


def mean_use(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Mean used share over the horizon of all VMs of each node, float64 [N], and of each link, float64 [L].

    Of the first kind of resources; with full duplex of both directions together.

    Interrupted requests count until their interruption.
    """
    scenario, workload = record.scenario, record.workload
    substrate, horizon = scenario.substrate, scenario.horizon
    leaves = np.where(record.interrupted_at >= 0, record.interrupted_at, np.minimum(workload.uncounted, horizon))
    stay = np.where(record.accepted, leaves - workload.slot, 0) / horizon
    request = np.repeat(np.arange(len(stay)), np.diff(record.step_offsets))
    profile = workload.profile[request]
    # A hop goes from the node of the step before, or from the ingress in a walk's first step.
    before = np.r_[-1, record.step_node[:-1]]
    first = record.step_offsets[:-1][np.diff(record.step_offsets) > 0]
    before[first] = workload.ingress[np.diff(record.step_offsets) > 0]
    taken = record.accepted[request]  # what a rejected request tried uses nothing
    request, profile, before = request[taken], profile[taken], before[taken]
    node, function = record.step_node[taken], record.step_function[taken]
    node_use = np.zeros(substrate.num_nodes)
    placed = function >= 0
    load = scenario.profiles.amount[profile[placed], function[placed], 0]
    np.add.at(node_use, node[placed], load * stay[request[placed]])
    index = np.full((substrate.num_nodes, substrate.num_nodes), -1)
    u, v = substrate.links.T
    index[u, v] = index[v, u] = np.arange(substrate.num_links)
    link = np.where(before >= 0, index[before, node], -1)
    link_use = np.zeros(substrate.num_links)
    segment = _segments(record)[taken]
    np.add.at(link_use, link[link >= 0], (scenario.profiles.rate[profile, segment] * stay[request])[link >= 0])
    installed = substrate.vm_capacity.sum(axis=1)
    both = substrate.link_capacity + (substrate.back_capacity if substrate.back_capacity is not None else 0.0)
    return np.divide(node_use, installed, out=np.zeros_like(node_use), where=installed > 0), link_use / both


def _segments(record: RunRecord) -> np.ndarray:
    """Functions placed before each step of a walk, int64 [steps]."""
    placed = np.r_[0, np.cumsum(record.step_function >= 0)]
    return placed[:-1] - np.repeat(placed[record.step_offsets[:-1]], np.diff(record.step_offsets))


class Drawing(NamedTuple):
    """A network that has been drawn. ``set_array`` of ``nodes`` and ``links`` gives them other used shares."""

    figure: Figure
    axes: Axes
    nodes: PathCollection
    links: LineCollection
    place: dict[int, tuple[float, float]]


def draw_utilisation(record: RunRecord, name: str | None = None) -> Figure:
    """Nodes sized by VM capacity and coloured by VM use, links coloured by link use.

    ``name`` is that of the method in the title, as the record has it unless given.
    """
    drawing = draw_network(record.scenario.substrate, *mean_use(record), "mean used share")
    title = f"{name or record.method} on {record.scenario.name}, workload {record.workload_seed}"
    drawing.axes.set_title(title, fontsize=14)
    return drawing.figure


def draw_network(substrate: Substrate, node_use: np.ndarray, link_use: np.ndarray, label: str) -> Drawing:
    """Nodes sized by VM capacity and coloured by ``node_use`` [N], links coloured by ``link_use`` [L], both 0 to 1."""
    figure = Figure(figsize=(5.4, 4.4))
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.08, top=0.92)  # a layout engine takes longer
    axes = figure.add_subplot()
    graph, place = substrate.to_networkx(), layout(substrate)
    capacity = substrate.vm_capacity.sum(axis=1)
    colours, scale = colormaps["viridis_r"], Normalize(0, 1)
    small = substrate.num_nodes <= 30
    links = nx.draw_networkx_edges(
        graph, place, ax=axes, edgelist=substrate.links.tolist(), edge_color=link_use, edge_cmap=colours,
        edge_vmin=0, edge_vmax=1, width=3.5 if small else 2,
    )  # fmt: skip
    nodes = nx.draw_networkx_nodes(
        graph, place, ax=axes, nodelist=range(substrate.num_nodes), node_color=node_use, cmap=colours, vmin=0, vmax=1,
        node_size=(300 if small else 60) + (700 if small else 240) * capacity / capacity.max(), edgecolors="black",
        linewidths=0.8,
    )  # fmt: skip
    if substrate.num_nodes <= 50:
        for text in nx.draw_networkx_labels(graph, place, ax=axes, font_size=14 if small else 8).values():
            text.set_path_effects(outline())
    bar = figure.colorbar(ScalarMappable(scale, colours), ax=axes, pad=0.02)
    bar.set_label(label, fontsize=14)
    bar.ax.tick_params(labelsize=13)
    axes.set_xlabel("circles: nodes, sized by VM capacity; lines: links", fontsize=12.5)
    axes.tick_params(bottom=False, left=False, labelbottom=False, labelleft=False)
    for side in axes.spines.values():
        side.set_visible(False)
    axes.margins(0.1)
    return Drawing(figure, axes, nodes, links, place)


def outline() -> list[patheffects.AbstractPathEffect]:
    """What makes text readable on any colour."""
    return [patheffects.withStroke(linewidth=2.5, foreground="white")]


def layout(substrate: Substrate) -> dict[int, tuple[float, float]]:
    """Where the nodes lie: by their coordinates if they have some, else spread out by links."""
    if substrate.coordinates is not None:
        return {node: (float(lon), float(lat)) for node, (lat, lon) in enumerate(substrate.coordinates)}
    return dict(_spread_out(substrate.num_nodes, tuple(map(tuple, substrate.links.tolist()))))


@functools.lru_cache(maxsize=16)
def _spread_out(nodes: int, links: tuple[tuple[int, int], ...]) -> dict[int, tuple[float, float]]:
    """Kept, because a training draws the same network again and again (0.1 s each time at 100 nodes)."""
    graph = nx.empty_graph(nodes)
    graph.add_edges_from(links)
    return nx.kamada_kawai_layout(graph)
