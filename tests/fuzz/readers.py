"""Files of every kind that the project reads, damaged and given to the code that reads them."""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import random
import shutil
import tempfile
from pathlib import Path

import networkx as nx
import numpy as np
import torch
import yaml
from fuzz import mutate
from fuzz.arena import Case
from tiny import ROOT

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import write_summary
from nfv_torchrl.methods import RandomMethod, load_policy
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.tensor_files import load_file, save_file
from nfv_torchrl.training.recording import Dataset

TOPOLOGIES = ROOT / "nfv_torchrl" / "scenario" / "topologies"
POLICIES = ROOT / "docs" / "results" / "policies"
SMALL = {"horizon": 12, "arrival_rate": 3, "mean_lifetime": 10}
LARGEST_PLAYED = 2000
"""Requests of a scenario that is also played: crashes of compiled code show only there."""


def play_some(scenario: Scenario, seed: int) -> None:
    """Some random steps on a world that was read."""
    simulator = Simulator(scenario, 1)
    workload = scenario.workload(seed)
    if len(workload) > LARGEST_PLAYED:
        return
    simulator.start(0, workload, scenario.failure_timeline(seed))
    rng = np.random.default_rng(seed)
    for _ in range(50):
        valid = np.flatnonzero(simulator.world.seen.mask[0])
        simulator.step(np.array([rng.choice(valid)]))


def network_file(suffix: str, number: int, folder: Path) -> None:
    """A GraphML, GML or JSON network."""
    rng = random.Random(f"{suffix}:{number}")
    name = rng.choice(["Abilene", "Nsfnet", "Sprint"])
    path = folder / f"net.{suffix}"
    path.write_bytes(mutate.bytes_of(rng, _network(name, suffix)))
    play_some(Scenario.from_config({**SMALL, "substrate": {"path": str(path)}}), number)


@functools.cache
def _network(name: str, suffix: str) -> bytes:
    source = TOPOLOGIES / f"{name}.graphml"
    if suffix == "graphml":
        return source.read_bytes()
    if suffix == "gml":
        return "\n".join(nx.generate_gml(nx.Graph(nx.read_graphml(source)), stringizer=str)).encode()
    return json.dumps(_node_link(name)).encode()


@functools.cache
def _node_link(name: str) -> dict:
    graph = Scenario.from_config(
        {**SMALL, "substrate": {"path": str(TOPOLOGIES / f"{name}.graphml")}}
    ).substrate.to_networkx()
    return nx.node_link_data(graph, edges="links")


def network_json(number: int, folder: Path) -> None:
    """A node-link document with values, keys and entries changed."""
    rng = random.Random(number)
    path = folder / "net.json"
    path.write_text(json.dumps(mutate.nested_of(rng, _node_link("Abilene"), 3)))
    play_some(Scenario.from_config({**SMALL, "substrate": {"path": str(path)}}), number)


def workload(number: int, folder: Path) -> None:
    """A CSV of requests: damaged bytes, or damaged cells."""
    rng = random.Random(number)
    path = folder / "work.csv"
    scenario = paper_scenario(5, 0, **SMALL)
    scenario.workload(0).to_csv(path, scenario.catalogue)
    if rng.random() < 0.5:
        path.write_bytes(mutate.bytes_of(rng, path.read_bytes()))
    else:
        rows = mutate.nested_of(rng, list(csv.reader(path.open())), 2)
        lines = rows if isinstance(rows, list) else [rows]
        path.write_text("\n".join(",".join(map(str, row)) if isinstance(row, list) else str(row) for row in lines))
    substrate = {"substrate": {"nodes": 5}}
    play_some(Scenario.from_config({**SMALL, **substrate, "workload": {"path": str(path)}}), 0)


def scenario_yaml(number: int, folder: Path) -> None:
    """A scenario's yaml with values, keys and entries changed."""
    rng = random.Random(number)
    base = yaml.safe_load((ROOT / "recipes" / "config" / "scenario" / "_base.yaml").read_text())
    config = mutate.nested_of(rng, base | SMALL, 2)
    Scenario.from_config(config)


def policy(number: int, folder: Path) -> None:
    """A policy: damaged bytes, or entries changed and packed again."""
    rng = random.Random(number)
    source = rng.choice(sorted(POLICIES.glob("*.pt")))
    path = folder / "policy.pt"
    if rng.random() < 0.4:
        path.write_bytes(mutate.bytes_of(rng, source.read_bytes()))
    else:
        changed = mutate.nested_of(rng, load_file(source), 2)
        save_file(path, changed if isinstance(changed, dict) else {"x": changed})
    scenario = paper_scenario(4, 0, **SMALL)
    run_method(scenario.replace(horizon=3), load_policy(path, scenario), [0])


