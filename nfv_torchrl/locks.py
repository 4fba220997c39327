"""Locks on what a command writes to. The system releases them, however the process that holds one ends."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import time
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from nfv_torchrl.errors import ScenarioError

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EBADF}
"""What file systems without locks answer."""
LONGEST_NOTE = 4096
_of_command: ContextVar[list[Lock] | None] = ContextVar("_of_command", default=None)


class Lock:
    """An exclusive lock on the file ``path``, which is made and says who holds it.

    The lock is the open file's, not the name's: it stays when the folder around it is renamed.

    Args:
        path: the file, in a folder that exists.
        what: what is locked, for messages, such as ``run_dir: runs/dqn``.
        kind: kept in the file.
        passing: the file is removed with the lock. Otherwise it stays, and marks the folder as one of ours.

    Raises:
        ScenarioError: somebody holds it, or the file cannot be written.
    """

    def __init__(self, path: Path, what: str, kind: str, *, passing: bool = False) -> None:
        self.path, self.passing = path, passing
        try:
            self._take(what)
            self._describe(kind)
        except OSError as error:
            raise ScenarioError(f"{what} cannot be written ({error.strerror}); name another place") from error
        held = _of_command.get()
        if held is not None:
            held.append(self)

    def in_place(self) -> bool:
        """Whether ``path`` still is the locked file, and not moved away, removed or replaced."""
        try:
            return os.path.samestat(self.path.lstat(), os.fstat(self._file.fileno()))
        except OSError:
            return False

    def release(self) -> None:
        """Give it back; again does no harm."""
        if not self._file.closed:
            if self.passing and self.in_place():
                self.path.unlink(missing_ok=True)
            self._file.close()

    def _take(self, what: str) -> None:
        while True:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._file = os.fdopen(os.open(self.path, flags, 0o666), "r+b", buffering=0)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                with self._file as file:
                    raise ScenarioError(
                        f"{what} is in use {_holder(file.read(LONGEST_NOTE))}; let that end, or name another"
                    ) from None
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
                warnings.warn(
                    f"{what}: this file system has no locks ({error.strerror}); start nothing else there", stacklevel=4
                )
            if self.in_place():
                return
            self._file.close()  # another process removed or renamed it between the two calls

    def _describe(self, kind: str) -> None:
        started = time.strftime("%Y-%m-%d %H:%M:%S")
        note = {"kind": kind, "pid": os.getpid(), "host": socket.gethostname(), "started": started}
        self._file.truncate(0)
        self._file.write(json.dumps(note).encode() + b"\n")


def is_locked(path: Path) -> bool:
    """Whether somebody holds the lock on ``path``, as far as can be seen."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@contextlib.contextmanager
def locks_of_command() -> Iterator[None]:
    """Locks that are taken inside are given back at the end, also after an error."""
    held: list[Lock] = []
    token = _of_command.set(held)
    try:
        yield
    finally:
        _of_command.reset(token)
        for lock in held:
            lock.release()


def read_note(text: str | bytes) -> dict[str, object]:
    """What a lock file says; empty if it is damaged."""
    try:
        note = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _holder(text: bytes) -> str:
    note = read_note(text)
    if not {"pid", "host", "started"} <= note.keys():
        return "by another process"
    return f"by process {note['pid']} on {note['host']} since {note['started']}"
