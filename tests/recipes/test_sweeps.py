"""Sweeps: each job has a folder of its own, and the launchers' configs are complete."""

from __future__ import annotations

import re
from importlib.util import find_spec
from types import SimpleNamespace

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING, run

from nfv_torchrl.training import setup


def test_a_sweep_trains_each_job_in_its_own_folder(tmp_path):
    launcher = (
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=1"] if find_spec("hydra_plugins.hydra_joblib_launcher") else []
    )
    sweep = tmp_path / "sweep"
    arguments = [*TINY_SCENARIO, *TINY_TRAINING, "collector.total_frames=64", "eval.interval=0"]
    done = run("dqn.py", "-m", "loss=dqn,n_step", "preset=mlp", *launcher, *arguments, f"run_dir={sweep}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    jobs = sorted(path.name for path in sweep.iterdir() if path.is_dir())
    assert [name.split("__")[0] for name in jobs] == ["loss-dqn", "loss-n_step"]
    for name, target in zip(jobs, ("DQN", "NStepDQN"), strict=True):
        config = OmegaConf.load(sweep / name / "config.yaml")
        assert config.loss._target_.endswith(f".{target}")
        assert len(list((sweep / name).glob("checkpoint_*.pt"))) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]  # nothing beside it


@pytest.mark.parametrize("place", ["thesis", ".", "null", "/dev/null/x"])
def test_a_refused_sweep_writes_nothing(place, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("mine")
    done = run("evaluate.py", "-m", "seeds=1,2", f"output='{place}'" if place == "." else f"output={place}",
               *TINY_SCENARIO, "method=[greedy]", cwd=tmp_path)  # fmt: skip
    said = done.stderr.strip().splitlines()
    if place == "null":  # keeps nothing, and works
        assert done.returncode == 0
    else:
        assert done.returncode == 2 and said[-1].startswith("error: output: ")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["chapter1.tex", "thesis"]


def hydra_says(monkeypatch, mode, overrides):
    state = SimpleNamespace(mode=mode, overrides=SimpleNamespace(task=overrides))
    monkeypatch.setattr(setup, "HydraConfig", SimpleNamespace(initialized=lambda: True, get=lambda: state))


def names(monkeypatch, *overrides):
    hydra_says(monkeypatch, RunMode.MULTIRUN, list(overrides))
    return setup.run_folder("runs/s").name


def test_names_of_jobs(monkeypatch):
    of_all = ("run_dir=x", "output=y", "resume=true")
    assert names(monkeypatch, "loss=n_step", "seed=1", *of_all) == "loss-n_step__seed-1"
    assert setup.run_file("runs/table.csv").as_posix() == "runs/table-loss-n_step__seed-1.csv"
    hydra_says(monkeypatch, RunMode.RUN, ["seed=1"])
    assert str(setup.run_folder("runs/s")) == "runs/s" and str(setup.run_file("runs/a.csv")) == "runs/a.csv"


JOBS = [
    ["seed=1"],
    ["seed=2"],
    ["loss=n", "step_seed=1"],
    ["loss=n_step", "seed=1"],
    ["loss=n__step", "seed=1"],
    ["loss=n_step__seed-1"],
    ["scenario.substrate.path=a/b.json"],
    ["scenario.substrate.path=a_b.json"],
    ["network.hidden=[1,2]"],
    ["network.hidden=[12]"],
    ["network.hidden=1_2"],
    ["+a=1"],
    ["a=1"],
    ["a=-1"],
    ["a='1'"],
    ["a=größe, x=y"],
    [*(f"key_{k}={k}" for k in range(40)), "seed=1"],
    [*(f"key_{k}={k}" for k in range(40)), "seed=2"],
]


def test_names_of_jobs_differ_and_can_be_typed(monkeypatch):
    found = [names(monkeypatch, *job) for job in JOBS]
    assert len(set(found)) == len(JOBS)
    parser = OverridesParser.create()
    for name in found:
        assert re.fullmatch(r"[\w.-]{1,120}", name, re.ASCII)
        assert parser.parse_override(f"run_dir=runs/s/{name}").value() == f"runs/s/{name}"


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1) | st.text("'\\\\${}\"=, [x", min_size=1))
def test_quoted_values_come_through_hydra(text):
    value = OverridesParser.create().parse_override(f"run_dir={setup.quote(text)}").value()
    assert OmegaConf.create({"run_dir": value}).run_dir == text


@pytest.mark.parametrize("name", ["ray_local", "ray_cluster"])
def test_ray_launchers_extend_the_plugin(name):
    config = OmegaConf.load(ROOT / "recipes" / "config" / "hydra" / "launcher" / f"{name}.yaml")
    assert config.defaults[0] == "ray"
    assert config.ray.remote.num_cpus == 1
