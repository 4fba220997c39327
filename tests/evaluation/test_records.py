from __future__ import annotations

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import toy
from handmade import first_fit, read_decisions
from toy import DUO, SOLO

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import RUN_FILES, read_metrics, write_run
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload


def write(folder, record):
    return write_run(folder, record, compute_metrics(record))


def test_the_five_files(tmp_path):
    record = first_fit(toy.toy_scenario(admission_control=True), refuse=frozenset({1}))
    folder = write(tmp_path / "out" / "first_fit" / "seed_0", record)
    assert sorted(path.name for path in folder.iterdir()) == sorted(RUN_FILES)
    assert [path.name for path in folder.parent.iterdir()] == ["seed_0"]  # nothing temporary is left

    decisions = read_decisions(folder)
    assert decisions[1] == {
        "slot": 0, "service": "duo", "ingress": 0, "egress": 3, "lifetime": 1.5, "accepted": False,
        "reason": "rejected_by_policy", "steps": [], "tried": ["reject"], "delay_ms": None, "cost": None,
        "interrupted_at": None,
    }  # fmt: skip
    assert decisions[2] == {
        "slot": 1, "service": "solo", "ingress": 3, "egress": 0, "lifetime": 0.2, "accepted": True,
        "reason": None, "steps": [[1, 1, 0], [0, 0, None]], "tried": None, "delay_ms": 960.0, "cost": 112.0,
        "interrupted_at": None,
    }  # fmt: skip

    document = json.loads((folder / "scenario.json").read_text())
    assert (document["method"], document["seeds"]) == ("first_fit", {"scenario": 0, "workload": 0})
    assert document["services"][0]["chain"] == ["A", "B"]
    rows = list(csv.reader((folder / "workload.csv").open()))
    assert rows[0] == ["slot", "service", "ingress_index", "egress_index", "lifetime"]
    assert len(rows) == 1 + record.num_requests


def test_files_read_back_unchanged(tmp_path):
    record = first_fit(workload=toy.workload_of((0, DUO, 0, 3, 1 / 3), (4, SOLO, 3, 0, 1e-300)))
    folder = write(tmp_path / "run", record)
    scenario = record.scenario
    workload = Workload.from_csv(folder / "workload.csv", scenario.catalogue, scenario.substrate, scenario.horizon)
    assert workload.lifetime.tolist() == [1 / 3, 1e-300]
    assert np.array_equal(
        Substrate.from_json(folder / "substrate.json").vm_capacity, record.scenario.substrate.vm_capacity
    )
    assert [decision["lifetime"] for decision in read_decisions(folder)] == [1 / 3, 1e-300]
    assert read_metrics(folder) == pytest.approx(compute_metrics(record), nan_ok=True)


def test_metrics_that_do_not_exist_are_null(tmp_path):
    folder = write(tmp_path / "run", first_fit(workload=toy.workload_of((0, DUO, 0, 3, 1.0))))
    assert json.loads((folder / "metrics.json").read_text())["aar/solo"] is None
    assert math.isnan(read_metrics(folder)["aar/solo"])


def test_failures_are_named(tmp_path):
    timeline = toy.timeline_of((2, toy.vm_resource(1, 1), False), (2, toy.link_resource(2), False))
    folder = write(tmp_path / "run", first_fit(timeline=timeline))
    assert json.loads((folder / "scenario.json").read_text())["failure_timeline"] == [
        {"slot": 2, "event": "failure", "vm": [1, 1]},
        {"slot": 2, "event": "failure", "link": [1, 2]},
    ]


def test_same_record_same_bytes(tmp_path):
    first, second = (write(tmp_path / name, first_fit()) for name in ("a", "b"))
    for name in RUN_FILES:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_a_run_replaces_an_older_one_and_nothing_else(tmp_path):
    write(tmp_path / "run", first_fit())
    write(tmp_path / "run", first_fit(method="other"))
    assert json.loads((tmp_path / "run" / "scenario.json").read_text())["method"] == "other"

    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    with pytest.raises(ScenarioError, match=r"thesis\.tex"):
        write(tmp_path / "run", first_fit())
    assert (tmp_path / "run" / "thesis.tex").exists()


def test_a_failed_write_leaves_the_older_run(tmp_path):
    record = first_fit()
    write(tmp_path / "run", record)
    before = (tmp_path / "run" / "decisions.jsonl").read_bytes()
    cost = record.cost.copy()
    cost[0] = math.nan  # an accepted request without a cost cannot be written
    with pytest.raises(ValueError, match="JSON compliant"):
        write(tmp_path / "run", replace(record, cost=cost))
    assert (tmp_path / "run" / "decisions.jsonl").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_arrays_of_another_length_are_refused():
    with pytest.raises(ScenarioError, match=r"hops has shape \(4,\)"):
        replace(first_fit(), hops=np.zeros(4, np.int64))
