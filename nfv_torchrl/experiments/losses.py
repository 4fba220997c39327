"""Losses side by side: their scores over training seeds as a table, as learning curves and as performance profiles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np

from nfv_torchrl.evaluation.figures import line_figure, save_figure, tidy_row
from nfv_torchrl.evaluation.pivot import Column, pivot, result_row
from nfv_torchrl.evaluation.robust import interquartile_mean, performance_profile
from nfv_torchrl.evaluation.statistics import Interval, mean_interval, paired_difference
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.scenario.scenario import Scenario

FLOOR = "random_feasible"
"""What every loss has to beat."""
COST = "cost_per_accepted"
LEVELS = 200
"""Levels of AAR at which a performance profile is drawn."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Compared:
    """The cells of a comparison, those that the store has and those that it lacks.

    Attributes:
        trained: by loss and training seed, the training.
        tested: by loss and training seed, the policy on the workloads of the test.
        rules: by name, ``FLOOR`` first, what needs no training, on the same workloads.
        held_out: the same on the workloads of the learning curves.
        store: what is there.
    """

    trained: Mapping[str, Mapping[int, Cell]]
    tested: Mapping[str, Mapping[int, Cell]]
    rules: Mapping[str, Cell]
    held_out: Mapping[str, Cell]
    store: CellStore

    def runs(self, name: str) -> dict[int, Cell]:
        """The tests of a loss that are there, by training seed."""
        return {seed: cell for seed, cell in self.tested[name].items() if self.store.has(cell)}

    def there(self) -> list[str]:
        """Losses with a run."""
        return [name for name in self.tested if self.runs(name)]

    def lacking(self) -> list[str]:
        """What is not there, for people: ``dqn: training seeds 3, 4``."""
        told = [f"{name} (rule)" for name, cell in self.rules.items() if not self.store.has(cell)]
        for name, cells in self.tested.items():
            seeds = sorted(set(cells) - set(self.runs(name)))
            if seeds:
                told.append(f"{name}: training seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}")
        return told


def scores(cell: Cell, store: CellStore, metric: str) -> list[float]:
    """A metric of every workload of an evaluation, NaN where it does not exist."""
    found = (run[metric] for run in store.read(cell)["metrics"].values())
    return [math.nan if value is None else value for value in found]


def table_rows(compared: Compared, reference: str) -> Rows:
    """One row for each loss or rule and quantity: mean over training seeds and its interval."""
    store, rows = compared.store, []
    if not store.has(compared.rules[FLOOR]):
        return []
    lowest = fmean(scores(compared.rules[FLOOR], store, "aar"))
    for name, cell in compared.rules.items():
        if store.has(cell):
            rows += _own_rows(name, {0: cell}, store)
            if name != FLOOR:
                above = mean_interval([fmean(scores(cell, store, "aar")) - lowest])
                rows.append(result_row({}, name, "aar_difference", above, FLOOR))
    for name in compared.there():
        runs = compared.runs(name)
        aar = {seed: fmean(scores(cell, store, "aar")) for seed, cell in runs.items()}
        rows += _own_rows(name, runs, store)
        other = compared.runs(reference) if reference in compared.tested else {}
        shared = [seed for seed in runs if seed in other]
        if name != reference and shared:
            theirs = [fmean(scores(other[seed], store, "aar")) for seed in shared]
            difference = paired_difference([aar[seed] for seed in shared], theirs)
            rows.append(result_row({}, name, "aar_difference", difference, reference))
        above = mean_interval([value - lowest for value in aar.values()])
        rows.append(result_row({}, name, "aar_difference", above, FLOOR))
        rows += _effort_rows(name, [compared.trained[name][seed] for seed in runs], store)
    return rows


def _own_rows(name: str, runs: Mapping[int, Cell], store: CellStore) -> Rows:
    means = {metric: [fmean(scores(cell, store, metric)) for cell in runs.values()] for metric in ("aar", COST)}
    middle = interquartile_mean(np.array([scores(cell, store, "aar") for cell in runs.values()]))
    found = {"aar": mean_interval(means["aar"]), "aar_iqm": middle, COST: mean_interval(means[COST])}
    return [result_row({}, name, metric, interval) for metric, interval in found.items()]


