"""Computes cells in several processes, each once its needs are there."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

import torch

from nfv_torchrl.experiments import training
from nfv_torchrl.experiments.cells import Cell, CellStore, with_needs
from nfv_torchrl.experiments.work import work

Report = Callable[[Cell, list[Cell]], object]
"""Called with a cell that has ended and those that are at work."""
SECONDS_BETWEEN_LOOKS = 2.0
KILLED = "its process was killed (too little memory?); start again to go on, with fewer jobs"


def compute(cells: Iterable[Cell], store: CellStore, *, jobs: int, report: Report | None = None) -> dict[str, str]:
    """Compute the ``cells`` that the store lacks, and what they need, in ``jobs`` processes.

    A cell that fails takes those that need it with it; the others go on. An interruption (Ctrl-C, SIGTERM, SIGUSR1)
    lets what is at work end, or training save, and starts nothing more.

    Returns:
        What went wrong, by the key of the cell.
    """
    wanted = with_needs(cells)
    lacking = [cell for cell in wanted if not store.has(cell)]
    for cell in wanted:  # a worker may have been killed before it did
        if cell.kind == "training" and cell not in lacking:
            training.drop_checkpoints(cell, store)
    failures: dict[str, str] = {}
    together = [cell for cell in lacking if not cell.alone]
    _compute(sorted(together, key=_urgency), store, jobs, failures, report)
    _compute([cell for cell in lacking if cell.alone], store, 1, failures, report)
    return failures


def _urgency(cell: Cell) -> int:
    """Training takes longest and others wait for it; what waited for it is next."""
    return 0 if cell.kind == "training" else 1 if cell.needs else 2


def _compute(waiting: list[Cell], store: CellStore, jobs: int, failures: dict[str, str], report: Report | None) -> None:
    if not waiting:
        return
    context = multiprocessing.get_context("spawn")
    atwork: dict[Future[None], Cell] = {}
    with ProcessPoolExecutor(min(jobs, len(waiting)), context, initializer=_start_worker) as pool:
        try:
            while waiting or atwork:
                _drop_hopeless(waiting, failures, report)
                for cell in [cell for cell in waiting if all(map(store.has, cell.needs))][: jobs - len(atwork)]:
                    waiting.remove(cell)
                    atwork[pool.submit(work, cell, store)] = cell
                for future in wait(atwork, return_when=FIRST_COMPLETED).done:
                    cell = atwork.pop(future)
                    if (error := future.exception()) is not None:
                        failures[cell.key] = _told(error)
                    if report is not None:
                        report(cell, list(atwork.values()))
        except BrokenProcessPool:  # found when submitting; those at work are lost too
            failures |= {cell.key: KILLED for cell in [*waiting, *atwork.values()]}
        except KeyboardInterrupt:
            print("\nStopping: what is at work ends, training saves; start again to go on.", flush=True)
            for worker in multiprocessing.active_children():
                worker.terminate()  # they let it end, see _start_worker
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _drop_hopeless(waiting: list[Cell], failures: dict[str, str], report: Report | None) -> None:
    for cell in list(waiting):
        failed = [need.key for need in cell.needs if need.key in failures]
        if failed:
            waiting.remove(cell)
            failures[cell.key] = f"needs {failed[0]}, which failed"
            if report is not None:
                report(cell, [])


def _told(error: BaseException) -> str:
    if isinstance(error, BrokenProcessPool):
        return KILLED
    return "".join(traceback.format_exception_only(error)).strip()


def _start_worker() -> None:
    """One thread for tensor operations; the main process alone answers Ctrl-C; nobody outlives it."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, lambda *_: None)  # unlike SIG_IGN not inherited by recipes, which save and stop
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, training.stop)
    threading.Thread(target=_leave_with, args=(os.getppid(),), daemon=True).start()


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(SECONDS_BETWEEN_LOOKS)
    if training.running is not None:
        training.running.terminate()
    os._exit(1)
