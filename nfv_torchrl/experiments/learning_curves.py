"""DQN-AR while it trains, on networks of several sizes."""

from __future__ import annotations

from dataclasses import dataclass

from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.statistics import mean_interval
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, panel_figure
from nfv_torchrl.experiments.rows import Rows, read_runs, setting
from nfv_torchrl.experiments.study import AGENT, Point, Study
from nfv_torchrl.experiments.sweeps import METRICS
from nfv_torchrl.settings.values import list_of_seeds

GROUPS = {"eval": "acting greedily on held-out workloads", "train": "while it explores, on training workloads"}


@dataclass(frozen=True)
class LearningCurves:
    """A figure of ``metric`` over frames of training; one horizon of T slots is the paper's iteration.

    Intervals are over training seeds. A horizon is counted as long as the trained policy takes for one.
    """

    metric: str

    def cells(self, study: Study) -> list[Cell]:
        runs = [study.training(AGENT, world, seed=seed) for world in self._worlds(study) for seed in self._seeds(study)]
        bounds = [self._bound(study, world) for world in self._worlds(study)] if self.metric == "aar" else []
        return [*runs, *(cell for world in self._worlds(study) for cell in study.evaluation(AGENT, world)), *bounds]

    def _bound(self, study: Study, world: Point) -> Cell:
        """Of the held-out workloads on which training evaluates."""
        seeds = study.training(AGENT, world).spec["config"]["eval"]["seeds"]
        return study.bound(world, list_of_seeds("eval.seeds", seeds))

    def draw(self, study: Study, store: CellStore) -> Drawn:
        rows: Rows = []
        for group in GROUPS:
            for world in self._worlds(study):
                rows += self._rows(study, store, world, group)
        count = len(self._seeds(study))
        over = f"{count} training seeds" if count > 1 else "1 training seed"
        notes = " ".join(self._note(study, store, world) for world in self._worlds(study))
        figure = panel_figure(
            rows,
            title=f"{METRICS[self.metric]} of DQN-AR while it trains{self._where(study)}",
            caption=f"{study.about([AGENT], over)}\n{notes}",
            x_label="frames (decisions) of training",
            y_label=METRICS[self.metric],
        )
        return Drawn(figure, rows)

    def _rows(self, study: Study, store: CellStore, world: Point, group: str) -> Rows:
        curves = [store.read(study.training(AGENT, world, seed=seed))[group] for seed in self._seeds(study)]
        values: dict[int, list[float]] = {}
        for point in (point for curve in curves for point in curve if self.metric in point):
            values.setdefault(point["frames"], []).append(point[self.metric])
        horizon = self._frames_per_horizon(study, store, world)
        name = f"N = {world['substrate']['nodes']}, ρ {study.rho(world):.2f}"
        more = {"metric": self.metric, **setting(world, study.rho(world)), "panel": GROUPS[group]}
        if self.metric == "aar":
            bounds = store.read(self._bound(study, world))["bounds"]
            more |= {f"bound_{kind}": mean_interval(list(by_seed.values())).mean for kind, by_seed in bounds.items()}
        return [
            tidy_row(name, frames, mean_interval(found), horizons=round(frames / horizon, 4), **more)
            for frames, found in sorted(values.items())
        ]

    def _note(self, study: Study, store: CellStore, world: Point) -> str:
        """For the caption: the length of a horizon, and what is mathematically possible."""
        told = [f"a horizon is {self._frames_per_horizon(study, store, world):,.0f} frames"]
        if self.metric == "aar":
            for kind, by_seed in store.read(self._bound(study, world))["bounds"].items():
                told.append(f"{kind} bound {mean_interval(list(by_seed.values())).mean:.2f}")
        return f"N = {world['substrate']['nodes']}: {', '.join(told)}."

    def _frames_per_horizon(self, study: Study, store: CellStore, world: Point) -> float:
        runs = read_runs(store, study.evaluation(AGENT, world))["metrics"].values()
        return sum(run["frames"] for run in runs) / len(runs)

    def _seeds(self, study: Study) -> list[int]:
        return list(range(study.budget["training_seeds"]))

    def _worlds(self, study: Study) -> list[Point]:
        at = study.budget["nodes_at"]
        worlds = [study.world(**{**at, "nodes": nodes}) for nodes in study.budget["nodes"]]
        return [world for world in worlds if AGENT in study.methods(world)]

    def _where(self, study: Study) -> str:
        world = self._worlds(study)[0]
        return f", λ = {world['arrival_rate']:g}/s, μ = {world['mean_lifetime']:g} s, colocation off"
