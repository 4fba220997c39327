"""Offline learning, run for real at tiny size: recorded once, read again, refused when it does not fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from inprocess import call
from tiny import TINY_SCENARIO

from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder

TINY = [
    *TINY_SCENARIO,
    "record.num_envs=4",
    "record.steps=32",
    "record.frames=300",
    "learner.updates=40",
    "learner.batch_size=32",
    "logger.interval=10",
    "logger.figures=false",
    "eval.interval=20",
    "eval.seeds=[1000]",
    "saving.interval=20",
]
OF_TORCHRL = "loss._target_=torchrl.objectives.{}"


def offline(folder, *overrides):
    call("offline", f"run_dir={folder}", *TINY, *overrides)


def test_recording_training_resuming_and_reuse(tmp_path, capsys):
    first = tmp_path / "first"
    offline(first)
    assert "384 transitions of greedy" in capsys.readouterr().out and (first / "best.pt").exists()
    parts = sorted((first / "dataset").glob("part_*"))
    assert len(parts) == 3
    data = {path.stem: np.load(path, allow_pickle=False) for path in parts[0].iterdir()}
    assert data["action"].shape == (4, 32)
    assert np.take_along_axis(data["action_mask"], data["action"][..., None], -1).all()
    # Step t's next state is step t + 1's state, but where a horizon ended.
    going = ~data["next.done"][:, :-1, 0]
    assert (data["next.observation"][:, :-1][going] == data["observation"][:, 1:][going]).all()

    # The same run in two halves ends at the same weights.
    shared = f"dataset={first / 'dataset'}"
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    offline(whole, shared)
    offline(halves, shared)
    CheckpointFolder(halves).files()[-1].unlink()
    offline(halves, shared, "resume=true")
    a, b = (load_file(CheckpointFolder(folder).files()[-1])["loss"] for folder in (whole, halves))
    assert all(torch.equal(a[key], b[key]) for key in a)

    # So it does where what is drawn depends on the errors so far.
    drawn = ["buffer=prioritized", shared]
    offline(tmp_path / "whole_by_errors", *drawn)
    offline(tmp_path / "halves_by_errors", *drawn)
    CheckpointFolder(tmp_path / "halves_by_errors").files()[-1].unlink()
    offline(tmp_path / "halves_by_errors", *drawn, "resume=true")
    a, b = (load_file(CheckpointFolder(tmp_path / f"{name}_by_errors").files()[-1]) for name in ("whole", "halves"))
    assert all(torch.equal(a["loss"][key], b["loss"][key]) for key in a["loss"])
    assert torch.equal(a["sampler"]["priorities"]["raw"], b["sampler"]["priorities"]["raw"])

    # Imitation learns from the same files and reads no reward, and so do classes of TorchRL's.
    for name, loss in (("clone", "loss=imitation"), ("DiscreteCQLLoss", OF_TORCHRL), ("DiscreteIQLLoss", OF_TORCHRL)):
        offline(tmp_path / name, shared, loss.format(name))
        assert (tmp_path / name / "best.pt").exists()

    # What does not fit is refused before anything is written.
    for override, name in (("network=candidate", "candidates"), ("method=[random_feasible]", "method")):
        with pytest.raises(SystemExit):
            offline(tmp_path / "refused", shared, override)
        assert name in capsys.readouterr().err
        assert not (tmp_path / "refused").exists()


def test_two_methods_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        offline(tmp_path / "run", "method=[greedy,random]")
    assert "one is recorded" in capsys.readouterr().err
