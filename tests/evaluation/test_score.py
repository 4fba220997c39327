"""Decisions of any program on a frozen benchmark: what they amount to, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.score import build, check_place, freeze, main, read_manifest, score
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners import GreedyPlanner
from nfv_torchrl.scenario.scenario import Scenario

CONFIG = {
    "name": "small",
    "seed": 3,
    "horizon": 40,
    "arrival_rate": 4,
    "mean_lifetime": 30,
    "substrate": {"nodes": 6, "target_rho": 2.0},
}


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    """A manifest of one run, the decisions of ``greedy`` there, and its record."""
    folder = tmp_path_factory.mktemp("frozen")
    scenario = Scenario.from_config(CONFIG)
    (record,) = run_method(scenario, PlannerMethod(GreedyPlanner(paths=10), name="greedy"), [7])
    metrics = compute_metrics(record)
    write_run(folder / "run", record, metrics)
    freeze(folder / "m.json", "Small", {"small": {"scenario": CONFIG, "seed": 7, "rows": {"greedy": metrics}}})
    return folder / "m.json", folder / "run" / "decisions.jsonl", record


@pytest.mark.parametrize("name", ["chains", "traffic", "cnupb"])
def test_the_frozen_benchmarks_are_still_what_they_were(name, monkeypatch):
    """The first run of every place: the same network and the same requests, to the bit."""
    pytest.importorskip("topohub", reason="networks of the benchmarks are TopoHub's")
    monkeypatch.chdir(Path(__file__).parents[2])  # their files are named from there
    runs = read_manifest(Path(f"docs/benchmark/{name}.json"))
    places = {run.partition("-")[0]: run for run in reversed(runs)}
    for run in places.values():
        scenario, seed = build(runs[run], run)
        assert len(scenario.workload(seed)) == runs[run]["requests"]
        assert {"greedy", "myopic_optimal"} <= runs[run]["rows"].keys()


def test_freezing_again_adds_rows_and_runs(frozen, tmp_path):
    manifest = Path(shutil.copy(frozen[0], tmp_path))
    row, before = {"aar": 0.5}, read_manifest(manifest)["small"]
    freeze(manifest, "Small", {"small": {"scenario": CONFIG, "seed": 7, "rows": {"tabu": row}}})
    assert read_manifest(manifest)["small"] == {**before, "rows": {**before["rows"], "tabu": row}}
    freeze(manifest, "Small", {"other": {"scenario": CONFIG, "seed": 8, "rows": {"greedy": row}}})
    assert list(read_manifest(manifest)) == ["small", "other"]
    # A row that was run again is the new one, and rows of other requests are gone.
    freeze(manifest, "Small", {"small": {"scenario": CONFIG, "seed": 7, "rows": {"greedy": row}}})
    assert read_manifest(manifest)["small"]["rows"] == {"greedy": row, "tabu": row}
    freeze(manifest, "Small", {"small": {"scenario": CONFIG, "seed": 9, "rows": {"greedy": row}}})
    assert read_manifest(manifest)["small"]["rows"] == {"greedy": row}


def lines_of(decisions):
    return [json.loads(line) for line in decisions.read_text().splitlines()]


def written(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def test_the_decisions_of_a_method_score_what_it_scored(frozen, tmp_path, capsys):
    manifest, decisions, record = frozen
    assert 0 < record.accepted.sum() < record.num_requests
    bare = [{"accepted": line["accepted"], "steps": line["steps"]} for line in lines_of(decisions)]
    for file in (decisions, written(tmp_path / "bare.jsonl", bare)):
        again, _ = score(file, read_manifest(manifest)["small"], "m: small")
        assert (again.accepted == record.accepted).all()
        assert compute_metrics(again)["cost_per_accepted"] == compute_metrics(record)["cost_per_accepted"]
    assert main([str(decisions), "--manifest", str(manifest), "--run", "small"]) == 0
    own, greedy = [line.split()[-4:] for line in capsys.readouterr().out.splitlines()[-2:]]
    assert own[1:] == greedy[1:] and f"{record.accepted.mean():.4f}" in own


def test_what_breaks_a_rule_counts_as_rejected_and_is_told(frozen, tmp_path, capsys):
    manifest, decisions, _ = frozen
    lines = lines_of(decisions)
    first = next(number for number, line in enumerate(lines) if line["accepted"])
    lines[first]["steps"] = lines[first]["steps"][:-1]  # never reaches the egress
    file = written(tmp_path / "short.jsonl", lines)
    assert main([str(file), "--manifest", str(manifest), "--run", "small"]) == 1
    said = capsys.readouterr().out
    assert "refused by the rules" in said and f"line {first + 1}: " in said
    assert not score(file, read_manifest(manifest)["small"], "m")[0].accepted[first]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "line 1 is no JSON"),
        ('{"accepted": 1}', 'line 1 has no "accepted"'),
        ('{"accepted": true}', 'line 1 is accepted and has no "steps"'),
        ('{"accepted": true, "steps": [[0, 0]]}', "line 1: step [0, 0]"),
        ('{"accepted": true, "steps": [[0, 0, 1]]}', "line 1: step [0, 0, 1]"),
        ('{"accepted": true, "steps": [[99, 0, 0]]}', "line 1: [99, 0] is no node"),
        ('{"accepted": false}', "answers 1 requests"),
    ],
)
def test_bad_decisions_get_one_line(line, says, frozen, tmp_path, capsys):
    manifest, decisions, _ = frozen
    rest = [] if "answers" in says else decisions.read_text().splitlines()[1:]
    file = tmp_path / "bad.jsonl"
    file.write_text("\n".join([line, *rest]) + "\n")
    assert main([str(file), "--manifest", str(manifest), "--run", "small"]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and "Traceback" not in said


def test_another_network_or_other_requests_are_refused(frozen, tmp_path, capsys):
    manifest, decisions, _ = frozen
    content = json.loads(manifest.read_text())
    for key, value, part in (("seed", 8, "workload"), ("scenario", {**CONFIG, "seed": 4}, "substrate")):
        other = {**content["runs"]["small"], key: value}
        with pytest.raises(ScenarioError, match=f"the {part} is not the one that was frozen"):
            score(decisions, other, "m")
    (tmp_path / "no.json").write_text("{}")
    assert main([str(decisions), "--manifest", str(tmp_path / "no.json"), "--run", "small"]) == 2
    assert "no manifest of a benchmark" in capsys.readouterr().err
    assert main([str(decisions), "--manifest", str(manifest), "--run", "big"]) == 2
    assert "name one of" in capsys.readouterr().err


@pytest.mark.parametrize("where", ["generator", "deeper"])
def test_a_manifest_runs_no_code(where, frozen, tmp_path):
    manifest, decisions, _ = frozen
    entry, marker = read_manifest(manifest)["small"], tmp_path / "marker"
    code = {"_target_": "pathlib.Path.touch", "self": {"_target_": "pathlib.Path", "_args_": [str(marker)]}}
    inner = code if where == "generator" else {"_target_": "nfv_torchrl.scenario.waxman.draw_waxman", "nodes": [code]}
    entry["scenario"] = {**CONFIG, "substrate": {"generator": inner}}
    with pytest.raises(ScenarioError, match=r"its network is drawn by 'pathlib\.Path\.touch'"):
        score(decisions, entry, "m")
    assert not marker.exists()


@pytest.mark.parametrize("key", ["scenario", "seed", "workload_sha256", "rows"])
def test_a_damaged_manifest_is_named(key, frozen):
    manifest, decisions, _ = frozen
    entry = read_manifest(manifest)["small"]
    with pytest.raises(ScenarioError, match=f"m: '{key}' is missing"):
        score(decisions, {name: value for name, value in entry.items() if name != key}, "m")


def test_only_a_manifest_is_frozen_over(frozen, tmp_path):
    check_place(frozen[0])
    check_place(tmp_path / "new.json")
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(ScenarioError, match=r"mine\.json: no manifest"):
        check_place(tmp_path / "mine.json")
