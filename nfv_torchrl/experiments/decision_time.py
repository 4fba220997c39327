"""Time per decision over the size of the network, beside the paper's complexity formulas."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, panel_figure
from nfv_torchrl.experiments.rows import Rows, setting
from nfv_torchrl.experiments.study import Point, Study, show
from nfv_torchrl.scenario.scenario import Scenario

HIDDEN = (256, 256)
"""Neurons of the hidden layers: P_h layers of P_n."""
TABU_ITERATIONS = 30


@dataclass(frozen=True)
class Size:
    """What the formulas read: N, V (VMs of a node at most), L, K (services with a pair), F (longest chain)."""

    nodes: int
    vms: int
    links: int
    services: int
    functions: int

    @classmethod
    def of(cls, world: Point) -> Size:
        scenario = Scenario.from_config(world)
        substrate, types = scenario.substrate, len(scenario.catalogue.types)
        pairs = 1 if scenario.endpoint_pairs is None else scenario.endpoint_pairs.shape[1]
        longest = int(scenario.catalogue.chain_length.max())
        return cls(substrate.num_nodes, substrate.max_vms, substrate.num_links, types * pairs, longest)


def dqn_steps(size: Size) -> float:
    """P_n (P_i + P_h P_n + P_o) for one decision of the network."""
    inputs = size.links + size.nodes * size.vms + 5
    outputs = 2 * size.nodes * size.vms
    return HIDDEN[0] * (inputs + len(HIDDEN) * HIDDEN[0] + outputs)


def tabu_steps(size: Size) -> float:
    """E F for one of the K requests: it does not depend on N."""
    return TABU_ITERATIONS * size.functions


def greedy_steps(size: Size) -> float:
    """L + N log N + F K for one of the K requests."""
    return size.links + size.nodes * math.log(size.nodes) + size.functions * size.services


FORMULAS: dict[str, tuple[str, Callable[[Size], float]]] = {
    "dqn_ar": ("O(P_n (P_i + P_h P_n + P_o))", dqn_steps),
    "tabu": ("O(E F) a request", tabu_steps),
    "greedy": ("O(L + N log N + F K) a request", greedy_steps),
}


class DecisionTime:
    """Measured for every method, alone on the machine, and the formulas scaled to the first point."""

    def cells(self, study: Study) -> list[Cell]:
        return [study.timing(name, world) for world in self._worlds(study) for name in study.methods(world)]

    def draw(self, study: Study, store: CellStore) -> Drawn:
        rows: Rows = []
        for world in self._worlds(study):
            for name in study.methods(world):
                rows.append(self._row(study, store, name, world))
        rows += self._formulas(study, rows)
        options = study.budget["timing"]
        worlds = self._worlds(study)
        figure = panel_figure(
            rows,
            title=f"Processor time of a decision over N, λ = {worlds[0]['arrival_rate']:g}/s",
            caption=f"{study.about()}\nOne network at a time, one thread, colocation off. Timed on {options['seeds']} "
            f"horizons of {options['horizon']} slots; formulas (dashed) are scaled to their method's first point.",
            x_label="nodes N",
            y_label="ms of processor time a request",
            ticks={(n := world["substrate"]["nodes"]): f"{n}\nρ {study.rho(world):.2f}" for world in worlds},
            log="xy",
            like={text: show(name) for name, (text, _) in FORMULAS.items()},
        )
        return Drawn(figure, rows)

    def _row(self, study: Study, store: CellStore, name: str, world: Point) -> dict[str, object]:
        cell = study.timing(name, world)
        result = store.read(cell)
        milliseconds = [1000 * seconds for seconds in result["seconds_per_request"].values()]
        more = {**setting(world, result["rho"]), "panel": "measured, and the paper's formulas", "cell": cell.key}
        return tidy_row(show(name), world["substrate"]["nodes"], mean_interval(milliseconds), method=name, **more)

    def _formulas(self, study: Study, measured: Rows) -> Rows:
        worlds = self._worlds(study)
        sizes = {world["substrate"]["nodes"]: Size.of(world) for world in worlds}
        first = next(iter(sizes))
        rows = []
        for name, (text, steps) in FORMULAS.items():
            start = [row["mean"] for row in measured if row["method"] == name and row["x"] == first]
            for nodes, size in sizes.items() if start else ():
                scaled = start[0] * steps(size) / steps(sizes[first])
                interval = Interval(scaled, math.nan, math.nan, 0)
                rows.append(tidy_row(text, nodes, interval, method=name, panel=measured[0]["panel"]))
        return rows

    def _worlds(self, study: Study) -> list[Point]:
        at = study.budget["nodes_at"]
        return [study.world(**{**at, "nodes": nodes}) for nodes in study.budget["nodes"]]
