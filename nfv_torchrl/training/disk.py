"""How much room on the disk a run will take, said and looked for before it begins."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from nfv_torchrl.errors import TrainingError

PACKED = 10
"""A replay memory is packed to less than one part in so many (see ``compact``); of what, is seen only as it fills."""

LINE, PICTURE = 5_000, 200_000
"""Bytes in the event files of a log line and of an evaluation with its figures, generously."""


def tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in nested mappings and lists."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, Mapping):
        return sum(tensor_bytes(item) for item in value.values())
    return sum(tensor_bytes(item) for item in value) if isinstance(value, list | tuple) else 0


def check_room(
    folder: Path, state: Mapping[str, Any], config: Mapping[str, Any], *, iterations: int, memory: int = 0
) -> None:
    """Print how much room a run needs: the checkpoints kept and one being written, ``best.pt`` and the event files.

    Args:
        folder: the run's; it need not be there yet.
        state: the parts of a checkpoint.
        config: the run's; says how many checkpoints are kept, and how often it logs and evaluates.
        iterations: of the whole run, in what its intervals count.
        memory: bytes of the replay memory when it is full.

    Raises:
        TrainingError: the disk has not that much free.
    """
    parts = {name: tensor_bytes(part.state_dict()) for name, part in state.items()}
    moments = 2 * parts.get("loss", 0) if "optimizer" in parts else 0  # of Adam, after its first step
    checkpoint = sum(parts.values()) + moments + memory // PACKED
    keep = config["saving"]["keep"]
    lines = iterations // config["logger"].get("interval", 1)
    evaluations = iterations // config["eval"]["interval"] if config["eval"]["interval"] else 0
    needed = (keep + 1) * checkpoint + parts.get("loss", 0) + lines * LINE + evaluations * PICTURE
    there = folder.resolve()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if free < needed:
        raise TrainingError(
            f"run_dir: {folder} needs {_megabytes(needed)} ({keep + 1} checkpoints of {_megabytes(checkpoint)}), "
            f"and its disk has {_megabytes(free)} free; free some, name another run_dir, or keep fewer checkpoints"
        )
    print(f"Room on the disk: up to {_megabytes(needed)}, of {_megabytes(free)} free.")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB" if size < 1e7 else f"{size / 1e6:,.0f} MB"
