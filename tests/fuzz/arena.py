"""Runs cases in a process of their own, so that a crash, a hang or a full memory is an outcome like any other.

The process is forked from one that has imported everything, and is replaced when it dies. A case is a name and a
number; the same number makes the same case, so that a failure can be looked at again.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import resource
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from nfv_torchrl.errors import AuditError, CheckpointError, ScenarioError

EXPECTED = (ScenarioError, CheckpointError, AuditError)
LONGEST_MESSAGE = 1000
MEMORY = 2 << 30
"""Bytes that a case may take beyond what the imports have taken."""


class Outcome(NamedTuple):
    """``verdict``: loaded, refused, or what went wrong: traceback, not one line, crash, hang."""

    kind: str
    number: int
    verdict: str
    detail: str

    @property
    def failed(self) -> bool:
        return self.verdict not in ("loaded", "refused")


Case = Callable[[int, Path], object]
"""Gets its number and an empty folder; returns if all is well and raises what the code under test raised."""


def play(
    cases: dict[str, Case], numbers: Iterator[tuple[str, int]], patience: float, *, fresh: bool = False
) -> Iterator[Outcome]:
    """The outcome of each (kind, number).

    Args:
        cases: by their kind.
        numbers: what to run.
        patience: seconds that a case may take.
        fresh: each case in a new process, for those that change the state of theirs.
    """
    context = multiprocessing.get_context("fork")
    process, pipe = None, None
    try:
        for kind, number in numbers:
            if process is None or not process.is_alive():
                pipe, inner = context.Pipe()
                process = context.Process(target=_serve, args=(cases, inner), daemon=True)
                process.start()
                inner.close()
            assert pipe is not None
            with tempfile.TemporaryDirectory(prefix="fuzz_") as folder:  # made here, where nobody is killed
                pipe.send((kind, number, Path(folder)))
                outcome = _answer(process, pipe, kind, number, patience)
                if fresh:
                    process.kill()
                    process.join()
            yield outcome
    finally:
        if process is not None and process.is_alive():
            process.kill()


def _answer(process, pipe: Connection, kind: str, number: int, patience: float) -> Outcome:
    if pipe.poll(patience):
        try:
            return Outcome(kind, number, *pipe.recv())
        except EOFError:
            process.join()
            return Outcome(kind, number, "crash", f"the process ended with code {process.exitcode}")
    process.kill()
    process.join()
    return Outcome(kind, number, "hang", f"no answer after {patience:g} s")


def _serve(cases: dict[str, Case], pipe: Connection) -> None:
    _limit_memory()
    warnings.simplefilter("ignore")
    faulthandler.disable()  # a crash is told by its exit code
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    while True:
        try:
            kind, number, folder = pipe.recv()
        except EOFError:
            return
        pipe.send(_judge(cases[kind], number, folder))


def _judge(case: Case, number: int, folder: Path) -> tuple[str, str]:
    try:
        case(number, folder)
    except EXPECTED as error:
        text = str(error)
        clear = text and "\n" not in text and len(text) <= LONGEST_MESSAGE
        return ("refused", text) if clear else ("not one line", text[:2000])
    except BaseException:
        return "traceback", traceback.format_exc(limit=-6)[-3000:]
    return "loaded", ""


def _limit_memory() -> None:
    """Data beyond the present size is refused by the system, which Python and NumPy turn into a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
