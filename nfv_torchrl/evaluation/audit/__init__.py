"""Recomputes a run from its files alone and says what does not add up.

It shares no code with the simulator, the metrics or the readers of scenarios: what it checks against is written down
here a second time, in plain Python.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nfv_torchrl.errors import AuditError
from nfv_torchrl.evaluation.audit.files import RunFiles, read_run
from nfv_torchrl.evaluation.audit.problems import UnreadableRun
from nfv_torchrl.evaluation.audit.recompute import compare, recompute_metrics
from nfv_torchrl.evaluation.audit.replay import replay
from nfv_torchrl.evaluation.audit.summary import check_summary

OF_METHOD = ("method", "mask", "admission_control")
"""Keys of scenario.json that say how a method acts, not what world it met."""


@dataclass
class AuditReport:
    """What the audit of one folder found: ``problems`` in words, empty if all is well, and the metrics anew.

    ``metrics`` is empty where nothing could be recomputed; ``seed`` is the workload seed as text, empty without one.
    """

    folder: Path
    problems: list[str]
    metrics: dict[str, float | None] = field(default_factory=dict)
    requests: int = 0
    method: str = ""
    seed: str = ""

    @property
    def clean(self) -> bool:
        return not self.problems

    def raise_if_problems(self) -> None:
        """Do nothing if all is well.

        Raises:
            AuditError: there are problems; the message lists them.
        """
        if self.problems:
            raise AuditError("\n  ".join([f"{self.folder}: the audit found", *self.problems]))


def audit_run(folder: str | os.PathLike[str]) -> AuditReport:
    """Recompute the run in ``folder`` (scenario.json, substrate.json, workload.csv, decisions.jsonl, metrics.json).

    Checked: every request is answered once and in order; every hop is a link or a permitted stay; functions in order;
    walks end at the egress; capacities, exactly, with all running requests at every moment; delays, departures,
    failures and interruptions, costs; every metric.
    """
    path = Path(folder)
    try:
        return _recompute(path, read_run(path))
    except UnreadableRun as error:
        return AuditReport(path, [str(error)])
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # Files may hold anything: what nobody thought of is a problem of this run, and others are audited still.
        return AuditReport(path, [f"the files cannot be replayed: {error!r}"])


def _recompute(path: Path, files: RunFiles) -> AuditReport:
    run = replay(files)
    metrics = {} if run is None else recompute_metrics(files, run)
    if run is not None:
        compare(files, metrics)
    seed = files.scenario["seeds"].get("workload")
    return AuditReport(
        path,
        files.problems.texts(),
        metrics,
        requests=len(files.workload),
        method=files.scenario["method"],
        seed="" if seed is None else str(seed),
    )


def find_runs(root: str | os.PathLike[str]) -> list[Path]:
    """The run folders at or below ``root``, sorted; hidden folders (a run being written) are left out."""
    found = {path.parent for name in ("decisions.jsonl", "scenario.json") for path in Path(root).rglob(name)}
    return sorted(path for path in found if not any(part.startswith(".") for part in path.relative_to(root).parts))


def audit_folders(
    roots: Sequence[str | os.PathLike[str]], progress: Callable[[list[Path]], Iterable[Path]] = iter
) -> list[AuditReport]:
    """Audit all runs at or below ``roots``, and that the methods of one evaluation met the same world.

    Args:
        roots: folders; one that holds no run is reported as a problem.
        progress: wraps the list of run folders to show how far the audit is (``tqdm``).

    Returns:
        One report a run, and one for each summary.csv that does not fit its runs.
    """
    runs = {root: find_runs(root) for root in roots}
    reports = [AuditReport(Path(root), ["no run in this folder"]) for root, found in runs.items() if not found]
    folders = sorted({folder for found in runs.values() for folder in found})
    reports += [audit_run(folder) for folder in progress(folders)]
    by_folder = {report.folder: report for report in reports}
    for folder, problem in _other_worlds(folders):
        by_folder[folder].problems.append(problem)
    for root, found in runs.items():
        for output in sorted({folder.parent.parent for folder in found}):
            # Only where all runs of the evaluation were audited, not where one of them was asked for.
            if output.is_relative_to(root) and (output / "summary.csv").exists():
                here = {(r.method, r.seed): r.metrics for r in reports if r.folder.parent.parent == output}
                problems = check_summary(output, here)
                reports += [AuditReport(output / "summary.csv", problems)] if problems else []
    return reports


def _other_worlds(folders: list[Path]) -> list[tuple[Path, str]]:
    """Runs OUTPUT/METHOD/SEED whose network, requests or scenario are not those of another METHOD for that SEED."""
    same_seed: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for folder in folders:
        same_seed[folder.parent.parent, folder.name].append(folder)
    problems = []
    for group in same_seed.values():
        for folder in group[1:]:
            for name in ("scenario.json", "substrate.json", "workload.csv"):
                if _world(group[0] / name) != _world(folder / name):
                    problems.append((folder, f"{name} differs from that of {group[0].parent.name} for the same seed"))
    return problems


def _world(path: Path) -> object:
    """The content of a file, of scenario.json without :data:`OF_METHOD`. None if unreadable: reported elsewhere."""
    try:
        content = path.read_bytes()
        if path.name != "scenario.json":
            return content
        return {key: value for key, value in json.loads(content).items() if key not in OF_METHOD}
    except (OSError, ValueError, AttributeError):
        return None
