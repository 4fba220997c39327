"""How workers anywhere learn that the command which asked for their work is stopping, or gone."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from nfv_torchrl.experiments import training
from nfv_torchrl.locks import Lock, is_locked
from nfv_torchrl.parallel.worker import Home

SECONDS_BETWEEN_LOOKS = 0.5
NAME = ".workers.lock"


class Leash(NamedTuple):
    """A file in the output folder that the command holds a lock on; where there are no locks, that is there at all."""

    path: Path
    locks: bool
    home: Home

    def held(self) -> bool:
        """Whether the command still is at work and wants more."""
        return self.path.exists() and (not self.locks or is_locked(self.path))


class Holder:
    """The command's end of the leash; letting go tells all workers to stop.

    Args:
        folder: the output folder, which all workers see.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = Lock(folder / NAME, f"output: {folder}", "workers", passing=True)
        self.leash = Leash(self._lock.path, is_locked(self._lock.path), Home.here())

    def let_go(self) -> None:
        """No more work; trainings save and end."""
        self._lock.release()


@contextlib.contextmanager
def on_leash(leash: Leash) -> Iterator[None]:
    """While work is done inside, its training is told to save and end once the leash is let go, or by a signal."""
    training.stopping = not leash.held()
    if Home.here() != leash.home and threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGUSR1):  # which clusters send to every process
            signal.signal(number, training.stop)
    done = threading.Event()

    def watch() -> None:
        while not done.wait(SECONDS_BETWEEN_LOOKS):
            if not leash.held():
                training.stop()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