def _effort_rows(name: str, trainings: Sequence[Cell], store: CellStore) -> Rows:
    results = [store.read(cell) for cell in trainings if store.has(cell)]
    frames = [result["eval"][-1]["frames"] for result in results if result["eval"]]
    found = {
        "training_frames": mean_interval(frames),
        "training_seconds": mean_interval([result.get("processor_seconds", math.nan) for result in results]),
    }
    plain = {metric: Interval(each.mean, math.nan, math.nan, each.n) for metric, each in found.items() if each.n}
    return [result_row({}, name, metric, interval) for metric, interval in plain.items()]


def loss_table(rows: Rows, config: Mapping[str, Any], scenario: Scenario) -> Table:
    """The rows as one line for each loss or rule."""
    title = (
        f"Losses: rho = {scenario.offered_load():.2f}, scenario {scenario.name}, N = {scenario.substrate.num_nodes}, "
        f"{config['frames']:,} frames, {config['seeds']} training seeds, {config['workloads']} workloads, "
        f"lifetimes {'seen' if scenario.observe_lifetime else 'hidden'}"
    )
    others = (config["reference"], FLOOR)
    differences = [Column("aar_difference", "+.4f", reference=to, title=f"AAR - {to}") for to in others]
    scores_of = [Column("aar", ".4f"), Column("aar_iqm", ".4f")]
    columns = [*scores_of, *differences, Column(COST, ".1f"), Column("training_seconds", ",.0f")]
    return pivot(title, rows, {"method": ""}, columns)


def draw_curves(figure: str, names: Sequence[str], compared: Compared, scenario: Scenario) -> None:
    """AAR on the held-out workloads over frames, mean and interval over training seeds; rules as lines."""
    store, rows = compared.store, []
    for name in names:
        at: dict[int, list[float]] = {}
        for run in filter(store.has, compared.trained[name].values()):
            for point in store.read(run)["eval"]:
                at.setdefault(int(point["frames"]), []).append(point["aar"])
        rows += [tidy_row(name, frames, mean_interval(values)) for frames, values in sorted(at.items())]
    if not rows:
        return
    ends = (min(row["x"] for row in rows), max(row["x"] for row in rows))
    rules = {name: cell for name, cell in compared.held_out.items() if store.has(cell)}
    for name, cell in rules.items():
        level = Interval(fmean(scores(cell, store, "aar")), math.nan, math.nan, 1)
        rows += [tidy_row(name, x, level) for x in ends]
    labels = {
        "x_label": "frames",
        "y_label": "AAR (held-out workloads)",
        "title": f"Learning curves, {_where(scenario)}",
    }
    drawn = line_figure(rows, **labels, dashed=list(rules))
    save_figure(drawn, rows, store.folder / f"learning_curves_{figure}")


def draw_profiles(figure: str, names: Sequence[str], compared: Compared, scenario: Scenario) -> None:
    """For every level of AAR the share of runs and workloads above it; rules as lines."""
    store = compared.store
    rules = {name: [cell] for name, cell in compared.rules.items() if store.has(cell)}
    runs = {name: list(compared.runs(name).values()) for name in names if compared.runs(name)}
    if not runs:
        return
    found = {name: np.array([scores(cell, store, "aar") for cell in cells]) for name, cells in (runs | rules).items()}
    low, high = min(map(np.min, found.values())), max(map(np.max, found.values()))
    margin = 0.02 * max(high - low, 0.01)
    taus = np.linspace(low - margin, high + margin, LEVELS)
    rows = [
        tidy_row(name, float(tau), share)
        for name, table in found.items()
        for tau, share in zip(taus, performance_profile(table, taus), strict=True)
    ]
    labels = {"x_label": r"AAR $\tau$", "y_label": r"share of scores above $\tau$"}
    drawn = line_figure(rows, **labels, title=f"Performance profiles, {_where(scenario)}", dashed=list(rules))
    save_figure(drawn, rows, store.folder / f"profiles_{figure}")


def _where(scenario: Scenario) -> str:
    return rf"{scenario.name}, $\rho$ = {scenario.offered_load():.2f}"
