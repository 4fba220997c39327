"""Training cells: a recipe run in a process of its own, which goes on from its checkpoint after an interruption."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import at_work
from nfv_torchrl.parallel.worker import before_leaving
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.setup import quote

CURVES = ("aar", "anuc", "cost_per_accepted", "mean_hops")
PROCESSOR_SECONDS = "processor_seconds"
"""What a point of a held-out curve says of the training until then, where the run logged it."""
running: subprocess.Popen[bytes] | None = None
"""The recipe that this process waits for."""
stopping = False
"""Whether this process was told to end."""
PROCESSOR_TIME = "Processor time: "
"""A line of the log of a training, one for each part of it."""
LONGEST_SAVING = 60.0
"""Seconds that a recipe may take to save and end."""


class TrainingStopped(RuntimeError):
    """A training run ended before its last frame; its message says why."""


def run_folder(cell: Cell, store: CellStore) -> Path:
    """Where the run of a training cell is: config, checkpoints, policy, TensorBoard events, output.log."""
    return store.folder / "runs" / cell.key


def train(cell: Cell, store: CellStore) -> dict[str, Any]:
    """Run the recipe of the cell to its end and return its curves: ``eval`` and ``train``, lists of points.

    A point has ``frames``, those of ``CURVES`` that the run logged, and in ``eval`` ``processor_seconds``.

    Raises:
        TrainingStopped: the recipe failed or was interrupted.
    """
    spec, folder = cell.spec, run_folder(cell, store)
    # The whole scenario is a file of the recipe's own config group; a preset may change some of it.
    configs = store.folder / "configs"
    write_atomically(configs / "scenario" / f"{cell.key}.yaml", OmegaConf.to_yaml(spec["scenario"]))
    _wait_for(folder)
    command = [
        sys.executable,
        str(store.recipes / spec["recipe"]),
        f"--config-dir={configs.resolve()}",
        f"scenario={cell.key}",
        f"run_dir={quote(folder)}",
        f"resume={'true' if CheckpointFolder(folder).files() else 'false'}",
        *spec["overrides"],
    ]
    _run(command, folder.with_suffix(".log"))
    policy = folder / spec["policy"]
    if not policy.exists():
        raise TrainingStopped(f"{folder} has no {spec['policy']}; see {folder.with_suffix('.log')}")
    seconds = processor_seconds(folder.with_suffix(".log"))
    return {"run": folder.name, "policy": policy.name, "processor_seconds": seconds, **read_curves(folder)}


def drop_checkpoints(cell: Cell, store: CellStore) -> None:
    """Remove the checkpoints of a training whose result is kept.

    They serve to go on, and with their replay memories dozens of runs would fill a disk.
    """
    for checkpoint in CheckpointFolder(run_folder(cell, store)).files():
        checkpoint.unlink()


def stop(number: int = signal.SIGTERM, frame: FrameType | None = None) -> None:
    """The recipe that this process waits for saves and ends, and it starts no other; also for a worker's signals."""
    global stopping
    stopping = True
    if running is not None:
        running.terminate()


before_leaving.append(stop)


def _wait_for(folder: Path) -> None:
    """A recipe that outlived its killed worker saves and ends; that takes moments."""
    end = time.monotonic() + LONGEST_SAVING
    while at_work(folder) and time.monotonic() < end:
        time.sleep(0.5)


def _run(command: list[str], log: Path) -> None:
    global running
    if stopping:
        raise TrainingStopped("training did not begin; start again to go on")
    log.parent.mkdir(parents=True, exist_ok=True)
    one_thread = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with log.open("ab") as output:
        begin = output.tell()
        running = subprocess.Popen(command, stdout=output, stderr=output, env={**os.environ, **one_thread})
        if stopping:  # the signal came just before there was something to stop
            running.terminate()
        before = _of_children()
        code = running.wait()
        running = None
        output.write(f"\n{PROCESSOR_TIME}{_of_children() - before:.1f} s\n".encode())
    printed = log.read_bytes()[begin:].decode(errors="replace")
    if code != 0:
        raise TrainingStopped(f"training ended with code {code}; the end of {log}:\n{printed[-1500:]}")
    if "Stopped and saved." in printed:
        raise TrainingStopped(f"training was interrupted and saved; start again to go on ({log})")


def processor_seconds(log: Path) -> float:
    """Processor time of a training and of its continuations, but for any whose worker was killed."""
    found = re.findall(rf"^{PROCESSOR_TIME}([\d.]+) s$", log.read_text(errors="replace"), re.MULTILINE)
    return sum(map(float, found))


def _of_children() -> float:
    """Processor time of processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def read_curves(folder: Path) -> dict[str, list[dict[str, float]]]:
    """The points that a run logged for TensorBoard, by frames: ``eval`` (held-out workloads) and ``train``."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    tags = set(events.Tags()["scalars"])
    curves = {}
    for group in ("eval", "train"):
        points: dict[int, dict[str, float]] = {}
        named = {f"{group}/{name}": name for name in CURVES}
        if group == "eval":
            named[f"speed/{PROCESSOR_SECONDS}"] = PROCESSOR_SECONDS
        for tag, name in named.items():
            for event in events.Scalars(tag) if tag in tags else ():
                points.setdefault(event.step, {"frames": event.step})[name] = event.value
        curves[group] = [points[frames] for frames in sorted(points)]
    return curves
