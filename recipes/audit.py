"""Recompute every number of an evaluation from its files, and say what does not add up.

    python recipes/audit.py DIR [DIR ...]

A DIR is a run (scenario.json, substrate.json, workload.csv, decisions.jsonl, metrics.json) or any folder with runs
below it. With summary.csv, per_seed.csv and evaluation.json beside the runs these are checked too, bounds included
(--no-bounds leaves the linear programmes unsolved). What no file can prove is the wall time of decisions.
Exit code 0: nothing found; 1: problems, printed below the run they were found in.
"""

from __future__ import annotations

import argparse
import sys

from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.evaluation.bounds import recompute_bound
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.training.cli import clear_errors

NOT_RECOMPUTED = "Not recomputed: decision_seconds (wall time), only that decisions_per_second and the tables fit it."
BOUNDS_LEFT_OUT = " Nor bounds (--no-bounds)."


@clear_errors
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Recompute every number of an evaluation from its files.")
    parser.add_argument("folders", nargs="+", metavar="DIR", help="a run, or a folder with runs below it")
    parser.add_argument("--no-bounds", action="store_true", help="do not solve bounds again, which may take minutes")
    given = parser.parse_args(arguments)
    reports = audit_folders(
        given.folders,
        progress=lambda runs: ProgressBar(runs, unit="run", desc="audit"),
        recompute_bound=None if given.no_bounds else recompute_bound,
    )
    for report in reports:
        verdict = "ok" if report.clean else f"{len(report.problems)} problems"
        print(f"{report.folder}: {report.requests} requests, {verdict}")
        for problem in report.problems:
            print(f"  {problem}")
    print(NOT_RECOMPUTED + (BOUNDS_LEFT_OUT if given.no_bounds else ""))
    return 0 if all(report.clean for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
