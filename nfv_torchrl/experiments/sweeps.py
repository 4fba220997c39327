"""A metric of every method against one parameter of the scenario, colocation off and on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, panel_figure
from nfv_torchrl.experiments.rows import Rows, bound_rows, gap_rows, method_row, paired_rows
from nfv_torchrl.experiments.study import Point, Study, cells_of, show

METRICS = {"aar": "AAR", "anuc": "ANUC ($)"}


@dataclass(frozen=True)
class Sweep:
    """A figure of ``metric`` over ``parameter``.

    Attributes:
        metric: ``aar`` or ``anuc``.
        parameter: what changes from point to point (``arrival_rate``, ``mean_lifetime`` or ``nodes``).
        points: key of the budget with its values.
        at: key of the budget with what else differs from the base scenario, if anything.
        label: of the horizontal axis.
    """

    metric: str
    parameter: str
    points: str
    label: str
    at: str | None = None

    def cells(self, study: Study) -> list[Cell]:
        found: list[Cell] = []
        for colocation in study.colocations:
            for world in self._worlds(study, colocation).values():
                found += cells_of(study.evaluations(world))
                found += [study.bound(world)] if self.metric == "aar" else []
        return found

    def draw(self, study: Study, store: CellStore) -> Drawn:
        rows: Rows = []
        paired: Rows = []
        for colocation in study.colocations:
            for x, world in self._worlds(study, colocation).items():
                methods = study.evaluations(world)
                rows += [method_row(store, runs, show(name), x, self.metric, world) for name, runs in methods.items()]
                paired += paired_rows(store, methods, x, world, study)
                if self.metric == "aar":
                    rows += bound_rows(store, study.bound(world), x, world)
                    paired += gap_rows(store, methods, study.bound(world), x, world)
        ticks = {x: f"{x:g}\nρ {study.rho(world):.2f}" for x, world in self._worlds(study, False).items()}
        figure = panel_figure(
            rows,
            below=[row for row in paired if row["metric"] == "gap_closed" and row["reference"] == self._bound(study)],
            title=f"{METRICS[self.metric]} over {self.label}{self._fixed(study)}",
            caption=study.about(),
            x_label=self.label,
            y_label=METRICS[self.metric],
            ticks=ticks,
            log="x" if self.parameter == "nodes" else "",
        )
        return Drawn(figure, rows, paired)

    def _worlds(self, study: Study, colocation: bool) -> Mapping[float, Point]:
        at: dict[str, Any] = study.budget[self.at] if self.at else {}
        points = study.budget[self.points]
        return {x: study.world(**{**at, self.parameter: x, "colocation": colocation}) for x in points}

    def _bound(self, study: Study) -> str:
        """The bound on what the methods of the figure can reach in expectation."""
        return f"bound: {'hindsight' if study.base['observe_lifetime'] else 'blind'}"

    def _fixed(self, study: Study) -> str:
        world = next(iter(self._worlds(study, False).values()))
        fixed = {
            "nodes": f"N = {world['substrate']['nodes']}",
            "arrival_rate": f"λ = {world['arrival_rate']:g}/s",
            "mean_lifetime": f"μ = {world['mean_lifetime']:g} s",
        }
        return ", " + ", ".join(text for key, text in fixed.items() if key != self.parameter)
