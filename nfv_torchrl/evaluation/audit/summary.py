"""Checks summary.csv and per_seed.csv of an evaluation against each other and against the audited runs beside them."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from nfv_torchrl.evaluation.audit.recompute import MEASURED, TOLERANCE

Run = tuple[str, str]
"""(method, workload seed as text, empty without one)."""


def check_summary(folder: Path, runs: Mapping[Run, Mapping[str, float | None]]) -> list[str]:
    """What is wrong with the two files in ``folder``; ``runs`` are the recomputed metrics of the runs below it.

    Runs that per_seed.csv does not name belong to an earlier evaluation and are left alone. Paired figures and bounds
    are not checked: they come from more than one run, or from none.
    """
    problems: list[str] = []
    samples: dict[tuple[str, str], list[float]] = defaultdict(list)
    try:
        for row in _rows(folder / "per_seed.csv"):
            value = float(row["value"] or "nan")
            if not math.isnan(value):
                samples[row["method"], row["metric"]].append(value)
            problems += _check_seed(row, value, runs)
        for row in _rows(folder / "summary.csv"):
            if not row["reference"] and row["metric"] != "aar_bound":
                problems += _check_mean(row, samples[row["method"], row["metric"]])
    except (OSError, KeyError, TypeError, ValueError) as error:
        problems.append(f"summary.csv or per_seed.csv cannot be read: {error!r}")
    return problems


def _check_seed(row: dict[str, str], value: float, runs: Mapping[Run, Mapping[str, float | None]]) -> list[str]:
    what = f"per_seed.csv: {row['metric']} of {row['method']}, seed {row['seed'] or 'none'}"
    run = runs.get((row["method"], row["seed"]))
    if run is None:
        return [f"{what}: there is no such run"]
    if not run or row["metric"] in MEASURED:
        return []  # nothing could be recomputed, which is reported with the run
    recomputed = run.get(row["metric"])
    return [] if _agree(value, math.nan if recomputed is None else recomputed) else [
        f"{what} is {value}, the run gives {recomputed}"
    ]  # fmt: skip


def _check_mean(row: dict[str, str], sample: list[float]) -> list[str]:
    what = f"summary.csv: {row['metric']} of {row['method']}"
    if int(row["n"]) != len(sample):
        return [f"{what}: n is {row['n']}, per_seed.csv has {len(sample)} values"]
    mean = math.fsum(sample) / len(sample) if sample else math.nan
    stated = float(row["mean"] or "nan")
    return [] if _agree(stated, mean) else [f"{what}: the mean is {stated}, of the values it is {mean}"]


def _agree(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=1e-12) or (math.isnan(a) and math.isnan(b))


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
