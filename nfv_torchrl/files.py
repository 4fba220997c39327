"""Reading and writing files so that a killed process never leaves half of one."""

from __future__ import annotations

import codecs
import json
import os
import stat
import tempfile
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import ScenarioError

MAX_FILE_BYTES = 256 * 10**6
"""Largest input file that is read."""


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
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(target)  # a full disk does not say which file it is about
        raise


def read_bytes(path: str | os.PathLike[str], limit: int = MAX_FILE_BYTES) -> bytes:
    """The bytes of ``path``, a regular file of at most ``limit`` bytes; both are checked before anything is read.

    Raises:
        ScenarioError: the file is missing, unreadable, too large, or a folder, pipe or device.
    """
    try:
        # Without O_NONBLOCK, opening a named pipe waits for someone to write.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            status = os.fstat(handle)
            regular = stat.S_ISREG(status.st_mode)
            # One byte more than there should be, to notice a file that grows or, as in /proc, has no size.
            content = _read(handle, status.st_size + 1) if regular and status.st_size <= limit else b""
        finally:
            os.close(handle)
    except FileNotFoundError as error:
        raise ScenarioError(f"{path}: no such file; check the path (relative to {Path.cwd()})") from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}); give a readable file") from error
    except ValueError as error:  # a null character in the path
        raise ScenarioError(f"{str(path)!r}: is no path ({error}); correct it") from error
    if not regular:
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or device"
        raise ScenarioError(f"{path}: cannot be read, it is {kind}; give a regular file")
    if status.st_size > limit:
        raise ScenarioError(
            f"{path}: has {status.st_size / 1e6:,.0f} MB, more than the {limit / 1e6:,.0f} MB that are read; "
            "give a smaller file"
        )
    if len(content) != status.st_size:
        raise ScenarioError(f"{path}: cannot be read, its size changes; wait until it is written, or copy it first")
    return content


def _read(handle: int, size: int) -> bytes:
    with open(handle, "rb", closefd=False) as file:
        return file.read(size)


def read_text(path: str | os.PathLike[str], limit: int = MAX_FILE_BYTES) -> str:
    """The text of ``path``: UTF-8, or UTF-16 with a byte order mark; marks are dropped.

    Raises:
        ScenarioError: the file cannot be read, see ``read_bytes``, or is no such text.
    """
    return decode(read_bytes(path, limit), path)


def decode(content: bytes, path: str | os.PathLike[str]) -> str:
    """The text of the bytes ``content`` of file ``path``; see ``read_text``."""
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8 text (byte {error.start}); convert or replace the file") from error


def read_json(path: str | os.PathLike[str], limit: int = MAX_FILE_BYTES) -> dict[str, Any]:
    """The JSON object in ``path``.

    Raises:
        ScenarioError: the file cannot be read, is not JSON, or holds something other than an object.
    """
    data = load_json(path, limit)
    if not isinstance(data, dict):
        raise ScenarioError(f"{path}: holds a {type(data).__name__}, not a JSON object {{...}}")
    return data


def load_json(path: str | os.PathLike[str], limit: int = MAX_FILE_BYTES) -> Any:
    """What JSON is in ``path``.

    Raises:
        ScenarioError: the file cannot be read, or is not JSON.
    """
    text = read_text(path, limit)
    try:
        return json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:  # ValueError: also integers of more than 4300 digits
        raise ScenarioError(f"{path}: is not valid JSON ({error}); write it again or fix that place") from error


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """For ``json.loads``, which would keep the last of two entries of the same name without a word.

    Raises:
        ValueError: there are such.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{key!r:.60} stands twice in one object")
        found[key] = value
    return found


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
