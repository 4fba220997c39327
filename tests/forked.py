"""Recipes in processes forked from one that has imported everything, which takes longer than most tiny runs."""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from multiprocessing import forkserver, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import BinaryIO

SERVER = get_context("forkserver")
SERVER.set_forkserver_preload(["forked_imports"])
TESTS = Path(__file__).parent


def _start_server() -> None:
    """With this folder on its path, where it finds what it imports: it does not get ours."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(TESTS), *([before] if before else [])])
    try:
        forkserver.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def run_forked(script: Path, arguments: Sequence[str], cwd: Path | None, timeout: float) -> subprocess.CompletedProcess:
    """What ``subprocess.run([python, script, *arguments], capture_output=True, text=True)`` returns.

    The process has its own output, arguments, working folder and exit code. What a real start of Python does beside is
    not tried here: tests that send signals or look for litter start their own.
    """
    with tempfile.TemporaryDirectory(prefix="forked_") as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        process = fork(script, arguments, (str(cwd or Path.cwd()), dict(os.environ)), out, err)
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired([str(script), *arguments], timeout, out.read_bytes(), err.read_bytes())
        command = [sys.executable, str(script), *arguments]
        return subprocess.CompletedProcess(command, process.exitcode, out.read_text(), err.read_text())


def fork(
    script: str | Path, arguments: Sequence[str], place: tuple[str, dict[str, str]], out: Path, err: Path
) -> BaseProcess:
    """Start ``script``; ``place`` is its working folder and environment, ``out`` and ``err`` get what it prints."""
    _start_server()
    process = SERVER.Process(target=_become, args=(str(script), [*arguments], place, out, err))
    process.start()
    return process


class ForkedTraining:
    """In place of the ``subprocess.Popen`` by which a training cell starts its recipe.

    Its processor time is the server's, so the log of the training says 0 s.
    """

    def __init__(self, command: Sequence[str], stdout: BinaryIO, stderr: BinaryIO, env: dict[str, str]) -> None:
        self._process = fork(command[1], command[2:], (str(Path.cwd()), env), Path(stdout.name), Path(stderr.name))

    def terminate(self) -> None:
        self._process.terminate()

    def wait(self) -> int | None:
        self._process.join()
        return self._process.exitcode


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """TorchRL's collectors fork their workers; test_collecting.py has workers that begin with Python itself."""
    _start_server()
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(before, force=True)


def _become(script: str, arguments: Sequence[str], place: tuple[str, dict[str, str]], out: Path, err: Path) -> None:
    os.chdir(place[0])
    os.environ.clear()
    os.environ.update(place[1])
    for number, path in ((1, out), (2, err)):
        written = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(written, number)
        os.close(written)
    sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))  # noqa: SIM115
    sys.argv = [script, *arguments]
    try:
        runpy.run_path(script, run_name="__main__")
    finally:
        atexit._run_exitfuncs()  # multiprocessing leaves them out, and workers that nobody ends are waited for
        sys.stdout.flush()
        sys.stderr.flush()
