"""Writes summary.csv and per_seed.csv of an evaluation anew and compares them, row by row, with those in its folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from nfv_torchrl.evaluation.audit.files import read_csv
from nfv_torchrl.evaluation.audit.intervals import Row, mean_row, ratio_row
from nfv_torchrl.evaluation.audit.problems import Problems, UnreadableRun
from nfv_torchrl.evaluation.audit.recompute import TOLERANCE, is_measured
from nfv_torchrl.evaluation.audit.report import AuditReport
from nfv_torchrl.vocabulary import PER_SEED_COLUMNS, SUMMARY_COLUMNS, TABLE

BOUND = TABLE["aar_bound"].name
MYOPIC = "myopic_optimal"
SMALLEST_GAP = 1e-3
"""Bound and `myopic_optimal` closer than this leave no gap of which a share could be closed."""

Key = tuple[str, ...]
Cells = dict[str, "float | str"]
"""Cells of a row by column, beside those that name it; numbers are compared as numbers."""


@dataclass(frozen=True)
class Evaluation:
    """What evaluation.json names, and the report of every (method, seed)."""

    methods: list[str]
    seeds: list[int | None]
    reference: str | None
    bounds: dict[str, list[int | None]]
    runs: Mapping[tuple[str, int | None], AuditReport]

    def values(self, method: str, metric: str) -> list[float]:
        """Of each seed, NaN where the metric does not exist. Wall times are taken as the run states them."""
        return [_value(self.runs[method, seed], metric) for seed in self.seeds]

    def metrics(self) -> list[str]:
        """In the order in which the runs state them."""
        return list(dict.fromkeys(key for run in self.runs.values() for key in run.stated))


def check_tables(folder: Path, evaluation: Evaluation, problems: Problems) -> dict[tuple[str, int | None], float]:
    """Report what is wrong with the two tables. Returns the bounds as per_seed.csv states them, by name and seed."""
    per_seed = _read(folder / "per_seed.csv", PER_SEED_COLUMNS, ("method", "seed", "metric"), problems)
    bounds = {
        (name, seed): _number(per_seed.get((name, _text(seed), BOUND), {}).get("value", ""))
        for name, seeds in evaluation.bounds.items()
        for seed in seeds
    }
    _compare("per_seed.csv", dict(_per_seed(evaluation, bounds)), per_seed, problems)
    summary = _read(folder / "summary.csv", SUMMARY_COLUMNS, ("method", "metric", "reference"), problems)
    _compare("summary.csv", dict(_summary(evaluation, bounds)), summary, problems)
    return bounds


def _read(path: Path, columns: tuple[str, ...], names: Key, problems: Problems) -> dict[Key, dict[str, str]]:
    """The rows by the cells that name them."""
    rows: dict[Key, dict[str, str]] = {}
    try:
        for line, cells in read_csv(path, list(columns))[0]:
            row = dict(zip(columns, cells, strict=False))
            key = tuple(row.get(name, "") for name in names)
            if len(cells) != len(columns) or key in rows:
                problems.add(f"{path.name} line {line}: a row with the same name, or of {len(cells)} cells")
            rows[key] = row
    except UnreadableRun as error:
        problems.add(str(error))
    return rows


def _per_seed(evaluation: Evaluation, bounds: Mapping[tuple[str, int | None], float]) -> Iterator[tuple[Key, Cells]]:
    worlds: dict[int | None, Cells] = {}
    for (method, seed), run in evaluation.runs.items():
        worlds[seed] = {
            "scenario_seed": str(run.scenario["seeds"].get("scenario")), "rho": _value(run, "rho"),
        }  # fmt: skip
        for metric in run.stated:
            yield (method, _text(seed), metric), {"value": _value(run, metric), **worlds[seed]}
    for (name, seed), value in bounds.items():
        yield (name, _text(seed), BOUND), {"value": value, **worlds.get(seed, {})}


def _summary(evaluation: Evaluation, bounds: Mapping[tuple[str, int | None], float]) -> Iterator[tuple[Key, Cells]]:
    about = next(iter(evaluation.runs.values())).scenario
    same: Cells = {"scenario": str(about.get("name"))}
    same |= {key: str(int(about[key])) for key in ("colocation", "observe_lifetime")}
    for method in evaluation.methods:
        for metric in evaluation.metrics():
            yield (method, metric, ""), _cells(mean_row(evaluation.values(method, metric))) | same
        if evaluation.reference not in (None, method):
            for metric, row in _paired(evaluation, method, evaluation.reference or ""):
                yield (method, metric, evaluation.reference or ""), _cells(row) | same
        for name in evaluation.bounds:
            closed = _gap_closed(evaluation, method, {seed: x for (bound, seed), x in bounds.items() if bound == name})
            if closed is not None:
                yield (method, "gap_closed", name), _cells(closed) | same
    for name in evaluation.bounds:
        values = [value for (bound, _), value in bounds.items() if bound == name]
        yield (name, BOUND, ""), _cells(mean_row(values)) | same


def _paired(evaluation: Evaluation, method: str, reference: str) -> Iterator[tuple[str, Row]]:
    pairs = list(zip(evaluation.values(method, "aar"), evaluation.values(reference, "aar"), strict=True))
    yield "aar_difference", mean_row([x - y for x, y in pairs])
    ratio = ratio_row(pairs)
    yield "aar_relative_difference", Row(ratio.mean - 1, ratio.low - 1, ratio.high - 1, ratio.n)
    runs = evaluation.runs
    costs = [_paired_cost(runs[method, seed], runs[reference, seed]) for seed in evaluation.seeds]
    yield "paired_cost", mean_row(costs)


def _paired_cost(run: AuditReport, other: AuditReport) -> float:
    """Sum of phi over the requests that both accept, as a ratio."""
    both = [(x, y) for x, y in zip(run.costs, other.costs, strict=False) if not (math.isnan(x) or math.isnan(y))]
    below = math.fsum(y for _, y in both)
    return math.fsum(x for x, _ in both) / below if below else math.nan


def _gap_closed(evaluation: Evaluation, method: str, bound: Mapping[int | None, float]) -> Row | None:
    if MYOPIC not in evaluation.methods:
        return None
    pairs = []
    for seed, limit in bound.items():
        start = _value(evaluation.runs[MYOPIC, seed], "aar")
        pairs.append((_value(evaluation.runs[method, seed], "aar") - start, limit - start))
    mean = math.fsum(gap for _, gap in pairs) / len(pairs) if pairs else 0.0
    return None if mean < SMALLEST_GAP else ratio_row(pairs)


def _compare(
    name: str, expected: Mapping[Key, Cells], found: Mapping[Key, Mapping[str, str]], problems: Problems
) -> None:
    for key in expected.keys() - found.keys():
        problems.add(f"{name}: the row {', '.join(filter(None, key))} is missing")
    for key in found.keys() - expected.keys():
        problems.add(f"{name}: the row {', '.join(filter(None, key))} belongs to nothing in the evaluation")
    if expected.keys() == found.keys() and list(expected) != list(found):
        problems.add(f"{name}: the rows are not in the order in which they were written")
    for key in (key for key in expected if key in found):
        widest = max((abs(x) for x in expected[key].values() if isinstance(x, float) and math.isfinite(x)), default=0.0)
        for column, value in expected[key].items():
            stated = found[key].get(column, "")
            if not _agree(stated, value, widest if name == "summary.csv" else 0.0):
                what = f"{name}: {column} of {', '.join(filter(None, key))}"
                problems.add(f"{what} is {stated or 'empty'}, it should be {_shown(value)}")


def _agree(stated: str, value: float | str, scale: float) -> bool:
    """``scale``: ends of an interval are differences of numbers of that size, and as precise as these."""
    if isinstance(value, str):
        return stated == value
    if not math.isfinite(value):
        return stated == ""
    return math.isclose(_number(stated), value, rel_tol=TOLERANCE, abs_tol=max(TOLERANCE * scale, 1e-12))


def _cells(row: Row) -> Cells:
    return {"mean": row.mean, "ci_low": row.low, "ci_high": row.high, "n": str(row.n)}


def _value(run: AuditReport, metric: str) -> float:
    value = run.stated.get(metric) if is_measured(metric) else run.metrics.get(metric)
    return float(value) if isinstance(value, (int, float)) else math.nan


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _text(seed: int | None) -> str:
    return "" if seed is None else str(seed)


def _shown(value: float | str) -> str:
    return value if isinstance(value, str) else "empty" if math.isnan(value) else repr(value)
