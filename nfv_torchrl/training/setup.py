"""Small steps that every recipe takes before its loop."""

from __future__ import annotations

import random
import signal
import zlib
from pathlib import Path
from types import FrameType

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from nfv_torchrl.errors import ScenarioError


def choose_device(name: str) -> torch.device:
    """``auto``: the GPU if there is one, else the CPU; or the device named.

    Raises:
        ScenarioError: no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ScenarioError(f"device={name} cannot be used here ({error}); try device=auto") from error
    return device


def seed_everything(seed: int) -> None:
    """Seed the global random numbers that libraries draw from; the environment has streams of its own."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  libraries draw from the global state
    torch.manual_seed(seed)


def set_threads(threads: int) -> None:
    """Threads of batched torch operations. Two on two busy cores can be far slower than one, so it is a choice."""
    if threads < 1:
        raise ScenarioError(f"threads is {threads}; at least one is needed")
    torch.set_num_threads(threads)


LONGEST_NAME = 120


def run_folder(run_dir: str | Path) -> Path:
    """The folder of this run: ``run_dir``, or in a sweep a folder of the job's own below it.

    A job is named after its overrides in their order, ``runs/sweep/loss=dqn,seed=1``, so that the same command with
    ``resume=true`` finds it again; where that gets too long, the end is replaced by a number that stands for it.
    """
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return Path(run_dir)
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(("run_dir=", "resume="))]
    name = ",".join(given).replace("/", "_") or "job"
    if len(name) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME - 9]}_{zlib.crc32(name.encode()):08x}"
    return Path(run_dir) / name


def set_aside(folder: Path) -> Path | None:
    """Rename an older run at ``folder`` to the first free of ``folder.1``, ``folder.2``, ...; returns its new name."""
    if not folder.exists() or not any(folder.iterdir()):
        return None
    number = 1
    while (older := folder.with_name(f"{folder.name}.{number}")).exists():
        number += 1
    return folder.rename(older)


class StopRequest:
    """Ctrl-C asks for an orderly stop after the current iteration; a second one stops at once."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> StopRequest:
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
