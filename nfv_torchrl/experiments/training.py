"""Training cells: a recipe run in a process of its own, which goes on from its checkpoint after an interruption."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.files import write_atomically
from nfv_torchrl.training.checkpoint import CheckpointFolder

CURVES = ("aar", "anuc", "cost_per_accepted", "mean_hops")
running: subprocess.Popen[bytes] | None = None
"""The recipe that this process waits for."""


class TrainingStopped(RuntimeError):
    """A training run ended before its last frame; its message says why."""


def run_folder(cell: Cell, store: CellStore) -> Path:
    """Where the run of a training cell is: config, checkpoints, policy, TensorBoard events, output.log."""
    return store.folder / "runs" / cell.key


def train(cell: Cell, store: CellStore) -> dict[str, Any]:
    """Run the recipe of the cell to its end and return its curves: ``eval`` and ``train``, lists of points.

    A point has ``frames`` and those of :data:`CURVES` that the run logged.

    Raises:
        TrainingStopped: the recipe failed or was interrupted.
    """
    spec, folder = cell.spec, run_folder(cell, store)
    # The whole scenario is a file of the recipe's own config group; a preset may change some of it.
    configs = store.folder / "configs"
    write_atomically(configs / "scenario" / f"{cell.key}.yaml", OmegaConf.to_yaml(spec["scenario"]))
    command = [
        sys.executable,
        str(store.recipes / spec["recipe"]),
        f"--config-dir={configs.resolve()}",
        f"scenario={cell.key}",
        f"run_dir={folder}",
        f"resume={'true' if CheckpointFolder(folder).files() else 'false'}",
        *spec["overrides"],
    ]
    _run(command, folder.with_suffix(".log"))
    policy = folder / spec["policy"]
    if not policy.exists():
        raise TrainingStopped(f"{folder} has no {spec['policy']}; see {folder.with_suffix('.log')}")
    result = {"run": folder.name, "policy": policy.name, **read_curves(folder)}
    # They serve to go on, and with their replay memories dozens of runs would fill a disk.
    for checkpoint in CheckpointFolder(folder).files():
        checkpoint.unlink()
    return result


def _run(command: list[str], log: Path) -> None:
    global running
    log.parent.mkdir(parents=True, exist_ok=True)
    one_thread = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with log.open("ab") as output:
        begin = output.tell()
        running = subprocess.Popen(command, stdout=output, stderr=output, env={**os.environ, **one_thread})
        code = running.wait()
        running = None
    printed = log.read_bytes()[begin:].decode(errors="replace")
    if code != 0:
        raise TrainingStopped(f"training ended with code {code}; the end of {log}:\n{printed[-1500:]}")
    if "Stopped and saved." in printed:
        raise TrainingStopped(f"training was interrupted and saved; start again to go on ({log})")


def read_curves(folder: Path) -> dict[str, list[dict[str, float]]]:
    """The points that a run logged for TensorBoard, by frames: ``eval`` (held-out workloads) and ``train``."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    tags = set(events.Tags()["scalars"])
    curves = {}
    for group in ("eval", "train"):
        points: dict[int, dict[str, float]] = {}
        for name in CURVES:
            for event in events.Scalars(f"{group}/{name}") if f"{group}/{name}" in tags else ():
                points.setdefault(event.step, {"frames": event.step})[name] = event.value
        curves[group] = [points[frames] for frames in sorted(points)]
    return curves
