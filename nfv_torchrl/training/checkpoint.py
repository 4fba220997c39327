"""Checkpoints of a run. The last few are kept, and a resumed run continues from the newest complete one."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.tensor_files import load_file, save_file

_NAME = re.compile(r"checkpoint_(\d+)\.pt")


class CheckpointFolder:
    """The rotating checkpoints ``checkpoint_<frames>.pt`` of one run.

    Args:
        folder: the run's folder.
        keep: how many of the newest stay.
    """

    def __init__(self, folder: str | os.PathLike[str], keep: int = 3) -> None:
        if keep < 1:
            raise CheckpointError(f"saving.keep is {keep}; at least one checkpoint must stay")
        self.folder = Path(folder)
        self.keep = keep

    def files(self) -> list[Path]:
        """Checkpoints from the oldest to the newest."""
        matches = ((_NAME.fullmatch(path.name), path) for path in self.folder.glob("checkpoint_*.pt"))
        return [path for _, path in sorted((int(match[1]), path) for match, path in matches if match)]

    def save(self, frames: int, content: dict[str, Any]) -> Path:
        """Write a checkpoint and delete those that are too old."""
        path = save_file(self.folder / f"checkpoint_{frames:012d}.pt", content)
        for old in self.files()[: -self.keep]:
            old.unlink()
        return path

    def load_newest(self) -> tuple[Path, dict[str, Any]]:
        """The newest complete checkpoint. A warning names a damaged one, and the one before it is used.

        Raises:
            CheckpointError: there is none.
        """
        for path in reversed(self.files()):
            try:
                return path, load_file(path)
            except CheckpointError as error:
                warnings.warn(f"{error}; going on from the one before it", stacklevel=2)
        raise CheckpointError(f"resume: {self.folder} holds no checkpoint to go on from; start without resume=true")
