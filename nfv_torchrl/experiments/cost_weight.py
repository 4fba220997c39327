"""DQN-AR trained with rewards that weigh cost more and more, beside methods that have no such weight."""

from __future__ import annotations

from dataclasses import dataclass

from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, panel_figure
from nfv_torchrl.experiments.rows import Rows, bound_rows, constant, gap_rows, method_row, paired_rows
from nfv_torchrl.experiments.study import AGENT, Point, Runs, Study, cells_of, show
from nfv_torchrl.experiments.sweeps import METRICS

SERIES = {"default": "DQN-AR, default reward", "paper": "DQN-AR, paper's reward"}


@dataclass(frozen=True)
class CostWeight:
    """A figure of ``metric`` over w_cost, on the base scenario.

    One w_cost weighs more in the default reward, which pays w_acc once a request, than in the paper's, which pays it on
    every step.
    """

    metric: str

    def cells(self, study: Study) -> list[Cell]:
        found: list[Cell] = []
        for world in self._worlds(study):
            found += cells_of(self._others(study, world))
            found += cells_of(self._agents(study, world))
            found += [study.bound(world)] if self.metric == "aar" else []
        return found

    def draw(self, study: Study, store: CellStore) -> Drawn:
        rows: Rows = []
        paired: Rows = []
        weights = study.budget["cost_weights"]
        for world in self._worlds(study):
            others = self._others(study, world)
            for (reward, weight), runs in self._agents(study, world).items():
                series, methods = SERIES[reward], {AGENT: runs, **others}
                rows.append(method_row(store, runs, series, weight, self.metric, world))
                paired += paired_rows(store, methods, weight, world, study, series)
                if self.metric == "aar":
                    paired += gap_rows(store, methods, study.bound(world), weight, world, series)
            for name, runs in others.items():
                rows += constant(method_row(store, runs, show(name), 0.0, self.metric, world), weights)
            if self.metric == "aar":
                for row in bound_rows(store, study.bound(world), 0.0, world):
                    rows += constant(row, weights)
        world = study.world()
        where = f"N = {world['substrate']['nodes']}, λ = {world['arrival_rate']:g}/s, μ = {world['mean_lifetime']:g} s"
        figure = panel_figure(
            rows,
            title=f"{METRICS[self.metric]} over the cost weight, {where}, ρ = {study.rho(world):.2f}",
            caption=study.about([name for name in study.trained if not study.is_general(name)]),
            x_label="w_cost of the reward that DQN-AR is trained with",
            y_label=METRICS[self.metric],
        )
        return Drawn(figure, rows, paired)

    def _worlds(self, study: Study) -> list[Point]:
        return [study.world(colocation=colocation) for colocation in study.colocations]

    def _others(self, study: Study, world: Point) -> dict[str, Runs]:
        """But for agents that are trained once, since they know of no weight either and the figure is full."""
        names = (name for name in study.methods(world) if name != AGENT and not study.is_general(name))
        return {name: study.evaluation(name, world) for name in names}

    def _agents(self, study: Study, world: Point) -> dict[tuple[str, float], Runs]:
        if AGENT not in study.methods(world):
            return {}
        return {
            (reward, weight): study.evaluation(AGENT, world, study.reward(reward, weight))
            for reward in study.rewards
            if reward in SERIES
            for weight in study.budget["cost_weights"]
        }
