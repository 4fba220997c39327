"""Frozen benchmarks: which networks and requests they are, and how decisions of any program are scored on them.

    nfv-torchrl score DECISIONS.jsonl --manifest docs/benchmark/chains.json --run waxman_100-0.14-seed_0

A manifest has, for every run, the scenario with its seed, the SHA-256 of the network and of the requests that follow
from it, and what methods reached there. Decisions are played in the simulator, audited, and shown beside these.

A decisions file has a JSON object a line, one for each request in order of arrival: ``{"accepted": false}``, or
``{"accepted": true, "steps": [[node, VM, function], ...]}`` as ``decisions.jsonl`` of an evaluation has it: the nodes
of the walk by index with a VM there, and the place in the chain (from 0) of the function that is put there, null where
the walk only passes. Other keys are not read.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.errors import AuditError, ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import RunRecord, write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.files import read_json, write_atomically
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator.reasons import REASON_NAMES
from nfv_torchrl.simulator.state import World
from nfv_torchrl.vocabulary import TABLE

FORMAT = "nfv_torchrl benchmark 1"
SHOWN = ("aar", "lrc", "lar", "cost_per_accepted", "mean_hops")
"""What a row has, where the requests have it."""
LARGEST_FILE, MOST_SHOWN = 2 << 30, 5
"""Bytes of a decisions file; refused decisions that are told one by one."""
GENERATORS = ("nfv_torchrl.scenario.waxman.draw_waxman", "nfv_torchrl.scenario.nfvdeep_network.draw_nfvdeep")
"""What a manifest, which may be a stranger's, may have drawn its network by. Any other name could run any code."""
KEYS = {"scenario": dict, "seed": int, "substrate_sha256": str, "workload_sha256": str, "rows": dict}
"""What a manifest says of every run."""
Walks = list[list[list[Any]] | None]
"""Of every request its steps [node, VM, function or None]; None: refused."""


class GivenPlans(Planner):
    """The walks of a decisions file, for one environment.

    Args:
        walks: of every request in order of arrival its steps (node, VM, function or None); None: refused.
        name: of the file, for errors.
    """

    def __init__(self, walks: Sequence[Sequence[Sequence[Any]] | None], name: str) -> None:
        self.walks, self.name = walks, name

    def prepare(self, world: World) -> None:
        """See ``Planner``."""
        self._next = 0

    def plan(self, world: World, b: int, plan: np.ndarray) -> int:
        """See ``Planner``.

        Raises:
            ScenarioError: a step names no VM of the network, or a walk is longer than the scenario allows.
        """
        walk, line = self.walks[self._next], self._next + 1
        self._next += 1
        if walk is None:
            return 0
        if len(walk) > plan.size:
            raise ScenarioError(f"{self.name}: line {line}: {len(walk)} steps; the scenario allows {plan.size}")
        _, nodes, vms, _ = world.tables.vm_capacity.shape
        for k, (node, vm, function) in enumerate(walk):
            if not (0 <= node < nodes and 0 <= vm < vms):
                raise ScenarioError(f"{self.name}: line {line}: [{node}, {vm}] is no node and VM of the network")
            plan[k] = encode_action(node, vm, function is not None, vms)
        return len(walk)


