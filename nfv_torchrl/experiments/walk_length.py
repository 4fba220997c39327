"""Does a longer walk earn more? DQN-AR trained with the paper's reward, which pays w_acc a step, and with others."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure

from nfv_torchrl.evaluation.figures import STYLE, tidy_row
from nfv_torchrl.evaluation.looks import looks
from nfv_torchrl.evaluation.statistics import mean_interval
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, mathematics, set_caption, set_title
from nfv_torchrl.experiments.rows import Rows, keys, read_runs, setting, values
from nfv_torchrl.experiments.study import AGENT, Point, Runs, Study, cells_of, show

PANELS = {
    "mean_hops": "links used an accepted request",
    "paper_reward": "what the paper's reward pays\nan accepted request, undiscounted",
    "aar": "AAR",
}
REFERENCES = ("random_feasible", "greedy", "myopic_optimal")


class RewardAndWalkLength:
    """Bars: hops, the paper's reward and AAR of every reward of the config, and of planners for comparison."""

    def cells(self, study: Study) -> list[Cell]:
        return cells_of(self._runs(study))

    def draw(self, study: Study, store: CellStore) -> Drawn:
        world = self._world(study)
        rows: Rows = []
        for metric in PANELS:
            for place, (name, runs) in enumerate(self._runs(study).items()):
                result = read_runs(store, runs)
                more = {"metric": metric, **setting(world, result["rho"]), "cell": keys(runs)}
                rows.append(tidy_row(name, place, mean_interval(values(result, metric)), **more))
        where = f"N = {world['substrate']['nodes']}, λ = {world['arrival_rate']:g}/s, μ = {world['mean_lifetime']:g} s"
        head = f"Reward and length of the walk, {where}, ρ = {study.rho(world):.2f}, colocation off"
        return Drawn(_bars(rows, head, study.about([AGENT])), rows)

    def _world(self, study: Study) -> Point:
        return study.world(colocation=False)

    def _runs(self, study: Study) -> dict[str, Runs]:
        world = self._world(study)
        names = study.methods(world)
        runs = {show(name): study.evaluation(name, world) for name in REFERENCES if name in names}
        if AGENT in names:
            for reward, options in study.rewards.items():
                runs[f"DQN-AR: {options['label']}"] = study.evaluation(AGENT, world, study.reward(reward))
        return runs


def _bars(rows: Rows, title: str, caption: str) -> Figure:
    names = list(dict.fromkeys(row["series"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 0.6 * len(names) + 1.8), layout="constrained")
        set_title(figure, title)
        set_caption(figure, caption)
        grid = figure.subplots(1, len(PANELS), sharey=True)
        grid[0].invert_yaxis()
        for axes, (metric, label) in zip(grid, PANELS.items(), strict=True):
            mine = [row for row in rows if row["metric"] == metric]
            arms = [[row["mean"] - row["ci_low"] for row in mine], [row["ci_high"] - row["mean"] for row in mine]]
            places = [names.index(row["series"]) for row in mine]
            colours = [looks([row["series"].partition(":")[0]]).popitem()[1].colour for row in mine]
            axes.barh(places, [row["mean"] for row in mine], xerr=arms, color=colours, alpha=0.75, capsize=3)
            axes.set_yticks(range(len(names)), [mathematics(name) for name in names])
            axes.set_xlabel(label)
    return figure
