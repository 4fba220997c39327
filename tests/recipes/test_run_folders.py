"""What recipes do to folders: a refused command moves nothing, nobody's files are touched, inputs are remembered."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from inprocess import call
from omegaconf import OmegaConf
from tiny import TINY_SCENARIO

from nfv_torchrl.folders import MARKER, claim
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.tensor_files import load_file, save_file
from nfv_torchrl.training.checkpoint import CheckpointFolder

SMALL = [
    *TINY_SCENARIO,
    "collector.num_envs=2",
    "collector.steps=4",
    "collector.total_frames=16",
    "eval.interval=0",
    "logger.figures=false",
    "network.hidden=[8]",
]
EVOLUTION = [
    *TINY_SCENARIO,
    "policy=candidate",
    "tasks=fixed_network",
    "network.hidden=[4]",
    "generations=1",
    "generation.tasks=1",
    "strategy.population=4",
    "eval.interval=0",
    "eval.tasks=1",
    "parallel.jobs=1",
]
OFFLINE = [
    *TINY_SCENARIO,
    "record.num_envs=2",
    "record.steps=16",
    "record.frames=32",
    "learner.updates=2",
    "learner.batch_size=8",
    "eval.interval=0",
    "network.hidden=[8]",
]
ARGUMENTS = {
    "dqn": ["preset=mlp", *SMALL, "buffer.size=100", "buffer.batch_size=8", "buffer.warmup_frames=8"],
    "policy_gradient": SMALL,
    "evolution": EVOLUTION,
    "offline": OFFLINE,
}
LEARNERS = ("dqn", "policy_gradient")
BAD = [
    *((name, "network.hidden=[-1]") for name in ARGUMENTS),
    *((name, "segment=0") for name in LEARNERS),
    *((name, "collector.num_envs=0") for name in LEARNERS),
    *((name, "learner.lr=-1") for name in (*LEARNERS, "offline")),
    *((name, "reward._target_=os.nothing") for name in ("dqn", "policy_gradient", "offline")),
    *((name, "target._target_=os.nothing") for name in ("dqn", "offline")),
    ("dqn", "exploration._target_=os.nothing"),
    ("policy_gradient", "reward.w_cost=x"),
    ("policy_gradient", "env._target_=os.nothing"),
    ("offline", "saving.keep=0"),
    ("offline", "record.num_envs=0"),
    ("offline", "dataset=."),
    ("evolution", "init_from=nowhere.pt"),
    ("evolution", "strategy.population=1"),
]


def old_run(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("scenario:\n  name: paper\nrun_dir: runs/dqn\n")
    (folder / "best.pt").write_bytes(b"of the older run")
    return folder


def tree(folder: Path) -> dict[str, bytes]:
    """Every file's content, but for markers."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != MARKER)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def refused(capsys, recipe: str, *overrides: str) -> str:
    """The one line of a refusal."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as leaving:
        call(recipe, *overrides)
    assert leaving.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(("recipe", "bad"), BAD)
def test_a_refused_command_leaves_the_older_run_where_it_is(recipe, bad, tmp_path):
    before = tree(old_run(tmp_path / "run").parent)
    with pytest.raises((SystemExit, Exception)):
        call(recipe, *ARGUMENTS[recipe], f"run_dir={tmp_path / 'run'}", bad)
    assert tree(tmp_path) == before and not (tmp_path / "run" / MARKER).exists()


@pytest.mark.parametrize("recipe", ARGUMENTS)
def test_a_users_folder_is_refused_and_a_folder_in_use_too(recipe, tmp_path, capsys, monkeypatch):
    thesis, run = tmp_path / "thesis", old_run(tmp_path / "run")
    thesis.mkdir()
    (thesis / "chapter1.tex").write_text("x")
    before = tree(tmp_path)
    assert "none of ours" in refused(capsys, recipe, *ARGUMENTS[recipe], f"run_dir={thesis}")
    lock = claim("run_dir", run, "run")
    assert "is in use by process" in refused(capsys, recipe, *ARGUMENTS[recipe], f"run_dir={run}")
    lock.release()
    monkeypatch.chdir(tmp_path)
    for value in ("null", "''", ".", "..", "/", "'~'", "thesis/chapter1.tex", "/dev/null/x", "run/inside"):
        assert "run_dir: " in refused(capsys, recipe, *ARGUMENTS[recipe], f"run_dir={value}")
    (run / "greedy" / "seed_0").mkdir(parents=True)
    (run / "greedy" / "seed_0" / "decisions.jsonl").touch()
    assert "would be renamed, too" in refused(capsys, recipe, *ARGUMENTS[recipe], "run_dir=run")
    (run / "greedy" / "seed_0" / "decisions.jsonl").unlink()
    assert tree(tmp_path) == before


def test_an_older_run_moves_aside_with_what_is_in_it(tmp_path, capsys):
    run = old_run(tmp_path / "run")
    (run / "notes.txt").write_text("mine")
    for _ in range(2):
        call("dqn", *ARGUMENTS["dqn"], f"run_dir={run}")
    assert (tmp_path / "run.1" / "notes.txt").read_text() == "mine"
    assert "run.2" in capsys.readouterr().out and CheckpointFolder(run).files()


CHANGES = {
    "delay": lambda net: net["links"][0].update(delay=3.5),
    "unit_cost": lambda net: net["links"][0].update(unit_cost=99.5),
    "blanks": lambda net: None,
}


@pytest.mark.parametrize("recipe", ["dqn", "evolution", "offline"])
def test_changed_inputs_are_refused_by_name(recipe, tmp_path, capsys):
    """Also a file that is only written in another way: nobody can say what else it may change."""
    net, requests, run = tmp_path / "net.json", tmp_path / "requests.csv", tmp_path / "run"
    scenario = paper_scenario(nodes=5, horizon=60, arrival_rate=4, mean_lifetime=40)
    scenario.substrate.to_json(net)
    scenario.workload(0).to_csv(requests, scenario.catalogue)
    files = [f"scenario.substrate.path={net}"]
    if recipe == "dqn":
        files.append(f"scenario.workload.path={requests}")
    arguments = [*ARGUMENTS[recipe], *files, f"run_dir={run}"]
    call(recipe, *arguments)
    whole = net.read_text()
    for name, change in CHANGES.items():
        document = json.loads(whole)
        change(document)
        net.write_text(json.dumps(document))
        error = refused(capsys, recipe, *arguments, "resume=true")
        assert "scenario.substrate.path" in error and ("network" in error) == (name != "blanks")
    net.write_text(whole)
    if recipe == "dqn":
        lines = requests.read_text().splitlines()
        requests.write_text("\n".join(lines[:-1]) + "\n")
        error = refused(capsys, recipe, *arguments, "resume=true")
        assert "scenario.workload.path, workload differs" in error
        requests.write_text("\n".join(lines) + "\n")
    call(recipe, *arguments, "resume=true")


def test_the_policy_a_run_began_with_may_be_gone_but_not_another(tmp_path, capsys):
    first, run = tmp_path / "first", tmp_path / "run"
    call("dqn", *ARGUMENTS["dqn"], f"run_dir={first}", "eval.interval=1", "eval.seeds=[1000]")
    arguments = [*ARGUMENTS["dqn"], f"run_dir={run}", f"init_from={first / 'best.pt'}"]
    call("dqn", *arguments)
    (first / "best.pt").write_bytes((first / "best.pt").read_bytes() + b"x")
    assert "init_from" in refused(capsys, "dqn", *arguments, "resume=true")
    (first / "best.pt").unlink()
    call("dqn", *arguments, "resume=true")


def test_a_run_with_older_checkpoints_without_fingerprints_goes_on(tmp_path):
    run = tmp_path / "run"
    call("policy_gradient", *SMALL, f"run_dir={run}")
    newest = CheckpointFolder(run).files()[-1]
    content = load_file(newest)
    del content["inputs"]
    save_file(newest, content)
    call("policy_gradient", *SMALL, f"run_dir={run}", "resume=true", "collector.total_frames=24")
    assert OmegaConf.load(run / "config.yaml").scenario.substrate.nodes == 5


def test_a_dataset_is_no_users_folder(tmp_path, capsys):
    thesis, run = tmp_path / "thesis", tmp_path / "run"
    thesis.mkdir()
    (thesis / "chapter1.tex").write_text("x")
    before = tree(tmp_path)
    for dataset, words in ((thesis, "holds chapter1.tex"), ("~/x", "shell"), (run / "data", "leave it null")):
        assert words in refused(capsys, "offline", *OFFLINE, f"run_dir={run}", f"dataset='{dataset}'")
    shared = tmp_path / "shared"
    lock = claim("dataset", shared, "dataset")
    assert "in use" in refused(capsys, "offline", *OFFLINE, f"run_dir={run}", f"dataset={shared}")
    lock.release()
    assert {path: data for path, data in tree(tmp_path).items() if not path.startswith("run")} == before


@pytest.mark.parametrize("recipe", ["evaluate", "figures", "compare_losses"])
def test_outputs_are_no_users_folders(recipe, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("x")
    old_run(tmp_path / "run")
    before = tree(tmp_path)
    few = {"evaluate": ["method=greedy", "seeds=1"], "figures": ["figure=presence_probability"], "compare_losses": []}
    for value in ("thesis", ".", "/", "''", "run", "run/table", "thesis/chapter1.tex", "/dev/null/x"):
        assert "output: " in refused(capsys, recipe, *TINY_SCENARIO, *few[recipe], f"output={value}")
    lock = claim("output", tmp_path / "out", "evaluation" if recipe == "evaluate" else "cells")
    assert "in use by process" in refused(capsys, recipe, *TINY_SCENARIO, *few[recipe], "output=out")
    lock.release()
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    "name", ["../../x", "/tmp/x", "a/b", "''", ".", "..", ".x", "Random", "summary.csv", "5", "null"]
)
def test_a_methods_name_stays_inside_the_output(name, tmp_path, capsys):
    error = refused(capsys, "evaluate", *TINY_SCENARIO, "method=[random,greedy]", "seeds=1",
                    f"method.greedy.name={name}", f"output={tmp_path / 'a' / 'out'}")  # fmt: skip
    assert "method.greedy.name: " in error and not (tmp_path / "a").exists()