def read_decisions(path: Path, requests: int) -> Walks:
    """The walks of a decisions file, None where a request was refused.

    Raises:
        ScenarioError: it cannot be read, a line is malformed, or it does not answer as many requests.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ScenarioError(f"{path}: larger than {LARGEST_FILE >> 30} GB; give the decisions of one run")
        with path.open(encoding="utf-8") as file:
            walks = [_walk(path, number, line) for number, line in enumerate(file, 1) if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read ({error}); give a decisions.jsonl") from error
    if len(walks) != requests:
        raise ScenarioError(
            f"{path}: answers {len(walks)} requests, and the run has {requests}; give one line for each"
        )
    return walks


def _walk(path: Path, number: int, line: str) -> list[list[Any]] | None:
    try:
        decision = json.loads(line)
    except (ValueError, RecursionError):
        raise ScenarioError(f"{path}: line {number} is no JSON; give one object a line") from None
    if not isinstance(decision, dict) or not isinstance(decision.get("accepted"), bool):
        raise ScenarioError(f'{path}: line {number} has no "accepted" that is true or false')
    if not decision["accepted"]:
        return None
    steps, placed = decision.get("steps"), 0
    if not isinstance(steps, list) or not steps:
        raise ScenarioError(f'{path}: line {number} is accepted and has no "steps"')
    for step in steps:
        whole = isinstance(step, list) and len(step) == 3 and all(type(part) is int for part in step[:2])
        if not whole or not (step[2] is None or step[2] == placed):
            raise ScenarioError(
                f"{path}: line {number}: step {json.dumps(step):.60}; use [node, VM, function], functions 0, 1, ... in "
                "order or null"
            )
        placed += step[2] is not None
    return steps


def build(entry: Mapping[str, Any], where: str, overrides: Mapping[str, str] | None = None) -> tuple[Scenario, int]:
    """Scenario and workload seed of a run of a manifest, checked to be those that were frozen.

    Args:
        entry: of the manifest.
        where: manifest and run, for errors.
        overrides: other places of its files: ``substrate`` and ``workload``.

    Raises:
        ScenarioError: an entry that is none, a network drawn by code that is not listed, or this version or these files
            give another network or other requests.
    """
    _check_entry(entry, where)
    config = json.loads(json.dumps(entry["scenario"]))
    for part, path in (overrides or {}).items():
        config[part]["path"] = path
    scenario, seed = Scenario.from_config(config), entry["seed"]
    found = digests(scenario, seed)
    for part, digest in found.items():
        if digest != entry[part]:
            raise ScenarioError(
                f"{where}: the {part.partition('_')[0]} is not the one that was frozen (SHA-256 {digest[:12]}..., not "
                f"{entry[part][:12]}...); use the files and the version that the manifest was made with"
            )
    return scenario, seed


def _check_entry(entry: Any, where: str) -> None:
    """Before anything of it is used: a manifest may come from anywhere."""
    for key, kind in KEYS.items():
        if not isinstance(entry, dict) or not isinstance(entry.get(key), kind):
            raise ScenarioError(f"{where}: {key!r} is missing or of the wrong kind; give a manifest as it was frozen")
    unknown = [name for name in _targets(entry["scenario"]) if name not in GENERATORS]
    if unknown:
        raise ScenarioError(
            f"{where}: its network is drawn by {unknown[0]!r:.100}, and a manifest may name {', '.join(GENERATORS)}; "
            "write the network to a file and name that"
        )


def _targets(part: Any) -> Iterator[Any]:
    """Everything in a config that would be imported and called."""
    if isinstance(part, dict):
        yield from (value for key, value in part.items() if key == "_target_")
    for inner in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from _targets(inner)


def digests(scenario: Scenario, seed: int) -> dict[str, str]:
    """SHA-256 of ``substrate.json`` and ``workload.csv`` as an evaluation writes them."""
    with tempfile.TemporaryDirectory(prefix="digest_") as folder:
        scenario.substrate.to_json(Path(folder, "substrate"))
        scenario.workload(seed).to_csv(Path(folder, "workload"), scenario.catalogue)
        return {
            f"{name}_sha256": hashlib.sha256(Path(folder, name).read_bytes()).hexdigest()
            for name in ("substrate", "workload")
        }


def score(
    decisions: Path, entry: Mapping[str, Any], where: str, overrides: Mapping[str, str] | None = None
) -> tuple[RunRecord, Walks]:
    """What decisions of any program amount to on a run of a manifest, audited; and the decisions.

    Raises:
        ScenarioError: see ``read_decisions``, ``build``, ``GivenPlans.plan``.
        AuditError: the audit found something.
    """
    scenario, seed = build(entry, where, overrides)
    walks = read_decisions(decisions, len(scenario.workload(seed)))
    method = PlannerMethod(GivenPlans(walks, str(decisions)), name="decisions")
    (record,) = run_method(scenario, method, [seed])
    with tempfile.TemporaryDirectory(prefix="score_") as folder:
        run = Path(folder) / "decisions" / f"seed_{seed}"
        write_run(run, record, compute_metrics(record))
        audit_run(run).raise_if_problems()
    return record, walks


def refused(record: RunRecord, walks: Walks) -> list[str]:
    """Requests that the file accepts and the rules do not, for people."""
    lines = [number for number, walk in enumerate(walks) if walk is not None and not record.accepted[number]]
    told = [f"line {number + 1}: {REASON_NAMES[record.reason[number]]}" for number in lines[:MOST_SHOWN]]
    return told + ([f"and {len(lines) - MOST_SHOWN} more"] if len(lines) > MOST_SHOWN else [])


def score_table(record: RunRecord, entry: Mapping[str, Any], run: str) -> Table:
    """The row of the decisions, and below it what the manifest has of other methods."""
    own = compute_metrics(record)
    rows = {"these decisions": own, **entry["rows"]}
    shown = [key for key in SHOWN if own.get(key) is not None and own[key] == own[key]]
    heads = [TABLE[key].head or key for key in shown]
    cells = [(name, *(_number(row.get(key)) for key in shown)) for name, row in rows.items()]
    return Table(f"{run}: {record.num_requests} requests", ("method", *heads), tuple(cells))


def _number(value: Any) -> str:
    return "–" if value is None or value != value else f"{value:,.4f}" if abs(value) < 100 else f"{value:,.1f}"


def check_place(path: Path) -> None:
    """Refuse to freeze a manifest over anything but a manifest.

    Raises:
        ScenarioError: ``path`` is something else.
    """
    if path.exists():
        read_manifest(path)


def freeze(path: Path, title: str, runs: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a manifest, or add to one.

    Of a manifest that is there the other runs stay. So do the rows of other methods, where scenario, network and
    requests are the same.

    Args:
        path: where to.
        title: of the benchmark.
        runs: by name ``scenario`` (its config), ``seed`` (of the workload) and ``rows``, the metrics of every method.
    """
    entries = read_manifest(path) if path.exists() else {}
    for name, run in runs.items():
        scenario = Scenario.from_config(run["scenario"])
        rows = {method: {key: row[key] for key in SHOWN if key in row} for method, row in run["rows"].items()}
        entry = {
            "scenario": run["scenario"],
            "seed": run["seed"],
            "rho": round(scenario.offered_load(), 6),
            "requests": len(scenario.workload(run["seed"])),
            **digests(scenario, run["seed"]),
        }
        before = entries.get(name, {})
        same = all(before.get(key) == value for key, value in entry.items() if key != "rho")
        entries[name] = {**entry, "rows": {**(before.get("rows", {}) if same else {}), **rows}}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"format": FORMAT, "title": title, "runs": entries}, indent=1) + "\n")


