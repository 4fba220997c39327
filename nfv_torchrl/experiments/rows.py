"""From cells to the rows that figures and CSV files show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nfv_torchrl.evaluation.comparison import MYOPIC
from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.statistics import Interval, cost_ratio, gap_closed, mean_interval, relative_difference
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.study import AGENT, Point, Study, show
from nfv_torchrl.experiments.work import read_costs

Rows = list[dict[str, Any]]
PAIRED = ("aar", "anuc")


def values(result: Mapping[str, Any], metric: str) -> list[float]:
    """A metric of an evaluation, seed by seed; NaN where it does not exist."""
    found = (run[metric] for run in result["metrics"].values())
    return [math.nan if value is None else value for value in found]


def setting(world: Point, rho: float) -> dict[str, Any]:
    """Columns that say on what scenario a row is."""
    return {
        "panel": f"colocation {'on' if world['colocation'] else 'off'}",
        "nodes": world["substrate"]["nodes"],
        "arrival_rate": world["arrival_rate"],
        "mean_lifetime": world["mean_lifetime"],
        "rho": round(rho, 4),
        "lifetimes": "seen" if world["observe_lifetime"] else "hidden",
    }


def method_row(
    store: CellStore, cell: Cell, name: str, x: float, metric: str, world: Point, series: str | None = None
) -> dict[str, Any]:
    """One method at one point."""
    result = store.read(cell)
    interval = mean_interval(values(result, metric))
    more = {"metric": metric, **setting(world, result["rho"]), "cell": cell.key}
    return tidy_row(series or show(name), x, interval, **more)


def bound_rows(store: CellStore, cell: Cell, x: float, world: Point) -> Rows:
    """The bounds on AAR at one point."""
    result = store.read(cell)
    more = {"metric": "aar", **setting(world, result["rho"]), "cell": cell.key}
    return [
        tidy_row(f"bound: {kind}", x, mean_interval(list(by_seed.values())), **more)
        for kind, by_seed in result["bounds"].items()
    ]


def paired_rows(
    store: CellStore, cells: Mapping[str, Cell], x: float, world: Point, study: Study, series: str | None = None
) -> Rows:
    """DQN-AR (called ``series``) against every other method on the same requests.

    Relative differences of AAR and ANUC (0.07: 7 % above the reference), and ``paired_cost``.
    """
    if AGENT not in cells:
        return []
    agent, rows = store.read(cells[AGENT]), []
    for name, cell in cells.items():
        if name == AGENT:
            continue
        result = store.read(cell)
        compared = {
            f"{metric}_relative_difference": relative_difference(values(agent, metric), values(result, metric))
            for metric in PAIRED
        }
        compared["paired_cost"] = paired_cost(store, cells[AGENT], cell)
        for metric, interval in compared.items():
            more = {"metric": metric, "reference": show(name), **setting(world, study.rho(world))}
            rows.append(tidy_row(series or show(AGENT), x, interval, **more))
    return rows


def paired_cost(store: CellStore, cell: Cell, reference: Cell) -> Interval:
    """Mean over seeds of cost / cost of the reference, over the requests that both accept."""
    return mean_interval(cost_ratios(store, cell, reference))


def cost_ratios(store: CellStore, cell: Cell, reference: Cell) -> list[float]:
    """For each seed, cost / cost of the reference over the requests that both accept."""
    mine, other = read_costs(cell, store), read_costs(reference, store)
    return [cost_ratio(costs, other[seed]) for seed, costs in mine.items()]


def together(samples: Sequence[Sequence[float] | np.ndarray]) -> Interval:
    """Over the seeds of a network, of the mean over training seeds; [training seeds, seeds of the network]."""
    return mean_interval(np.mean(np.array(samples, dtype=float), axis=0))


def gap_rows(
    store: CellStore, cells: Mapping[str, Cell], bound: Cell, x: float, world: Point, agent: str | None = None
) -> Rows:
    """How much of the way from `myopic_optimal` to each bound on AAR a method goes, where there is a way to go.

    ``agent``: what DQN-AR is called.
    """
    if MYOPIC not in cells:
        return []
    start, rows = values(store.read(cells[MYOPIC]), "aar"), []
    result = store.read(bound)
    for kind, by_seed in result["bounds"].items():
        more = {"metric": "gap_closed", "reference": f"bound: {kind}", **setting(world, result["rho"])}
        for name, cell in cells.items():
            closed = gap_closed(values(store.read(cell), "aar"), start, list(by_seed.values()))
            if closed is not None:
                series = agent if agent is not None and name == AGENT else show(name)
                rows.append(tidy_row(series, x, closed, **more))
    return rows


def constant(row: Mapping[str, Any], xs: Sequence[float]) -> Rows:
    """A row that does not depend on x, at both ends of ``xs``."""
    return [{**row, "x": x} for x in (min(xs), max(xs))]
