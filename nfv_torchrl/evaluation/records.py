"""What one method did on one workload, and the folder of files from which anyone can recompute it."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.folders import RUN_FILES
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.files import scenario_to_json
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import ANY
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator.reasons import NO_REASON, REASON_NAMES

FORWARD = -1
"""Function index of a step that places nothing."""
REJECT, NO_ACTION = -1, -2
"""In place of a node: the action ``reject``, and what is no action of the network at all."""
WORDS = {REJECT: "reject", NO_ACTION: "no action"}
"""Both in decision files."""


@dataclass(eq=False)
class RunRecord:
    """The decisions of one method on one workload of R requests, in arrival order.

    Walks are stored end to end: request r's steps are rows ``step_offsets[r]`` to ``step_offsets[r + 1]`` of the three
    step arrays. Those of a rejected request are what it tried: steps that passed, then the one that ended it, in whose
    place ``REJECT`` or ``NO_ACTION`` may stand.

    Raises:
        ScenarioError: an array has another length than the workload or the steps ask for.
    """

    method: str
    workload_seed: int | None
    scenario: Scenario
    workload: Workload
    timeline: FailureTimeline
    accepted: np.ndarray  # bool [R]
    reason: np.ndarray  # int8 [R], simulator.reasons.Reason, -1 where accepted
    delay_ms: np.ndarray  # float64 [R], NaN where rejected
    cost: np.ndarray  # float64 [R], $, phi of the request, NaN where rejected
    hops: np.ndarray  # int64 [R], links used, counted as often as they are used
    interrupted_at: np.ndarray  # int64 [R], slot, -1 if never
    step_offsets: np.ndarray  # int64 [R + 1]
    step_node: np.ndarray  # int32 [total steps], last of a rejected request: also REJECT or NO_ACTION
    step_vm: np.ndarray  # int32 [total steps], index of the VM on its node
    step_function: np.ndarray  # int32 [total steps], index in the chain, -1 = forward only
    seconds: float  # wall time of the decisions alone
    unproved: int | None = None  # requests answered when a search reached its limit; None: the method has none

    def __post_init__(self) -> None:
        requests, steps = len(self.workload.slot), int(self.step_offsets[-1])
        sizes = dict.fromkeys(("accepted", "reason", "delay_ms", "cost", "hops", "interrupted_at"), requests)
        sizes |= {"step_offsets": requests + 1, "step_node": steps, "step_vm": steps, "step_function": steps}
        for name, size in sizes.items():
            if getattr(self, name).shape != (size,):
                raise ScenarioError(f"run record: {name} has shape {getattr(self, name).shape}, expected ({size},)")

    @property
    def num_requests(self) -> int:
        return len(self.workload.slot)

    @property
    def decisions_per_second(self) -> float:
        """Requests answered per second of decision time; NaN when the time was not measured."""
        return self.num_requests / self.seconds if self.seconds > 0 else math.nan


def write_run(folder: str | os.PathLike[str], record: RunRecord, metrics: Mapping[str, Any]) -> Path:
    """Write the five files of a run (``RUN_FILES``) to ``folder``: all of them or none.

    The files are written to a folder of another name, which then takes the place of ``folder`` and of an older run in
    it. Their bytes depend on the arguments alone. Returns ``folder``.

    Raises:
        ScenarioError: ``folder`` exists and holds something that is not a run.
    """
    target = Path(folder)
    _refuse_strangers(target)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        (partial / "scenario.json").write_text(_pretty(_scenario_document(record)))
        record.scenario.substrate.to_json(partial / "substrate.json")
        record.workload.to_csv(partial / "workload.csv", record.scenario.catalogue)
        with (partial / "decisions.jsonl").open("w") as out:
            out.writelines(_decision_lines(record))
        (partial / "metrics.json").write_text(_pretty({key: _null_if_nan(value) for key, value in metrics.items()}))
        _put_in_place(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def read_metrics(folder: str | os.PathLike[str]) -> dict[str, float]:
    """The metrics of a run written by ``write_run``; a metric that does not exist in the run is NaN."""
    document = json.loads((Path(folder) / "metrics.json").read_text())
    return {key: math.nan if value is None else value for key, value in document.items()}


def _scenario_document(record: RunRecord) -> dict[str, Any]:
    return scenario_to_json(
        record.scenario, workload_seed=record.workload_seed, method=record.method, timeline=record.timeline
    )


def _decision_lines(record: RunRecord) -> Iterator[str]:
    """One JSON object a request. Plain lists are several times faster to walk than arrays."""
    encode = json.JSONEncoder(separators=(", ", ": "), allow_nan=False).encode
    names = [service.name for service in record.scenario.catalogue.types]
    work = record.workload
    requests = zip(
        work.slot.tolist(), work.service.tolist(), work.ingress.tolist(), work.egress.tolist(), work.lifetime.tolist(),
        record.accepted.tolist(), record.reason.tolist(), record.delay_ms.tolist(), record.cost.tolist(),
        record.interrupted_at.tolist(), strict=True,
    )  # fmt: skip
    functions = [None if f == FORWARD else f for f in record.step_function.tolist()]
    rows = zip(record.step_node.tolist(), record.step_vm.tolist(), functions, strict=True)
    steps = [list(step) if step[0] >= 0 else WORDS[step[0]] for step in rows]
    offsets = record.step_offsets.tolist()
    for row, (slot, service, ingress, egress, lifetime, accepted, reason, delay, cost, interrupted) in enumerate(
        requests
    ):
        walk = steps[offsets[row] : offsets[row + 1]]
        decision = {
            "slot": slot,
            "service": names[service],
            "ingress": ingress if ingress >= 0 else ANY,
            "egress": egress if egress >= 0 else ANY,
            "lifetime": lifetime,
            "accepted": accepted,
            "reason": None if reason == NO_REASON else REASON_NAMES[reason],
            "steps": walk if accepted else [],
            "tried": None if accepted else walk,
            "delay_ms": delay if accepted else None,
            "cost": cost if accepted else None,
            "interrupted_at": interrupted if interrupted >= 0 else None,
        }
        yield encode(decision) + "\n"


def _pretty(document: Mapping[str, Any]) -> str:
    """JSON with one key a line, and one entry a line in a list of objects."""
    lines = []
    for key, value in document.items():
        text = json.dumps(value, allow_nan=False)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n  " + ",\n  ".join(json.dumps(entry, allow_nan=False) for entry in value) + "\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _null_if_nan(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _refuse_strangers(folder: Path) -> None:
    """A run replaces an older run and nothing else: whatever a mistyped path points to stays."""
    if folder.exists() and not folder.is_dir():
        raise ScenarioError(f"{folder} is a file; a run is written to a folder, give another name")
    strangers = sorted(path.name for path in folder.iterdir() if path.name not in RUN_FILES) if folder.exists() else []
    if strangers:
        raise ScenarioError(
            f"{folder} holds {', '.join(strangers[:3])}, which is no file of a run, and is not overwritten; "
            "give another output folder or empty this one"
        )


def _put_in_place(partial: Path, target: Path) -> None:
    old = target.with_name(f".{target.name}.{os.getpid()}.old")
    if target.exists():
        target.rename(old)
    partial.rename(target)
    shutil.rmtree(old, ignore_errors=True)