def read_manifest(path: Path) -> dict[str, Any]:
    """The runs of a manifest, by name.

    Raises:
        ScenarioError: it is none.
    """
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT or not isinstance(content.get("runs"), dict):
        raise ScenarioError(f"{path}: no manifest of a benchmark; give one that recipes/field.py froze")
    return content["runs"]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="nfv-torchrl score", description=__doc__.splitlines()[0])
    parser.add_argument("decisions", type=Path, help="one JSON object a line, as decisions.jsonl of an evaluation")
    parser.add_argument("--manifest", type=Path, required=True, help="such as docs/benchmark/chains.json")
    parser.add_argument("--run", help="which run of the manifest; without it they are listed")
    parser.add_argument("--substrate", help="where the network file of the run is, if not where it was")
    parser.add_argument("--workload", help="where the requests of the run are, if not where they were")
    given = parser.parse_args(arguments)
    files = {part: path for part in ("substrate", "workload") if (path := getattr(given, part)) is not None}
    try:
        runs = read_manifest(given.manifest)
        if given.run not in runs:
            listed = "\n  ".join(["", *runs])
            raise ScenarioError(f"--run {given.run}: name one of{listed}")
        record, walks = score(given.decisions, runs[given.run], f"{given.manifest}: {given.run}", files)
    except (ScenarioError, AuditError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(score_table(record, runs[given.run], given.run).text())
    found = refused(record, walks)
    if found:
        print("\nAccepted in the file and refused by the rules, so counted as rejected:\n  " + "\n  ".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
