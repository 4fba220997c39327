"""Recomputes runs and evaluations from their files alone and says what does not add up.

It shares no code with the simulator, the metrics, the tables or the readers of scenarios: what it checks against is
written down here a second time, in plain Python.
"""

from __future__ import annotations

import contextlib
import csv
import gc
import hashlib
import math
import os
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from nfv_torchrl.evaluation.audit.drawn import check_drawn
from nfv_torchrl.evaluation.audit.evaluation import (
    MANIFEST,
    OF_METHOD,
    TABLES,
    RecomputeBound,
    check_evaluation,
    is_evaluation,
)
from nfv_torchrl.evaluation.audit.files import RunFiles, read_run
from nfv_torchrl.evaluation.audit.problems import UnreadableRun
from nfv_torchrl.evaluation.audit.recompute import compare, recompute_metrics
from nfv_torchrl.evaluation.audit.replay import Replayed, replay
from nfv_torchrl.evaluation.audit.report import AuditReport

__all__ = ["AuditReport", "audit_folders", "audit_run", "find_runs"]

UNEXPECTED = (
    ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError, MemoryError, OSError,
    csv.Error,
)  # fmt: skip
"""Errors that unforeseen files may cause: each is a problem of its folder, and the others are still audited."""


@contextlib.contextmanager
def _collector_paused() -> Iterator[None]:
    """No search for garbage in cycles: an audit makes none, and the search takes a third of its time."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


@_collector_paused()
def audit_run(folder: str | os.PathLike[str]) -> AuditReport:
    """Recompute the run in ``folder`` (scenario.json, substrate.json, workload.csv, decisions.jsonl, metrics.json).

    Checked: every request is answered once and in order; every hop is a link or a permitted stay; functions in order;
    walks end at the egress; capacities, exactly, with all running requests at every moment; delays, departures,
    failures and interruptions, costs; the reason of every rejection; every metric but the wall time of decisions.
    """
    path = Path(folder)
    try:
        return _recompute(path, read_run(path))
    except UnreadableRun as error:
        return AuditReport(path, [str(error)])
    except UNEXPECTED as error:
        return AuditReport(path, [f"the files cannot be replayed: {error!r:.300}"])


def _recompute(path: Path, files: RunFiles) -> AuditReport:
    check_drawn(files)
    run = replay(files)
    metrics = {} if run is None else recompute_metrics(files, run)
    if run is not None:
        compare(files, metrics)
    return AuditReport(
        path,
        files.problems.texts(),
        metrics,
        requests=len(files.workload),
        costs=array("d") if run is None else _costs(files, run),
        scenario=files.scenario,
        stated=files.metrics,
        world=_world(path, files),
    )


def _costs(files: RunFiles, run: Replayed) -> array[float]:
    first = files.scenario["warmup"]
    counted = (answer.accepted and answer.request.slot >= first for answer in run.answers)
    costs = (answer.walk.cost for answer in run.answers)
    return array("d", (cost if mine else math.nan for cost, mine in zip(costs, counted, strict=True)))


def _world(path: Path, files: RunFiles) -> dict[str, object]:
    """What every method meets alike under one seed."""
    return {
        "scenario.json": {key: value for key, value in files.scenario.items() if key not in OF_METHOD},
        **{name: hashlib.sha256((path / name).read_bytes()).digest() for name in ("substrate.json", "workload.csv")},
    }


def find_runs(root: str | os.PathLike[str]) -> list[Path]:
    """The run folders at or below ``root``, sorted; hidden folders (a run being written) are left out."""
    found = {path.parent for name in ("decisions.jsonl", "scenario.json") for path in Path(root).rglob(name)}
    return sorted(path for path in found if not any(part.startswith(".") for part in path.relative_to(root).parts))


def audit_folders(
    roots: Sequence[str | os.PathLike[str]],
    progress: Callable[[list[Path]], Iterable[Path]] = iter,
    recompute_bound: RecomputeBound | None = None,
) -> list[AuditReport]:
    """Audit all runs at or below ``roots``, and each evaluation of which all runs are among them.

    Args:
        roots: folders; one that holds no run is reported as a problem.
        progress: wraps the list of run folders to show how far the audit is (``ProgressBar``).
        recompute_bound: solves a bound again; without it bounds are only compared with the runs.

    Returns:
        One report a run, and one for each evaluation that does not fit its runs.
    """
    found = {Path(root): find_runs(root) for root in roots}
    evaluations = {output for root, runs in found.items() for output in _outputs(root, runs)}
    reports = [
        AuditReport(root, ["no run in this folder"])
        for root, runs in found.items()
        if not runs and root not in evaluations
    ]
    folders = sorted({folder for runs in found.values() for folder in runs})
    by_folder = {folder: audit_run(folder) for folder in progress(folders)}
    reports += by_folder.values()
    _report_other_worlds(by_folder)
    for output in sorted(evaluations):
        report = _audit_evaluation(output, by_folder, recompute_bound)
        reports += [] if report.clean else [report]
    return reports


def _outputs(root: Path, runs: Sequence[Path]) -> set[Path]:
    """The evaluations at or below ``root``, with or without runs; not one of which a single run was asked for."""
    folders = {run.parent.parent for run in runs} | {
        path.parent for name in (MANIFEST, *TABLES) for path in root.rglob(name)
    }
    return {folder for folder in folders if folder.is_relative_to(root) and is_evaluation(folder)}


def _audit_evaluation(
    folder: Path, reports: dict[Path, AuditReport], recompute_bound: RecomputeBound | None
) -> AuditReport:
    try:
        return check_evaluation(folder, reports, recompute_bound)
    except UNEXPECTED as error:
        return AuditReport(folder, [f"the evaluation cannot be checked: {error!r:.300}"])


def _report_other_worlds(reports: dict[Path, AuditReport]) -> None:
    """Runs OUTPUT/METHOD/SEED whose network, requests or scenario are not those of another METHOD for that SEED."""
    same_seed: dict[tuple[Path, str], list[AuditReport]] = defaultdict(list)
    for folder, report in reports.items():
        if report.world:
            same_seed[folder.parent.parent, folder.name].append(report)
    for first, *others in same_seed.values():
        for report in others:
            for name, content in report.world.items():
                if content != first.world[name]:
                    of = first.folder.parent.name
                    report.problems.append(f"{name} differs from that of {of} for the same seed")
