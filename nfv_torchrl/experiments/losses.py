"""Losses side by side: their scores over training seeds as a table and as learning curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from nfv_torchrl.evaluation.figures import line_figure, save_figure, tidy_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval, paired_difference
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.scenario.scenario import Scenario

FLOOR = "random_feasible"
"""What every loss has to beat."""


def scores(runs: Sequence[Cell], store: CellStore, metric: str) -> list[float]:
    """A metric of each training seed, the mean over workloads."""
    found = []
    for cell in runs:
        values = [run[metric] for run in store.read(cell)["metrics"].values()]
        found.append(fmean(math.nan if value is None else value for value in values))
    return found


def table_rows(
    tested: Mapping[str, Sequence[Cell]], floor: Cell, store: CellStore, reference: str
) -> list[dict[str, Any]]:
    """One row for each loss and quantity: mean over training seeds and its interval."""
    if not store.has(floor):
        return []
    (lowest,) = scores([floor], store, "aar")
    rows = []

    def add(name: str, quantity: str, interval: Interval) -> None:
        ends = {"ci_low": interval.low, "ci_high": interval.high, "n": interval.n}
        rows.append({"loss": name, "quantity": quantity, "mean": interval.mean, **ends})

    add(FLOOR, "aar", mean_interval([lowest]))
    add(FLOOR, "cost_per_accepted", mean_interval(scores([floor], store, "cost_per_accepted")))
    for name, runs in tested.items():
        aar = scores(runs, store, "aar")
        add(name, "aar", mean_interval(aar))
        if name != reference and reference in tested:
            add(name, f"aar_minus_{reference}", paired_difference(aar, scores(tested[reference], store, "aar")))
        add(name, f"aar_minus_{FLOOR}", mean_interval([value - lowest for value in aar]))
        add(name, "cost_per_accepted", mean_interval(scores(runs, store, "cost_per_accepted")))
    return rows


def loss_table(rows: Sequence[Mapping[str, Any]], config: Mapping[str, Any], scenario: Scenario) -> Table:
    """The rows as one line for each loss."""
    reference = config["reference"]
    quantities = {
        "aar": ("AAR", "{:.4f}", "{:.4f}"),
        f"aar_minus_{reference}": (f"minus {reference}", "{:+.4f}", "{:.4f}"),
        f"aar_minus_{FLOOR}": (f"minus {FLOOR}", "{:+.4f}", "{:.4f}"),
        "cost_per_accepted": ("cost/accepted $", "{:.1f}", "{:.1f}"),
    }
    values = {(row["loss"], row["quantity"]): row for row in rows}

    def cell(name: str, quantity: str) -> str:
        row = values.get((name, quantity))
        if row is None:
            return "–"
        _, mean, half = quantities[quantity]
        width = max(row["mean"] - row["ci_low"], row["ci_high"] - row["mean"])
        return mean.format(row["mean"]) + ("" if math.isnan(width) else " ± " + half.format(width))

    title = (
        f"Losses: rho = {scenario.offered_load():.2f}, scenario {scenario.name}, N = {scenario.substrate.num_nodes}, "
        f"{config['frames']:,} frames, {config['seeds']} training seeds, {config['workloads']} workloads, "
        f"lifetimes {'seen' if scenario.observe_lifetime else 'hidden'}"
    )
    names = dict.fromkeys(row["loss"] for row in rows)
    lines = tuple((name, *(cell(name, quantity) for quantity in quantities)) for name in names)
    return Table(title, ("loss", *(head for head, _, _ in quantities.values())), lines)


def draw_curves(
    figure: str,
    names: Sequence[str],
    trained: Mapping[str, Sequence[Cell]],
    floor: Cell,
    store: CellStore,
    scenario: Scenario,
) -> None:
    """AAR on the held-out workloads over frames, mean and interval over training seeds."""
    rows = []
    for name in names:
        at: dict[int, list[float]] = {}
        for run in trained[name]:
            for point in store.read(run)["eval"]:
                at.setdefault(int(point["frames"]), []).append(point["aar"])
        rows += [tidy_row(name, frames, mean_interval(values)) for frames, values in sorted(at.items())]
    if not rows or not store.has(floor):
        return
    (lowest,) = scores([floor], store, "aar")
    ends = (min(row["x"] for row in rows), max(row["x"] for row in rows))
    rows += [tidy_row(FLOOR, x, mean_interval([lowest])) for x in ends]
    title = f"{scenario.name}, rho = {scenario.offered_load():.2f}"
    drawn = line_figure(rows, x_label="frames", y_label="AAR (held-out workloads)", title=title, dashed=[FLOOR])
    save_figure(drawn, rows, store.folder / f"learning_curves_{figure}")
