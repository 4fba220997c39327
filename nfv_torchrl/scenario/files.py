"""``scenario.json``: what a run's other files lack; and a run's folder read back."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_json
from nfv_torchrl.scenario.arrivals import FILE, UNIFORM
from nfv_torchrl.scenario.config import ScenarioConfig, parse_config
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.kinds import CPU, Resource
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.settings.values import shown

# Attributes of a scenario that its JSON holds as they are; config keys of the same names.
PLAIN_KEYS = (
    "name",
    "horizon",
    "warmup",
    "arrival_rate",
    "mean_lifetime",
    "endpoints",
    "colocation",
    "mask",
    "admission_control",
    "observe_lifetime",
    "max_steps",
)
NEWER_PLAIN_KEYS: dict[str, Any] = {"placement": None, "step_budget": "request", "placing_after_chain": "masked"}
NEWER_KEYS: dict[str, Any] = {**NEWER_PLAIN_KEYS, "resources": None, "arrivals": None}
"""Keys that a file has where they are not these."""
MEAN_STAY = "file_mean_lifetime"
"""Of requests that were drawn by the laws of a file: which the run's own workload.csv does not tell."""
OTHER_KEYS = ("method", "seeds", "endpoint_pairs", "workload_path", "vnfs", "services", "failures", "failure_timeline")


class StoredRun(NamedTuple):
    """What a run's folder says about the world it ran in."""

    scenario: Scenario
    workload: Workload
    timeline: FailureTimeline
    method: str
    workload_seed: int | None


def scenario_to_json(
    scenario: Scenario, *, workload_seed: int | None, method: str, timeline: FailureTimeline
) -> dict[str, Any]:
    """All of a run but its substrate, workload and decisions, as JSON values.

    Args:
        scenario: what was run.
        workload_seed: seed of its workload, None if that came from elsewhere.
        method: name of what decided.
        timeline: the failures and repairs that were applied.
    """
    pairs, catalogue = scenario.endpoint_pairs, scenario.catalogue
    return {
        "method": method,
        "seeds": {"scenario": scenario.seed, "workload": workload_seed},
        **{key: getattr(scenario, key) for key in PLAIN_KEYS},
        "endpoint_pairs": None if pairs is None else pairs.tolist(),
        "workload_path": None if scenario.workload_path is None else str(scenario.workload_path),
        **({} if scenario.file_mean_lifetime is None else {MEAN_STAY: scenario.file_mean_lifetime}),
        **({} if scenario.arrivals in (UNIFORM, FILE) else {"arrivals": scenario.arrivals.to_config()}),
        **{key: getattr(scenario, key) for key, usual in NEWER_PLAIN_KEYS.items() if getattr(scenario, key) != usual},
        **({} if catalogue.resources == CPU else {"resources": [_shortened(kind) for kind in catalogue.resources]}),
        "vnfs": {name: dict(vnf) if isinstance(vnf, Mapping) else vnf for name, vnf in catalogue.vnfs.items()},
        "services": [{**_shortened(service), "chain": list(service.chain)} for service in catalogue.types],
        "failures": dataclasses.asdict(scenario.failures),
        "failure_timeline": timeline.to_events(scenario.substrate),
    }


def _shortened(part: ServiceType | Resource) -> dict[str, Any]:
    """Its attributes without those of the general model that are left as they are by default."""
    newer = ("rates", "ingress", "egress", "mean_lifetime", "vm_capacity", "vm_unit_cost")
    values = dataclasses.asdict(part)
    return {key: value for key, value in values.items() if key not in newer or value is not None}


def read_run_folder(folder: str | os.PathLike[str]) -> StoredRun:
    """The scenario, workload and failures of a folder with ``scenario.json``, ``substrate.json``, ``workload.csv``.

    The scenario is as it was, to the bit; if its workload came from a file, that file is now the folder's.

    Raises:
        ScenarioError: a file is missing or wrong; the message names it.
    """
    path = Path(folder) / "scenario.json"
    data = read_json(path)
    _check_keys(data, path)
    substrate = Substrate.from_json(Path(folder) / "substrate.json")
    try:
        scenario = _scenario(data, substrate)
        timeline = FailureTimeline.from_events(data["failure_timeline"], substrate)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from error
    requests = Path(folder) / "workload.csv"
    # Of few slots a sampled workload may be empty. Older folders do not say in the header that nodes are indices.
    workload = Workload.from_csv(
        requests, scenario.catalogue, substrate, scenario.horizon, allow_empty=True, numbers_are_indices=True
    )
    if data["workload_path"] is not None:
        scenario = scenario.replace(workload_path=str(requests))
        vars(scenario)[MEAN_STAY] = _mean_stay(data, path)
    return StoredRun(scenario, workload, timeline, data["method"], data["seeds"].get("workload"))


def _mean_stay(data: dict[str, Any], path: Path) -> float | None:
    mean = data.get(MEAN_STAY)
    if mean is not None and (isinstance(mean, bool) or not isinstance(mean, int | float) or not 0 < mean < math.inf):
        raise ScenarioError(f"{path}: {MEAN_STAY} is {shown(mean)}; a positive number was expected")
    return mean


def _check_keys(data: dict[str, Any], path: Path) -> None:
    known = (*PLAIN_KEYS, *OTHER_KEYS, *NEWER_KEYS, MEAN_STAY)
    for key in (*PLAIN_KEYS, *OTHER_KEYS):
        if key not in data:
            raise ScenarioError(f"{path}: {key!r} is missing; write the file again")
    for key in data:
        if key not in known:
            raise ScenarioError(f"{path}: {key!r} is unknown; known keys: {', '.join(known)}")
    seeds = data["seeds"]
    if not isinstance(seeds, dict) or "scenario" not in seeds or not isinstance(data["method"], str):
        raise ScenarioError(f"{path}: 'seeds' must hold 'scenario' and 'workload', 'method' a name")


def _scenario(data: dict[str, Any], substrate: Substrate) -> Scenario:
    config: ScenarioConfig = parse_config(
        {key: data[key] for key in (*PLAIN_KEYS, "vnfs", "services", "failures")}
        | {key: data.get(key, value) for key, value in NEWER_KEYS.items()}
        | {"seed": data["seeds"]["scenario"]}
    )
    pairs = None
    if data["endpoint_pairs"] is not None:
        try:
            pairs = np.array(data["endpoint_pairs"], np.int64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ScenarioError(f"endpoint_pairs: is no table of nodes ({error})") from error
    return Scenario(
        seed=config.seed,
        substrate=substrate,
        catalogue=ServiceCatalogue(tuple(config.services.values()), config.vnfs, config.resources),
        endpoint_pairs=pairs,
        arrivals=config.arrivals,
        **{key: getattr(config, key) for key in NEWER_PLAIN_KEYS},
        failures=config.failures,
        **{key: getattr(config, key) for key in PLAIN_KEYS},
    )
