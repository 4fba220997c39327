"""Recompute every number of an evaluation from its files, and say what does not add up.

    python recipes/audit.py DIR [DIR ...]

A DIR is a run (scenario.json, substrate.json, workload.csv, decisions.jsonl, metrics.json) or any folder with runs
below it. Exit code 0: nothing found; 1: problems, printed below the run they were found in.
"""

from __future__ import annotations

import argparse
import sys

from tqdm import tqdm

from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.training.cli import clear_errors


@clear_errors
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Recompute every number of an evaluation from its files.")
    parser.add_argument("folders", nargs="+", metavar="DIR", help="a run, or a folder with runs below it")
    folders = parser.parse_args(arguments).folders
    reports = audit_folders(folders, progress=lambda runs: tqdm(runs, unit="run", desc="audit", disable=None))
    for report in reports:
        verdict = "ok" if report.clean else f"{len(report.problems)} problems"
        print(f"{report.folder}: {report.requests} requests, {verdict}")
        for problem in report.problems:
            print(f"  {problem}")
    return 0 if all(report.clean for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
