"""Losses side by side: their scores over training seeds as a table and as learning curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from nfv_torchrl.evaluation.figures import line_figure, save_figure, tidy_row
from nfv_torchrl.evaluation.pivot import Column, pivot, result_row
from nfv_torchrl.evaluation.statistics import mean_interval, paired_difference
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.scenario.scenario import Scenario

FLOOR = "random_feasible"
"""What every loss has to beat."""
COST = "cost_per_accepted"


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
    rows = [result_row({}, FLOOR, "aar", mean_interval([lowest]))]
    rows.append(result_row({}, FLOOR, COST, mean_interval(scores([floor], store, COST))))
    for name, runs in tested.items():
        aar = scores(runs, store, "aar")
        rows.append(result_row({}, name, "aar", mean_interval(aar)))
        if name != reference and reference in tested:
            paired = paired_difference(aar, scores(tested[reference], store, "aar"))
            rows.append(result_row({}, name, "aar_difference", paired, reference))
        above = mean_interval([value - lowest for value in aar])
        rows.append(result_row({}, name, "aar_difference", above, FLOOR))
        rows.append(result_row({}, name, COST, mean_interval(scores(runs, store, COST))))
    return rows


def loss_table(rows: Sequence[Mapping[str, Any]], config: Mapping[str, Any], scenario: Scenario) -> Table:
    """The rows as one line for each loss."""
    title = (
        f"Losses: rho = {scenario.offered_load():.2f}, scenario {scenario.name}, N = {scenario.substrate.num_nodes}, "
        f"{config['frames']:,} frames, {config['seeds']} training seeds, {config['workloads']} workloads, "
        f"lifetimes {'seen' if scenario.observe_lifetime else 'hidden'}"
    )
    differences = [Column("aar_difference", "+.4f", reference=to) for to in (config["reference"], FLOOR)]
    return pivot(title, rows, {"method": ""}, [Column("aar", ".4f"), *differences, Column(COST, ".1f")])


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
