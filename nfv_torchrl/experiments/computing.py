"""Computes cells by parallel workers, each once its needs are there."""

from __future__ import annotations

import os
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial

from nfv_torchrl.experiments import training
from nfv_torchrl.experiments.cells import Cell, CellStore, with_needs
from nfv_torchrl.experiments.leash import Holder, Leash, on_leash
from nfv_torchrl.experiments.work import work
from nfv_torchrl.parallel import Joblib, WorkerKilled, Workers
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.training.setup import StopRequest

Chain = tuple[Cell, ...]
"""Cells that one worker computes one after the other: a training, then the evaluations of its policy."""
Report = Callable[[Cell | None, list[Cell]], object]
"""Called with a cell that has ended (None: work begins) and the first of each chain at work."""
KILLED = "its worker was killed (too little memory?); start again to go on, with a smaller parallel.jobs"
LEFT = "was not begun, since another worker was killed; start again to go on"
STOPPING = b"\nStopping: what is at work ends, training saves; start again to go on.\n"


def compute(
    cells: Iterable[Cell], store: CellStore, *, workers: Workers, report: Report | None = None
) -> dict[str, str]:
    """Compute the ``cells`` that the store lacks, and what they need.

    A cell that fails takes those that need it with it; the others go on. An interruption (Ctrl-C, SIGTERM, SIGUSR1)
    lets what is at work end, or training save, and starts nothing more. Cells that measure time come last, one by one
    in this process. Results do not depend on the workers.

    Args:
        cells: what is wanted.
        store: where results are kept; its folder has to be the same for all workers.
        workers: see ``nfv_torchrl.parallel``.
        report: told of what begins and of every cell that has ended.

    Returns:
        What went wrong, by the key of the cell.

    Raises:
        KeyboardInterrupt: it was interrupted, with the number of the signal.
    """
    wanted = with_needs(cells)
    lacking = [cell for cell in wanted if not store.has(cell)]
    for cell in wanted:  # a worker may have been killed before it did
        if cell.kind == "training" and cell not in lacking:
            training.drop_checkpoints(cell, store)
    if not lacking:
        return {}
    with ExitStack() as stack:
        holder = Holder(store.folder)
        stack.callback(holder.let_go)
        round_ = _Round(store, holder.leash, report, stack.enter_context(_Stopping(holder)))
        together = chained(cell for cell in lacking if not cell.alone)
        if together:
            with workers:
                for chains in together:
                    round_.run(sorted(chains, key=_urgency), workers)
        for cell in lacking:
            if cell.alone:
                round_.run([(cell,)], Joblib(jobs=1))
        round_.stop.raise_if_asked()
    return round_.failures


def compute_shown(cells: Iterable[Cell], store: CellStore, workers: Workers) -> dict[str, str]:
    """``compute`` under a progress bar that names the cells at work."""
    cells = with_needs(cells)
    lacking = sum(not store.has(cell) for cell in cells)
    with ProgressBar(total=len(cells), initial=len(cells) - lacking, unit="cell") as bar:

        def report(ended: Cell | None, at_work: list[Cell]) -> None:
            bar.say(f"at work: {', '.join(cell.label for cell in at_work)}" if at_work else "")
            if ended is not None:
                bar.update()

        return compute(cells, store, workers=workers, report=report)


def chained(cells: Iterable[Cell]) -> list[list[Chain]]:
    """Waves of chains. A chain waits for nothing outside it, but for chains of earlier waves.

    Args:
        cells: needs first; needs that are not among them are there already.
    """
    place: dict[str, tuple[int, int]] = {}  # wave and number of each cell's chain
    waves: list[list[list[Cell]]] = []
    for cell in cells:
        before = {place[need.key] for need in cell.needs if need.key in place}
        if len(before) == 1:
            wave, number = place[cell.key] = before.pop()
            waves[wave][number].append(cell)
            continue
        wave = 1 + max((wave for wave, _ in before), default=-1)
        waves += [[] for _ in range(wave + 1 - len(waves))]
        place[cell.key] = wave, len(waves[wave])
        waves[wave].append([cell])
    return [[tuple(chain) for chain in wave] for wave in waves]


