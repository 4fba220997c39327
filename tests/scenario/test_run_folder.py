"""``scenario.json`` and what reads a run's folder back."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import toy

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.files import read_run_folder, scenario_to_json
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario


def write_run(folder: Path, scenario: Scenario, seed: int = 3) -> None:
    timeline = scenario.failure_timeline(seed)
    data = scenario_to_json(scenario, workload_seed=seed, method="greedy", timeline=timeline)
    (folder / "scenario.json").write_text(json.dumps(data, allow_nan=False))
    scenario.substrate.to_json(folder / "substrate.json")
    scenario.workload(seed).to_csv(folder / "workload.csv", scenario.catalogue)


def assert_same(one, other) -> None:
    for field in dataclasses.fields(one):
        expected, actual = getattr(one, field.name), getattr(other, field.name)
        if field.name == "substrate":
            assert_same(expected, actual)
        else:
            np.testing.assert_equal(actual, expected, err_msg=field.name)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"endpoints": "uniform", "mask": "feasible", "warmup": 5, "admission_control": True},
        {"failures": {"p_fail_vm": 0.01, "p_fail_link": 0.02, "p_repair": 0.1}, "observe_lifetime": True},
        {"substrate": {"path": "nsfnet", "target_rho": 1.0}, "colocation": True, "max_steps": 30},
    ],
)
def test_round_trip(tmp_path, changes):
    scenario = paper_scenario(seed=1, horizon=60, **changes)
    write_run(tmp_path, scenario)
    run = read_run_folder(tmp_path)
    assert_same(scenario, run.scenario)
    assert_same(scenario.workload(3), run.workload)
    assert_same(scenario.failure_timeline(3), run.timeline)
    assert (run.method, run.workload_seed) == ("greedy", 3)
    assert_same(run.workload, run.scenario.workload(3))
    assert run.scenario.offered_load() == scenario.offered_load()


def test_a_run_without_requests(tmp_path):
    scenario = paper_scenario(horizon=1, arrival_rate=0.5)
    seed = next(seed for seed in range(50) if not len(scenario.workload(seed)))
    write_run(tmp_path, scenario, seed)
    assert len(read_run_folder(tmp_path).workload) == 0


def test_a_workload_of_a_file_is_then_the_folders(tmp_path):
    toy.toy_workload().to_csv(tmp_path / "mine.csv", toy.toy_catalogue())
    run = tmp_path / "run"
    run.mkdir()
    write_run(run, toy.toy_scenario(workload_path=str(tmp_path / "mine.csv")))
    (tmp_path / "mine.csv").unlink()
    again = read_run_folder(run).scenario
    assert again.workload_path == str(run / "workload.csv")
    assert_same(again.workload(0), toy.toy_workload())


def test_an_older_folder_has_indices_under_other_names(tmp_path):
    """Also where a label is a number: what an index was stays one."""
    substrate = dataclasses.replace(toy.toy_substrate(), labels=("1", "2", "3", "4"))
    write_run(tmp_path, toy.toy_scenario(substrate=substrate))
    expected = read_run_folder(tmp_path).workload
    text = (tmp_path / "workload.csv").read_text()
    assert text.startswith("slot,service,ingress_index,egress_index,lifetime\n")
    (tmp_path / "workload.csv").write_text(text.replace("_index", "", 2))
    assert_same(read_run_folder(tmp_path).workload, expected)


def test_the_json_by_hand():
    data = scenario_to_json(toy.toy_scenario(), workload_seed=None, method="random", timeline=FailureTimeline.empty())
    assert data["seeds"] == {"scenario": 0, "workload": None}
    assert (data["horizon"], data["method"], data["failure_timeline"]) == (6, "random", [])
    assert data["services"][0] == {
        "name": "duo",
        "chain": ["A", "B"],
        "rate": 1.0,
        "tolerable_delay": 1050.0,
        "weight": 1.0,
    }
    assert data["endpoint_pairs"] == [[[0, 3], [1, 3]], [[3, 0], [2, 0]]]
    assert data["vnfs"] == {"A": 10.0, "B": 20.0}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("horizon"), "scenario.json: 'horizon' is missing"),
        (lambda d: d.update(colour="red"), "scenario.json: 'colour' is unknown"),
        (lambda d: d.update(seeds=3), "scenario.json: 'seeds' must hold"),
        (lambda d: d.update(horizon=-1), "scenario.json: horizon: -1"),
        (lambda d: d.update(endpoint_pairs="all"), "scenario.json: endpoint_pairs: is no table"),
        (lambda d: d.update(endpoint_pairs=[[[0, 0]]]), "scenario.json: endpoint_pairs: shape"),
        (lambda d: d.update(failure_timeline=[{"slot": 0}]), "scenario.json: failure_timeline, entry 0"),
        (lambda d: d["services"][0].update(chain=["X"]), "scenario.json: services.duo.chain: unknown VNF 'X'"),
    ],
)
def test_refuses(tmp_path, edit, message):
    write_run(tmp_path, toy.toy_scenario())
    data = json.loads((tmp_path / "scenario.json").read_text())
    edit(data)
    (tmp_path / "scenario.json").write_text(json.dumps(data))
    with pytest.raises(ScenarioError, match=message):
        read_run_folder(tmp_path)


def test_refuses_a_folder_without_a_file(tmp_path):
    write_run(tmp_path, toy.toy_scenario())
    (tmp_path / "substrate.json").unlink()
    with pytest.raises(ScenarioError, match=r"substrate.json: no such file"):
        read_run_folder(tmp_path)
