"""Upper bounds on AAR of an evaluation, and the same solved again from the files of a run.

Unlike the audit, solving them again takes the code that made them.
"""

from __future__ import annotations

from pathlib import Path

from nfv_torchrl.bounds.bound import blind_bound, blind_bound_applies, hindsight_bound
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.scenario import Scenario

BOUNDS = {"hindsight": hindsight_bound, "blind": blind_bound}


def aar_bounds(scenario: Scenario, seed: int) -> dict[str, float]:
    """Upper bounds on AAR on the workload of ``seed``, by name of the bound.

    ``hindsight`` knows all requests in advance. ``blind`` does not know lifetimes: it is there where methods do not see
    them either, and where they are drawn, by the scenario or by the laws of a file, since it needs to know from what.
    """
    workload, timeline = scenario.workload(seed), scenario.failure_timeline(seed)
    bounds = BOUNDS if blind_bound_applies(scenario) else {"hindsight": hindsight_bound}
    return {name: bound(scenario, workload, timeline).aar for name, bound in bounds.items()}


def recompute_bound(folder: Path, name: str) -> float:
    """AAR that the bound ``name`` allows on the network, requests and failures of the run in ``folder``.

    Raises:
        ScenarioError: there is no bound of that name, or the folder cannot be read.
    """
    if name not in BOUNDS:
        raise ScenarioError(f"bound {name!r} is unknown; use one of {list(BOUNDS)}")
    run = read_run_folder(folder)
    return BOUNDS[name](run.scenario, run.workload, run.timeline).aar
