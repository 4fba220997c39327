"""Bounds of an evaluation, solved again from the files of a run. Unlike the audit this is the code that made them."""

from __future__ import annotations

from pathlib import Path

from nfv_torchrl.bounds.bound import blind_bound, hindsight_bound
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.files import read_run_folder

BOUNDS = {"hindsight": hindsight_bound, "blind": blind_bound}


def recompute_bound(folder: Path, name: str) -> float:
    """AAR that the bound ``name`` allows on the network, requests and failures of the run in ``folder``.

    Raises:
        ScenarioError: there is no bound of that name, or the folder cannot be read.
    """
    if name not in BOUNDS:
        raise ScenarioError(f"bound {name!r} is unknown; use one of {list(BOUNDS)}")
    run = read_run_folder(folder)
    return BOUNDS[name](run.scenario, run.workload, run.timeline).aar
