"""Sweeps: each job has a folder of its own, and the launchers' configs are complete."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import pytest
from hydra.types import RunMode
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING, run

from nfv_torchrl.training import setup


def test_a_sweep_trains_each_job_in_its_own_folder(tmp_path):
    launcher = (
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=1"] if find_spec("hydra_plugins.hydra_joblib_launcher") else []
    )
    sweep = tmp_path / "sweep"
    arguments = [*TINY_SCENARIO, *TINY_TRAINING, "collector.total_frames=64", "eval.interval=0"]
    done = run("dqn.py", "-m", "loss=dqn,n_step", *launcher, *arguments, f"run_dir={sweep}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    jobs = sorted(path.name for path in sweep.iterdir() if path.is_dir())
    assert [name.split(",")[0] for name in jobs] == ["loss=dqn", "loss=n_step"]
    for name, target in zip(jobs, ("DQN", "NStepDQN"), strict=True):
        config = OmegaConf.load(sweep / name / "config.yaml")
        assert config.loss._target_.endswith(f".{target}")
        assert len(list((sweep / name).glob("checkpoint_*.pt"))) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]  # nothing beside it


def hydra_says(monkeypatch, mode, overrides):
    state = SimpleNamespace(mode=mode, overrides=SimpleNamespace(task=overrides))
    monkeypatch.setattr(setup, "HydraConfig", SimpleNamespace(initialized=lambda: True, get=lambda: state))


def test_names_of_jobs(monkeypatch):
    given = ["loss=dqn", "seed=1", "scenario.substrate.path=a/b.json", "run_dir=x", "resume=true"]
    hydra_says(monkeypatch, RunMode.MULTIRUN, given)
    assert str(setup.run_folder("runs/s")) == "runs/s/loss=dqn,seed=1,scenario.substrate.path=a_b.json"
    hydra_says(monkeypatch, RunMode.RUN, given)
    assert str(setup.run_folder("runs/s")) == "runs/s"
    names = set()
    for seed in (1, 2):
        hydra_says(monkeypatch, RunMode.MULTIRUN, ["loss=dqn", *(f"key_{k}={k}" for k in range(40)), f"seed={seed}"])
        names.add(setup.run_folder("runs").name)
    assert len(names) == 2 and all(name.startswith("loss=dqn,") and len(name) <= 120 for name in names)


@pytest.mark.parametrize("name", ["ray_local", "ray_cluster"])
def test_ray_launchers_extend_the_plugin(name):
    config = OmegaConf.load(ROOT / "recipes" / "config" / "hydra" / "launcher" / f"{name}.yaml")
    assert config.defaults[0] == "ray"
    assert config.ray.remote.num_cpus == 1