def checkpoint(number: int, folder: Path) -> None:
    """The snapshot of an environment in a checkpoint."""
    rng = random.Random(number)
    env = NFVEnv(paper_scenario(4, 0, **SMALL), batch_size=2)
    env.rollout(20, break_when_any_done=False)
    path = save_file(folder / "checkpoint_1.pt", {"env": env.state_dict()})
    if rng.random() < 0.3:
        path.write_bytes(mutate.bytes_of(rng, path.read_bytes()))
    else:
        changed = mutate.nested_of(rng, load_file(path), 3)
        save_file(path, changed if isinstance(changed, dict) else {"env": changed})
    content = load_file(path)
    if "env" in content:
        env.load_state_dict(content["env"])
        env.rollout(40, break_when_any_done=False)


def dataset(number: int, folder: Path) -> None:
    """A folder of recorded decisions."""
    rng = random.Random(number)
    env = NFVEnv(paper_scenario(4, 0, **SMALL), batch_size=2)
    given = {"origin": {"seed": 0}, "env": env, "frames": 40, "steps": 10}
    Dataset(folder / "data", **given).record(RandomMethod(), lambda _: None)
    files = sorted(path for path in (folder / "data").rglob("*") if path.is_file())
    path = rng.choice(files)
    if path.suffix == ".npy" and rng.random() < 0.6:
        np.save(path, mutate.array_of(rng, np.load(path)))
    elif path.suffix == ".json" and rng.random() < 0.6:
        path.write_text(json.dumps(mutate.nested_of(rng, json.loads(path.read_text()), 2)))
    else:
        path.write_bytes(mutate.bytes_of(rng, path.read_bytes()))
    again = Dataset(folder / "data", **given)
    if again.complete:
        for part in again.parts():
            assert torch.isfinite(part["next", "reward"]).all()


@functools.cache
def _evaluation() -> dict[str, bytes]:
    """The files of a small evaluation by their paths."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scenario = paper_scenario(4, 0, **SMALL, failures={"p_fail_vm": 0.05, "p_repair": 0.2})
        comparison = Comparison(scenario)
        for method in (RandomMethod(), RandomMethod(name="feasible", mask="feasible")):
            for record in run_method(scenario, method, [0, 1]):
                write_run(folder / method.name / f"seed_{record.workload_seed}", record, comparison.add(record))
        write_summary(folder, comparison, "random")
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def evaluation(number: int, folder: Path) -> None:
    """One file of an evaluation: the audit has to name it and to audit all other runs; the reader of runs too."""
    rng = random.Random(number)
    files = _evaluation()
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    name = rng.choice(sorted(files))
    content = files[name]
    if name.endswith(".json") and rng.random() < 0.5:
        changed = json.dumps(mutate.nested_of(rng, json.loads(content), 2)).encode()
    else:
        changed = mutate.bytes_of(rng, content)
    (folder / name).write_bytes(changed)
    reports = audit_folders([folder])
    assert changed == content or any(not report.clean for report in reports), f"{name}: the change was not noticed"
    others = [
        report for report in reports if report.requests and not name.startswith(str(report.folder.relative_to(folder)))
    ]
    assert len(others) >= 2, "other runs were not audited"
    run = folder / "random" / "seed_0"
    if not name.startswith("random/seed_0"):
        shutil.copy(folder / name, run / Path(name).name)
    read_run_folder(run)


READERS: dict[str, Case] = {
    **{kind: functools.partial(network_file, kind) for kind in ("graphml", "gml", "json")},
    "network_json": network_json,
    "workload": workload,
    "scenario": scenario_yaml,
    "policy": policy,
    "checkpoint": checkpoint,
    "dataset": dataset,
    "evaluation": evaluation,
}


def warm_up() -> None:
    """Compile and cache in the parent what every case needs."""
    _evaluation()
    for suffix in ("graphml", "gml", "json"):
        _network("Abilene", suffix)
    scenario = paper_scenario(4, 0, **SMALL)
    play_some(scenario, 0)
    for path in sorted(POLICIES.glob("*.pt")):
        with contextlib.suppress(CheckpointError):  # of a network of another size
            run_method(scenario.replace(horizon=1), load_policy(path, scenario), [0])
