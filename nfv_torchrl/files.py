"""Reading and writing files so that a killed process never leaves half of one."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import ScenarioError


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write ``content`` (text as UTF-8) to ``path``; missing folders are made.

    The bytes go to a temporary name in the same folder, reach the disk, and only then take the final name: whoever
    opens ``path`` sees the old file or the new one, whole.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            # mkstemp makes files private; the final one gets the usual permissions.
            os.fchmod(file.fileno(), 0o666 & ~_umask())
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The bytes of ``path``.

    Raises:
        ScenarioError: the file is missing or unreadable.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise ScenarioError(f"{path}: no such file; check the path (relative to {Path.cwd()})") from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}); give a readable file") from error


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of ``path`` (UTF-8, a byte order mark is dropped).

    Raises:
        ScenarioError: the file is missing, unreadable or not UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8 text (byte {error.start}); convert or replace the file") from error


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON object in ``path``.

    Raises:
        ScenarioError: the file cannot be read, is not JSON, or holds something other than an object.
    """
    try:
        data = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ScenarioError(f"{path}: is not valid JSON ({error}); write it again or fix that place") from error
    if not isinstance(data, dict):
        raise ScenarioError(f"{path}: holds a {type(data).__name__}, not a JSON object {{...}}")
    return data


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
