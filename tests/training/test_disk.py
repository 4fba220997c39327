"""How much room a run needs: counted by hand, printed, and refused where the disk has less."""

import shutil
from types import SimpleNamespace

import pytest
import torch

from nfv_torchrl.errors import TrainingError
from nfv_torchrl.training.disk import LINE, PICTURE, check_room

CONFIG = {"saving": {"keep": 2}, "logger": {"interval": 10}, "eval": {"interval": 50}}


def parts() -> dict:
    """1,000,000 weights, 4 MB, which Adam doubles twice over."""
    loss = torch.nn.Linear(1000, 1000, bias=False)
    return {"loss": loss, "optimizer": torch.optim.Adam(loss.parameters())}


def test_what_is_needed(tmp_path, monkeypatch):
    needed = 3 * (3 * 4_000_000 + 6_000_000) + 4_000_000 + 10 * LINE + 2 * PICTURE
    for free in (needed, needed - 1):
        monkeypatch.setattr(shutil, "disk_usage", lambda path, free=free: SimpleNamespace(free=free))
        if free == needed:
            check_room(tmp_path / "not" / "there", parts(), CONFIG, iterations=100, memory=60_000_000)
            continue
        with pytest.raises(
            TrainingError, match=r"^run_dir: .* needs 58 MB \(3 checkpoints of 18 MB\), and its disk has"
        ):
            check_room(tmp_path / "not" / "there", parts(), CONFIG, iterations=100, memory=60_000_000)
    assert not any(tmp_path.iterdir())


def test_it_is_said(tmp_path, capsys):
    check_room(tmp_path, parts(), CONFIG | {"eval": {"interval": 0}}, iterations=10)
    assert capsys.readouterr().out.startswith("Room on the disk: up to 40 MB, of ")
