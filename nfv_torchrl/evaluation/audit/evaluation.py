"""Checks the folder of a whole evaluation: nothing was taken out, added or changed, and its runs belong together."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nfv_torchrl.evaluation.audit.files import is_index, read_json
from nfv_torchrl.evaluation.audit.problems import Problems, UnreadableRun
from nfv_torchrl.evaluation.audit.report import AuditReport
from nfv_torchrl.evaluation.audit.tables import BOUND, Evaluation, check_tables

MANIFEST = "evaluation.json"
TABLES = ("summary.csv", "per_seed.csv")
RUN_FILES = ("scenario.json", "substrate.json", "workload.csv", "decisions.jsonl", "metrics.json")
BOUND_TOLERANCE = 1e-6
"""By which a bound may differ when its linear programme is solved again."""

RecomputeBound = Callable[[Path, str], float]
"""AAR that the bound of a name allows on the world of a run's folder."""

OF_METHOD = ("method", "mask", "admission_control")
"""Keys of scenario.json that say how a method acts, not what world it met."""
OF_SEED = ("seeds", "endpoint_pairs", "failure_timeline")
"""Keys that follow from the two seeds."""


@dataclass
class _Manifest:
    """evaluation.json. ``bounds``: the seeds of each; ``files``: SHA-256 by path below the folder."""

    methods: list[str]
    seeds: list[int | None]
    reference: str | None
    bounds: dict[str, list[int | None]]
    files: dict[str, str]


def is_evaluation(folder: Path) -> bool:
    """Whether ``folder`` holds anything that an evaluation as a whole leaves beside its runs."""
    return any((folder / name).exists() for name in (MANIFEST, *TABLES))


def check_evaluation(
    folder: Path, reports: Mapping[Path, AuditReport], recompute_bound: RecomputeBound | None
) -> AuditReport:
    """What is wrong with the evaluation in ``folder``, whose runs gave ``reports`` (by their folder)."""
    problems = Problems()
    try:
        manifest = _read_manifest(folder / MANIFEST)
    except UnreadableRun as error:
        return AuditReport(folder, [str(error)])
    runs = _named_runs(folder, manifest, reports, problems)
    _check_files(folder, manifest, problems)
    _check_worlds(runs, problems)
    if (
        runs
        and all(report.metrics for report in runs.values())
        and len(runs) == len(manifest.methods) * len(manifest.seeds)
    ):
        evaluation = Evaluation(manifest.methods, manifest.seeds, manifest.reference, manifest.bounds, runs)
        bounds = check_tables(folder, evaluation, problems)
        _check_bounds(bounds, manifest, runs, recompute_bound, problems)
    else:
        problems.add("the tables cannot be recomputed: a run is missing or cannot be replayed")
    return AuditReport(folder, problems.texts())


def _read_manifest(path: Path) -> _Manifest:
    document = read_json(path)
    expected: dict[str, Any] = {
        "methods": list, "seeds": list, "reference": (str, type(None)), "bounds": dict, "files": dict,
    }  # fmt: skip
    if document.keys() != expected.keys() or not all(isinstance(document[key], expected[key]) for key in expected):
        raise UnreadableRun(f"{path.name}: its keys are not {', '.join(expected)}, or of another kind")
    manifest = _Manifest(**document)
    lists = [manifest.seeds, *manifest.bounds.values()]
    seeds = all(isinstance(each, list) and all(seed is None or is_index(seed) for seed in each) for each in lists)
    names = all(isinstance(name, str) for name in (*manifest.methods, *manifest.files.values()))
    known = all(set(of_bound) <= set(manifest.seeds) for of_bound in manifest.bounds.values() if seeds)
    if not seeds or not known or not names or not set(manifest.methods) >= {manifest.reference or manifest.methods[0]}:
        raise UnreadableRun(f"{path.name}: methods, seeds, bounds or reference make no sense")
    return manifest


