"""The benchmark recipe, run for real at tiny size."""

from __future__ import annotations

import json
import math
from functools import partial

import pytest
from tiny import TINY_SCENARIO, TINY_TRAINING, run

from nfv_torchrl.experiments import evaluation_speed
from nfv_torchrl.scenario import paper_scenario

TINY = [
    *TINY_SCENARIO,
    "method=[random,greedy]",
    "nodes=[5]",
    "batch_sizes=[1,6]",
    "arrivals_per_node=null",
    "loaded_slot=30",
    "repeats=1",
    "frames=600",
    "methods.seconds=0.02",
    "memory=[{nodes: 5, batch_size: 3, horizon: 40}]",
]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    done = run("benchmark.py", *TINY, "parts=[kernel,env,collector,methods,memory]", "output=speeds.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in folder.iterdir()] == ["speeds.json"]  # nothing else is left behind
    return done.stdout, json.loads((folder / "speeds.json").read_text())


def test_every_part_has_its_rows(measured):
    printed, document = measured
    results = document["results"]
    for part in ("kernel", "env", "collector"):
        assert [(row["N"], row["B"]) for row in results[part]] == [(5, 1), (5, 6)]
    assert [row["method"] for row in results["methods"]] == ["random", "greedy"]
    assert [row["B"] for row in results["memory"]] == [3]
    for row in (row for rows in results.values() for row in rows):
        assert all(value > 0 and math.isfinite(value) for value in row.values() if isinstance(value, float))
    assert "steps/s" in printed and document["machine"]["torch"] in printed


def test_compiled_networks_are_measured_against_torch(monkeypatch):
    short = partial(paper_scenario, seed=0, horizon=2)
    monkeypatch.setattr(evaluation_speed, "make_scenario", lambda config, nodes, slots: short(nodes=nodes))
    rows = list(evaluation_speed.run_evaluations({"nodes": [5]}))
    assert [row["network"] for row in rows] == list(evaluation_speed.LOSSES)
    assert all(row["times"] == row["steps/s"] / row["steps/s by torch"] > 0 for row in rows)


def test_networks_are_loaded_while_they_are_measured(measured):
    _, document = measured
    for row in document["results"]["kernel"]:
        assert row["VM use before"] > 0.01 and row["VM use after"] > 0.01


def test_unknown_parts_are_refused(tmp_path):
    done = run("benchmark.py", "parts=[engine]", cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: parts[0]: 'engine'")


def test_training_speed_comes_from_the_recipe_itself(tmp_path):
    arguments = ",".join(f"'{argument}'" for argument in [*TINY_SCENARIO, *TINY_TRAINING])
    done = run("benchmark.py", "parts=[training]", *TINY, f"training.overrides=[{arguments}]", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "updates/s of the learner" in done.stdout and "frames/s (wall)" in done.stdout
