"""How each kind of cell is computed: from its spec to its result, plain values for a JSON file."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from hydra.utils import get_object

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.bounds import aar_bounds
from nfv_torchrl.evaluation.metrics import accepted, compute_metrics, counted_cost
from nfv_torchrl.evaluation.records import RunRecord, write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.turned_away import shares_turned_away
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.gym_training import train_maskable_ppo
from nfv_torchrl.experiments.training import drop_checkpoints, run_folder, train
from nfv_torchrl.inputs import file_digests
from nfv_torchrl.methods import Method, load_policy, methods_from_config
from nfv_torchrl.rewards import cost_scale
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator.tables import build_tables

Result = dict[str, Any]


def work(cell: Cell, store: CellStore) -> None:
    """Compute a cell whose needs are there, and keep its result.

    Raises:
        ScenarioError: a file that it depends on was changed meanwhile.
    """
    result = WORK[cell.kind](cell, store)
    spec = cell.spec
    before = spec.pop("files", {})
    if changed := [key for key, digest in file_digests(spec).items() if before.get(key) != digest]:
        raise ScenarioError(f"{', '.join(changed)}: the file was changed during the work; start again")
    store.write(cell, result)
    if cell.kind == "training":
        drop_checkpoints(cell, store)


def evaluate(cell: Cell, store: CellStore) -> Result:
    """A method on the workloads of some seeds: the metrics of each run, all audited.

    With ``scenario_seeds`` in the spec, as many, each seed's network is that of its scenario seed.
    Beside them: ``mean_steps`` of accepted requests, ``paper_reward``, what eq. reward_f with both weights 1 pays in
    all for an accepted request, ``frames``, the decisions of the whole horizon, and with ``turned_away`` in the spec
    ``turned_away/SERVICE``.

    Raises:
        AuditError: the audit found something.
    """
    spec = cell.spec
    scenarios = _scenarios(spec)
    records = run_method(scenarios, _method(cell, store, scenarios, compiled=True), spec["seeds"])
    metrics = {}
    for record in records:
        frames = int(record.step_offsets[-1])
        run = {**_audited(record), **_walks(record), "frames": frames}
        metrics[str(record.workload_seed)] = run | (shares_turned_away(record) if spec.get("turned_away") else {})
    _write_costs(store.path(cell).with_suffix(".npz"), records)
    return {"rho": fmean(scenario.offered_load() for scenario in scenarios), "metrics": metrics}


def bound(cell: Cell, store: CellStore) -> Result:
    """Upper bounds on AAR of every seed."""
    scenarios, seeds = _scenarios(cell.spec), cell.spec["seeds"]
    bounds: dict[str, dict[str, float]] = {}
    worlds = scenarios if len(scenarios) > 1 else scenarios * len(seeds)
    for scenario, seed in zip(worlds, seeds, strict=True):
        for kind, aar in aar_bounds(scenario, seed).items():
            bounds.setdefault(kind, {})[str(seed)] = aar
    return {"rho": fmean(scenario.offered_load() for scenario in scenarios), "bounds": bounds}


def presence(cell: Cell, store: CellStore) -> Result:
    """Share of the users of every seed's workload who are still there some slots after they came."""
    scenario = Scenario.from_config(cell.spec["scenario"])
    shares = {}
    for seed in cell.spec["seeds"]:
        workload = scenario.workload(seed)
        stay = np.sort(workload.departure - workload.slot)
        gone = np.searchsorted(stay, cell.spec["slots"], side="right")
        shares[str(seed)] = (1 - gone / len(stay)).tolist()
    return {"shares": shares}


def timing(cell: Cell, store: CellStore) -> Result:
    """Processor seconds per request of a method that decides for one network at a time, for every seed."""
    scenario = Scenario.from_config(cell.spec["scenario"])
    method = _method(cell, store, scenario)
    seconds = {}
    for seed in cell.spec["seeds"]:
        (record,) = run_method(scenario, method, [seed], clock=time.process_time)
        _audited(record)
        seconds[str(seed)] = record.seconds / max(record.num_requests, 1)
    return {"rho": scenario.offered_load(), "seconds_per_request": seconds}


WORK: dict[str, Callable[[Cell, CellStore], Result]] = {
    "evaluation": evaluate,
    "bound": bound,
    "presence": presence,
    "timing": timing,
    "training": train,
    "maskable_ppo": train_maskable_ppo,
}


def _scenarios(spec: Mapping[str, Any]) -> list[Scenario]:
    """The scenario of all seeds, or one for each of ``scenario_seeds``."""
    if not spec.get("scenario_seeds"):
        return [Scenario.from_config(spec["scenario"])]
    return [Scenario.from_config({**spec["scenario"], "seed": seed}) for seed in spec["scenario_seeds"]]


def _method(cell: Cell, store: CellStore, scenario: Scenario | Sequence[Scenario], *, compiled: bool = False) -> Method:
    """The method of a cell; a trained one with its policy file, which is in the folder of the run that it needs.

    ``compiled``: see ``load_policy``; not where its time is what is measured.
    """
    spec = cell.spec
    config = dict(spec["method"])
    if get_object(config["_target_"]) is load_policy:
        config["compiled"] = compiled
    if spec.get("training") is not None:
        (run,) = cell.needs
        config["path"] = str(run_folder(run, store) / spec["training"]["policy"])
    (method,) = methods_from_config({"method": config}, scenario)
    return method


def _audited(record: RunRecord) -> dict[str, float]:
    """The metrics of a run that was written to files and recomputed from them."""
    metrics = compute_metrics(record)
    with tempfile.TemporaryDirectory(prefix="cell_") as temporary:
        folder = Path(temporary) / record.method / f"seed_{record.workload_seed}"
        write_run(folder, record, metrics)
        audit_run(folder).raise_if_problems()
    return metrics


def _walks(record: RunRecord) -> dict[str, float]:
    mine = accepted(record)
    steps = np.diff(record.step_offsets)[mine]
    tables = build_tables([record.scenario.substrate], record.scenario.catalogue)
    reference = cost_scale(tables, np.zeros(1, np.int64)).step[0]
    if not steps.size:
        return {"mean_steps": float("nan"), "paper_reward": float("nan")}
    return {
        "mean_steps": float(steps.mean()),
        "paper_reward": float((steps - record.cost[mine] / reference).mean()),
    }


def _write_costs(path: Path, records: list[RunRecord]) -> None:
    """What every request cost ($, NaN if rejected or in the warm-up), to compare methods request by request."""
    costs = {str(record.workload_seed): counted_cost(record).astype(np.float32) for record in records}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez_compressed(partial, **costs)  # type: ignore[arg-type]
    partial.replace(path)


def read_costs(cell: Cell, store: CellStore) -> Mapping[str, np.ndarray]:
    """By seed, float32 [R]: what every request cost in an evaluation ($, NaN if rejected or in the warm-up)."""
    with np.load(store.path(cell).with_suffix(".npz")) as arrays:
        return {seed: arrays[seed] for seed in arrays.files}
