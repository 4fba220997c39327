"""What happens inside a worker: a piece of work that never raises, in a process that does not outlive its parent."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import torch

Task = TypeVar("Task")
Result = TypeVar("Result")
SECONDS_BETWEEN_LOOKS = 1.0
before_leaving: list[Callable[[], object]] = []
"""Called in a worker whose parent has gone, before it ends: to stop what it has started."""
_settled: set[int] = set()


class Home(NamedTuple):
    """The process that asks for the work."""

    host: str
    pid: int

    @classmethod
    def here(cls) -> Home:
        """This process."""
        return cls(socket.gethostname(), os.getpid())


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """What became of the task at ``place``: its result, or the error that it raised, with its traceback as text."""

    place: int
    result: Result | None = None
    error: Exception | None = None
    trace: str = ""

    def unwrap(self) -> Any:
        """The result.

        Raises:
            Exception: the one of the task, with the worker's traceback as a note.
        """
        if self.error is not None:
            if self.trace:
                self.error.add_note(f"In a worker:\n{self.trace}")
            raise self.error
        return self.result


def attempt(home: Home, function: Callable[[Task], Result], place: int, task: Task) -> Outcome[Result]:
    """Do one task. Errors are part of the outcome, since not every backend tells of them."""
    settle(home)
    try:
        return Outcome(place, function(task))
    except Exception as error:
        if Home.here() == home:
            return Outcome(place, error=error)
        trace = traceback.format_exc()
        return Outcome(place, error=error.with_traceback(None), trace=trace)  # a traceback cannot be sent


def settle(home: Home) -> None:
    """Prepare a worker process, once: one thread for tensor operations, Ctrl-C left to the parent."""
    if Home.here() == home or os.getpid() in _settled:
        return
    _settled.add(os.getpid())
    torch.set_num_threads(1)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, lambda *_: None)  # unlike SIG_IGN not inherited by recipes, which save and stop
    if os.getppid() == home.pid:
        threading.Thread(target=_leave_with, args=(home.pid,), daemon=True).start()


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(SECONDS_BETWEEN_LOOKS)
    for farewell in before_leaving:
        farewell()
    os._exit(1)
