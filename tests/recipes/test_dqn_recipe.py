"""The DQN recipe, run for real: what it leaves behind, how it resumes, how it refuses."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import torch
from forked import fork
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING, command, run, train

from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.vocabulary import without_row


def scalars(folder: Path) -> dict[str, dict[int, float]]:
    """Every logged scalar by tag and frame, but for clocks."""
    events = EventAccumulator(str(folder))
    events.Reload()
    clocks = ("speed/",)
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(clocks)]
    return {tag: {event.step: event.value for event in events.Scalars(tag)} for tag in tags}


def assert_same(a, b, where=""):
    """Nested checkpoints are equal to the bit, but for clocks."""
    if isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype and torch.equal(a.view(-1).view(torch.uint8), b.view(-1).view(torch.uint8)), where
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            if key not in ("config", "versions", "clock"):
                assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for place, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}/{place}")
    else:
        assert a == b, where


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """A run that nobody interrupts."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    done = train(folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_a_run_leaves_everything_that_is_promised(whole_run):
    folder, printed = whole_run
    assert (folder / "best.pt").exists() and (folder / "config.yaml").exists()
    assert len(CheckpointFolder(folder).files()) == 2  # saving.keep
    assert "tensorboard --logdir" in printed and "best.pt" in printed
    seen = scalars(folder)
    for tag in ("train/aar", "train/anuc", "train/cost_per_accepted", "train/epsilon", "train/loss", "train/chosen_q",
                "train/gradient_norm", "train/mean_hops", "train/mean_delay_ms", "train/aar/video",
                "train/vm_utilisation", "train/link_utilisation", "eval/aar/video",
                "eval/aar"):  # fmt: skip
        assert seen[tag], tag
    assert not without_row(seen)
    assert sorted(folder.parent.iterdir()) == [folder]  # no litter beside it


def test_a_killed_run_resumes_to_the_bit(tmp_path):
    """With priorities, which depend on every update so far."""
    whole, folder = tmp_path / "whole", tmp_path / "run"
    assert train(whole, "buffer=prioritized").returncode == 0
    arguments = [f"run_dir={folder}", "preset=mlp", *TINY_SCENARIO, *TINY_TRAINING, "buffer=prioritized"]
    printed = tmp_path / "printed"
    process = fork(ROOT / "recipes" / "dqn.py", arguments, (str(tmp_path), dict(os.environ)), printed, printed)
    checkpoints = CheckpointFolder(folder)
    deadline = time.monotonic() + 120
    while len(checkpoints.files()) < 2 and time.monotonic() < deadline and process.is_alive():
        time.sleep(0.005)
    process.kill()
    process.join()
    killed_at = int(checkpoints.files()[-1].stem.split("_")[1])
    assert killed_at < 960, "the run had ended before it was killed"
    done = run("dqn.py", *arguments, "resume=true")
    assert done.returncode == 0, done.stderr
    state = load_file(CheckpointFolder(whole).files()[-1])
    assert_same(state, load_file(checkpoints.files()[-1]))
    assert scalars(folder) == scalars(whole)
    assert state["buffer"]["sampler"]["largest"]


def test_a_truncated_checkpoint_is_named_and_the_one_before_used(whole_run, tmp_path):
    folder = tmp_path / "run"
    assert train(folder, "collector.total_frames=640").returncode == 0
    newest = CheckpointFolder(folder).files()[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    done = train(folder, "resume=true")
    assert done.returncode == 0, done.stderr
    assert newest.name in done.stderr and "truncated" in done.stderr
    whole, _ = whole_run
    assert_same(load_file(CheckpointFolder(whole).files()[-1]), load_file(CheckpointFolder(folder).files()[-1]))


def test_ctrl_c_saves_and_says_how_to_resume(tmp_path):
    folder = tmp_path / "run"
    arguments = [f"run_dir={folder}", *TINY_SCENARIO, *TINY_TRAINING, "preset=mlp", "collector.total_frames=10_000_000"]
    process = subprocess.Popen(command("dqn.py", *arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not CheckpointFolder(folder).files() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "resume=true" in printed and str(folder) in printed


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (["learner.lrr=1"], ["lrr"]),
        (["scenario.substrate.nodes=1"], ["nodes"]),
        (["scenario.substrate.vm_capacity=[-5,10]"], ["vm_capacity"]),
        (["scenario.substrate.path=nowhere.graphml"], ["nowhere.graphml"]),
        (["device=tpu"], ["device: tpu", "auto"]),
        (["device=meta"], ["device: meta", "auto"]),
        (["resume=true"], ["error: resume: ", "no checkpoint"]),
        (["network.hidden=[65536,65536]"], ["network.hidden=[65536, 65536]", "GB"]),
        ([f"scenario.substrate.path={'a' * 3000}"], ["substrate.path: 'aaa", "aaa... is neither"]),
    ],
)
def test_bad_input_gets_one_clear_error(tmp_path, overrides, names):
    done = train(tmp_path / "run", *overrides)
    assert done.returncode != 0
    for name in names:
        assert name in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_resume_with_another_config_is_refused(whole_run):
    folder, _ = whole_run
    done = train(folder, "resume=true", "learner.lr=0.1")
    assert done.returncode == 2 and "learner.lr" in done.stderr


def test_an_older_run_is_set_aside(whole_run, tmp_path):
    folder = tmp_path / "run"
    for _ in range(2):
        done = train(folder, "collector.total_frames=64", "eval.interval=0")
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.1" / "config.yaml").exists() and "run.1" in done.stdout


def test_the_paper_preset_runs(tmp_path):
    done = run("dqn.py", f"run_dir={tmp_path / 'run'}", *TINY_SCENARIO, "preset=paper", "collector.total_frames=256",
               "eval.interval=0", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