def _named_runs(
    folder: Path, manifest: _Manifest, reports: Mapping[Path, AuditReport], problems: Problems
) -> dict[tuple[str, int | None], AuditReport]:
    """The report of each (method, seed); names in a run must be those of its folder."""
    runs: dict[tuple[str, int | None], AuditReport] = {}
    for method in manifest.methods:
        for seed in manifest.seeds:
            path = folder / method / f"seed_{seed}"
            where, report = f"{method}/seed_{seed}", reports.get(path)
            if report is None:
                problems.add(f"{where}: the run is missing")
                continue
            runs[method, seed] = report
            stated = (report.scenario.get("method"), report.scenario.get("seeds", {}).get("workload"))
            if report.scenario and stated != (method, seed):
                problems.add(
                    f"{where}/scenario.json: method and workload seed are {stated}, by its folder {method, seed}"
                )
    known = {folder / method / f"seed_{seed}" for method, seed in runs}
    for path in sorted(path for path in reports if path.parent.parent == folder and path not in known):
        problems.add(f"{path.relative_to(folder)}: the run belongs to no method and seed of {MANIFEST}")
    return runs


def _check_files(folder: Path, manifest: _Manifest, problems: Problems) -> None:
    """Files are there, and as they were written."""
    runs = [f"{method}/seed_{seed}" for method in manifest.methods for seed in manifest.seeds]
    due = [*TABLES, *(f"{run}/{name}" for run in runs for name in RUN_FILES)]
    for name in due:
        path = folder / name
        if name not in manifest.files:
            problems.add(f"{MANIFEST}: {name} is missing under files")
        elif not path.is_file():
            problems.add(f"{name}: the file is missing")
        elif path.is_symlink() or _digest(path) != manifest.files[name]:
            problems.add(f"{name}: is not as it was written ({MANIFEST} has its SHA-256)")
    for name in manifest.files.keys() - set(due):
        problems.add(f"{MANIFEST}: {name[:80]} is no file of the methods and seeds it names")
    for run in runs:
        for name in sorted(path.name for path in (folder / run).glob("*") if path.name not in RUN_FILES):
            problems.add(f"{run}: {name[:80]} is no file of a run")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_worlds(runs: Mapping[tuple[str, int | None], AuditReport], problems: Problems) -> None:
    """One scenario but for what follows from seeds and methods; one network for a scenario seed."""
    first: dict[tuple[str, str], tuple[str, object]] = {}
    for (method, seed), report in runs.items():
        if not report.scenario:
            continue  # unreadable, which is reported with the run
        where = f"{method}/seed_{seed}"
        general = {key: value for key, value in report.scenario.items() if key not in (*OF_METHOD, *OF_SEED)}
        rules = [report.scenario[key] for key in OF_METHOD]
        network = report.scenario["seeds"].get("scenario")
        for name, scope, value in (
            ("scenario.json", "", general),
            (f"scenario.json ({', '.join(OF_METHOD)})", method, rules),
            ("substrate.json", f"scenario seed {network}", report.world.get("substrate.json")),
        ):
            other, expected = first.setdefault((name, scope), (where, value))
            if value != expected:
                problems.add(f"{where}/{name} differs from that of {other}")


def _check_bounds(
    bounds: Mapping[tuple[str, int | None], float],
    manifest: _Manifest,
    runs: Mapping[tuple[str, int | None], AuditReport],
    recompute: RecomputeBound | None,
    problems: Problems,
) -> None:
    best: dict[int | None, float] = defaultdict(float)
    for (_, seed), report in runs.items():
        best[seed] = max(best[seed], report.metrics.get("aar") or 0.0)
    for (name, seed), value in bounds.items():
        where = f"per_seed.csv: {BOUND} of {name}, seed {seed}"
        if name == "hindsight" and value < best[seed] * (1 - BOUND_TOLERANCE):
            problems.add(f"{where} is {value}, a method reached {best[seed]}")
        if recompute is None:
            continue
        try:
            anew = recompute(runs[manifest.methods[0], seed].folder, name)
        except (ValueError, KeyError) as error:
            problems.add(f"{where} cannot be recomputed: {error}")
            continue
        if not (abs(value - anew) <= BOUND_TOLERANCE or (math.isnan(value) and math.isnan(anew))):
            problems.add(f"{where} is {value}, recomputed it is {anew}")
