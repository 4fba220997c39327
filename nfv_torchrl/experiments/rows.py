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
from nfv_torchrl.experiments.study import AGENT, Point, Runs, Study, show
from nfv_torchrl.experiments.work import read_costs

Rows = list[dict[str, Any]]
PAIRED = ("aar", "anuc")
LOWEST = "aar_difference_lowest"
"""The metric of ``lowest``."""


def values(result: Mapping[str, Any], metric: str) -> list[float]:
    """A metric of an evaluation, seed by seed; NaN where it does not exist."""
    found = (run[metric] for run in result["metrics"].values())
    return [math.nan if value is None else value for value in found]


def read_runs(store: CellStore, runs: Runs) -> dict[str, Any]:
    """The result of a method on all workload seeds, in their order."""
    results = [store.read(cell) for cell in runs]
    metrics = {seed: run for result in results for seed, run in result["metrics"].items()}
    return {**results[0], "metrics": {seed: metrics[seed] for seed in sorted(metrics, key=int)}}


def keys(runs: Runs) -> str:
    """The cells that a row comes from."""
    return " ".join(cell.key for cell in runs)


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


def method_row(store: CellStore, runs: Runs, series: str, x: float, metric: str, world: Point) -> dict[str, Any]:
    """One method, called ``series``, at one point."""
    result = read_runs(store, runs)
    interval = mean_interval(values(result, metric))
    more = {"metric": metric, **setting(world, result["rho"]), "cell": keys(runs)}
    return tidy_row(series, x, interval, **more)


def bound_rows(store: CellStore, cell: Cell, x: float, world: Point) -> Rows:
    """The bounds on AAR at one point."""
    result = store.read(cell)
    more = {"metric": "aar", **setting(world, result["rho"]), "cell": cell.key}
    return [
        tidy_row(f"bound: {kind}", x, mean_interval(list(by_seed.values())), **more)
        for kind, by_seed in result["bounds"].items()
    ]


def paired_rows(
    store: CellStore, methods: Mapping[str, Runs], x: float, world: Point, study: Study, series: str | None = None
) -> Rows:
    """Every agent against every other method on the same requests; with ``series`` DQN-AR alone, called that.

    Relative differences of AAR and ANUC (0.07: 7 % above the reference), and ``paired_cost``.
    """
    return [
        row
        for agent in methods
        if agent in ([AGENT] if series else study.trained)
        for name in methods
        if name != agent
        for row in _compared(store, methods, (agent, name), x, setting(world, study.rho(world)), series)
    ]


def _compared(
    store: CellStore,
    methods: Mapping[str, Runs],
    pair: tuple[str, str],
    x: float,
    where: Mapping[str, Any],
    series: str | None,
) -> Rows:
    """The first of a pair of methods against the second."""
    mine, other = (read_runs(store, methods[name]) for name in pair)
    compared = {
        f"{metric}_relative_difference": relative_difference(values(mine, metric), values(other, metric))
        for metric in PAIRED
    }
    compared["paired_cost"] = mean_interval(cost_ratios(store, methods[pair[0]], methods[pair[1]]))
    return [
        tidy_row(series or show(pair[0]), x, interval, **{"metric": metric, "reference": show(pair[1]), **where})
        for metric, interval in compared.items()
    ]


def cost_ratios(store: CellStore, runs: Runs, reference: Runs) -> list[float]:
    """For each seed, cost / cost of the reference over the requests that both accept."""
    mine, other = _costs(store, runs), _costs(store, reference)
    return [cost_ratio(mine[seed], other[seed]) for seed in sorted(mine, key=int)]


def _costs(store: CellStore, runs: Runs) -> dict[str, np.ndarray]:
    return {seed: costs for cell in runs for seed, costs in read_costs(cell, store).items()}


def together(samples: Sequence[Sequence[float] | np.ndarray]) -> Interval:
    """Over the seeds of a network, of the mean over training seeds; [training seeds, seeds of the network]."""
    return mean_interval(np.mean(np.array(samples, dtype=float), axis=0))


def lowest(samples: Sequence[Sequence[float] | np.ndarray]) -> Interval:
    """The lowest of the training seeds, by its mean over the seeds of a network; without an interval."""
    return Interval(min(float(np.mean(each)) for each in samples), math.nan, math.nan, len(samples))


def gap_rows(
    store: CellStore, methods: Mapping[str, Runs], bound: Cell, x: float, world: Point, agent: str | None = None
) -> Rows:
    """How much of the way from `myopic_optimal` to each bound on AAR a method goes, where there is a way to go.

    ``agent``: what DQN-AR is called.
    """
    if MYOPIC not in methods:
        return []
    start, rows = values(read_runs(store, methods[MYOPIC]), "aar"), []
    result = store.read(bound)
    for kind, by_seed in result["bounds"].items():
        more = {"metric": "gap_closed", "reference": f"bound: {kind}", **setting(world, result["rho"])}
        for name, runs in methods.items():
            closed = gap_closed(values(read_runs(store, runs), "aar"), start, list(by_seed.values()))
            if closed is not None:
                series = agent if agent is not None and name == AGENT else show(name)
                rows.append(tidy_row(series, x, closed, **more))
    return rows


def constant(row: Mapping[str, Any], xs: Sequence[float]) -> Rows:
    """A row that does not depend on x, at both ends of ``xs``."""
    return [{**row, "x": x} for x in (min(xs), max(xs))]