def work_chain(chain: Chain, *, store: CellStore, leash: Leash) -> dict[str, str]:
    """In a worker: compute the cells of a chain. Returns what went wrong, by the key of the cell."""
    failures: dict[str, str] = {}
    with on_leash(leash):
        for cell in chain:
            if (hopeless := _needs_failed(cell, failures)) is not None:
                failures[cell.key] = hopeless
                continue
            try:
                work(cell, store)
            except Exception as error:
                failures[cell.key] = "".join(traceback.format_exception_only(error)).strip()
    return failures


class _Stopping(StopRequest):
    """The first signal lets go of the workers; a second Ctrl-C ends all at once."""

    def __init__(self, holder: Holder) -> None:
        super().__init__()
        self._holder, self._number = holder, 0

    def __enter__(self) -> _Stopping:
        if threading.current_thread() is threading.main_thread():
            super().__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if threading.current_thread() is threading.main_thread():
            super().__exit__(*error)

    def _ask(self, number: int, frame: object) -> None:
        if not self.asked:
            os.write(2, STOPPING)  # print may be at work
            self._number = number
            self._holder.let_go()
        super()._ask(number, frame)  # type: ignore[arg-type]

    def raise_if_asked(self) -> None:
        if self.asked:
            raise KeyboardInterrupt(self._number)


@dataclass
class _Round:
    """One call of ``compute``."""

    store: CellStore
    leash: Leash
    report: Report | None
    stop: _Stopping
    failures: dict[str, str] = field(default_factory=dict)

    def run(self, chains: Sequence[Chain], workers: Workers) -> None:
        """Compute the chains of one wave."""
        hopeful = []
        for chain in chains:
            for cell in chain:
                if (why := _needs_failed(cell, self.failures)) is not None:
                    self._ended(cell, why, [])
            left = tuple(cell for cell in chain if cell.key not in self.failures)
            hopeful += [left] if left else []
        open_chains = dict(enumerate(hopeful))
        function = partial(work_chain, store=self.store, leash=self.leash)
        self._tell(None, hopeful[: workers.jobs])
        try:
            with closing(workers.unordered(function, self._until_stopped(hopeful))) as outcomes:  # type: ignore[type-var]
                for outcome in outcomes:
                    failed = outcome.unwrap()
                    done = open_chains.pop(outcome.place)
                    at_work = list(open_chains.values())[: workers.jobs]
                    for cell in done:
                        self._ended(cell, failed.get(cell.key), at_work)
        except WorkerKilled:
            for number, chain in enumerate(open_chains.values()):
                for cell in chain:
                    if not self.store.has(cell):
                        self._ended(cell, KILLED if number < workers.jobs else LEFT, [])

    def _until_stopped(self, chains: Sequence[Chain]) -> Iterator[Chain]:
        for chain in chains:
            if self.stop.asked:
                return
            yield chain

    def _ended(self, cell: Cell, why: str | None, at_work: Sequence[Chain]) -> None:
        if why is not None:
            self.failures[cell.key] = why
        self._tell(cell, at_work)

    def _tell(self, ended: Cell | None, at_work: Sequence[Chain]) -> None:
        if self.report is not None and not self.stop.asked:
            self.report(ended, [chain[0] for chain in at_work])


def _urgency(chain: Chain) -> int:
    """Training takes longest; what waited for it is next."""
    return 0 if chain[0].kind == "training" else 1 if chain[0].needs else 2


def _needs_failed(cell: Cell, failures: dict[str, str]) -> str | None:
    failed = [need.key for need in cell.needs if need.key in failures]
    return f"needs {failed[0]}, which failed" if failed else None
