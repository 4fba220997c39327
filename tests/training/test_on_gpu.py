"""Trainings for real on a GPU, where there is one; test_device.py has what can be known without.

An update must not wait for the GPU and must agree with the CPU's; a run must resume, and its policy must play without
a GPU.
"""

import copy
from contextlib import contextmanager

import pytest
import torch
from forked import forked_workers
from inprocess import call
from test_device import LOSSES, WAITS, loss_and_rows
from tiny import TINY_SCENARIO

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import load_policy
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.learner import gradient_step

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

SHORT = [
    *TINY_SCENARIO,
    "scenario.horizon=20",
    "device=cuda",
    "logger.interval=2",
    "eval.seeds=[1000]",
]
COLLECTED = [
    *SHORT,
    "collector.num_envs=4",
    "collector.steps=8",
    "collector.total_frames=192",
    "eval.interval=6",
    "saving.interval=3",
]
REPLAYED = ["buffer.size=100", "buffer.batch_size=8", "buffer.warmup_frames=32", "learner.updates=2"]
DQN = {
    "mlp": ["preset=mlp"],
    "memory on the CPU": ["preset=mlp", "+buffer.storage.device=cpu"],
    "prioritized": ["preset=mlp", "buffer=prioritized"],
    "rainbow": ["preset=rainbow"],
    "two workers": ["preset=mlp", "collector=multi_sync"],
    "look-ahead": ["preset=lookahead"],
    "candidate": ["preset=across_requests"],
    "plans": ["preset=plans"],
    "TorchRL's": ["preset=mlp", "loss._target_=torchrl.objectives.DQNLoss"],
}
GRADIENT = {"ppo": ["pg_loss=ppo", "learner.minibatch=12"], "a2c": ["pg_loss=a2c"], "nfvdeep": ["env=nfvdeep"]}
RUNS = {f"dqn, {name}": ("dqn", [*COLLECTED, *REPLAYED, *more]) for name, more in DQN.items()}
RUNS |= {f"policy gradient, {name}": ("policy_gradient", [*COLLECTED, *more]) for name, more in GRADIENT.items()}
RUNS["offline"] = (
    "offline",
    [*SHORT, "record.num_envs=4", "record.steps=32", "record.frames=256", "learner.updates=40", "eval.interval=20",
     "learner.batch_size=32", "saving.interval=20"],
)  # fmt: skip


@contextmanager
def no_waiting():
    """An error where Python waits for the GPU."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize(("recipe", "choice"), LOSSES)
def test_an_update_agrees_with_the_cpu_and_does_not_wait(recipe, choice):
    loss, rows = loss_and_rows(recipe, choice)
    there, moved = copy.deepcopy(loss).to("cuda"), rows.to("cuda")
    here, again = (_update(copy.deepcopy(loss), rows) for _ in range(2))
    learned = _update(there, moved)
    assert {value.device.type for value in learned.values()} == {"cuda"}
    assert {part.device.type for part in (*there.actor.parameters(), *there.actor.buffers())} == {"cuda"}
    assert all(torch.isfinite(value) for value in learned.values())
    if all(
        torch.equal(*pair) for pair in zip(here.values(), again.values(), strict=True)
    ):  # nothing is drawn in an update
        for key, value in here.items():
            torch.testing.assert_close(
                learned[key].cpu(), value, rtol=1e-3, atol=1e-4, msg=lambda m, k=key: f"{k}: {m}"
            )
    if choice not in WAITS:
        with no_waiting():
            _update(there, moved)


def _update(loss, rows):
    torch.manual_seed(torch.initial_seed() + 1)
    return gradient_step(loss, torch.optim.Adam(loss.parameters(), lr=1e-3), rows, 10.0)


@pytest.mark.parametrize("name", RUNS)
@forked_workers()
def test_it_trains_resumes_and_plays_on_the_cpu(name, tmp_path):
    recipe, overrides = RUNS[name]
    folder = tmp_path / "run"
    call(recipe, f"run_dir={folder}", *overrides)
    checkpoints = CheckpointFolder(folder)
    whole = load_file(checkpoints.files()[-1])
    checkpoints.files()[-1].unlink()
    call(recipe, f"run_dir={folder}", *overrides, "resume=true")
    again = load_file(checkpoints.files()[-1])
    assert whole["loss"].keys() == again["loss"].keys()
    for key, value in whole["loss"].items():
        assert value.device.type == "cpu" and torch.isfinite(value).all()
        torch.testing.assert_close(again["loss"][key], value, msg=lambda m, k=key: f"{k}: {m}")

    scenario = paper_scenario(horizon=20, substrate={"nodes": 5}, arrival_rate=4, mean_lifetime=40)
    [played] = run_method(scenario, load_policy(folder / "best.pt", scenario), [7])
    assert len(played.accepted)


def test_a_compiled_update_learns_there(tmp_path):
    call("dqn", f"run_dir={tmp_path / 'run'}", *COLLECTED, *REPLAYED, "preset=mlp", "learner.compile=true")
    assert (tmp_path / "run" / "best.pt").exists()
