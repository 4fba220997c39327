"""``.pt`` files of tensors and plain values: written whole or not at all, read without executing pickled code."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, BinaryIO

import torch

from nfv_torchrl.archive import check_archive, check_values, machine_memory
from nfv_torchrl.errors import CheckpointError, one_line


def save_file(path: str | os.PathLike[str], content: dict[str, Any]) -> Path:
    """Write ``content`` (tensors, numbers, strings, and lists and dicts of them) to ``path``: all of it or nothing.

    The file is written under another name in the same folder, flushed to the disk and renamed.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            _save(content, file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    except OSError as error:
        error.filename = str(target)  # a full disk does not say which file it is about
        raise
    finally:
        partial.unlink(missing_ok=True)
    return target


def _save(content: dict[str, Any], file: BinaryIO) -> None:
    """``torch.save``, which hides what the system says under an error of its own."""
    try:
        torch.save(content, file)
    except RuntimeError as error:
        cause = error.__context__
        if isinstance(cause, OSError):
            raise OSError(cause.errno, cause.strerror) from error
        raise


def load_file(path: str | os.PathLike[str], *, largest: int | None = None) -> dict[str, Any]:
    """Read what ``save_file`` wrote, with every byte checked; nothing in the file is executed.

    Args:
        path: the file.
        largest: bytes that are read at most; None: as much as the machine has memory.

    Raises:
        CheckpointError: the file is missing, too large, truncated, damaged or not a checkpoint.
    """
    source = Path(path)
    if not source.is_file():
        raise CheckpointError(f"{source}: no checkpoint is there; give the path of a .pt file that a recipe wrote")
    try:
        check_archive(source, machine_memory() if largest is None else largest)
        content = torch.load(source, map_location="cpu", weights_only=True)
        check_values(source, content)
    except CheckpointError:
        raise
    except Exception as error:  # whatever a damaged file makes the readers raise
        raise CheckpointError(
            f"{source} is truncated or not a checkpoint ({one_line(error)}); use another one"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{source} holds a {type(content).__name__}, not a checkpoint of this project")
    return content
