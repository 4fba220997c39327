"""Where pieces of work are done: processes or threads of this machine, or what else joblib has a backend for."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from types import TracebackType
from typing import Annotated, Any, TypeVar

import joblib

from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.parallel.worker import Home, Outcome, attempt
from nfv_torchrl.settings.values import OneOf, Threads

Task = TypeVar("Task")
Result = TypeVar("Result")
Backend = Annotated[str, OneOf("loky", "threading")]


class WorkerKilled(RuntimeError):
    """A worker ended without an answer, as one that the system kills for want of memory."""


class Workers:
    """Does tasks through one of joblib's backends. It is a context: what it started ends with it.

    A class of your own overrides ``config``, and ``start`` and ``end`` if there is something to start and to end.

    Args:
        jobs: tasks at the same time.

    Example:
        >>> with Joblib(jobs=2) as workers:
        ...     list(workers.map(abs, [-1, 2, -3]))
        [1, 2, 3]
    """

    def __init__(self, jobs: Threads = 2) -> None:
        self.jobs = jobs

    def config(self) -> dict[str, Any]:
        """Arguments of ``joblib.parallel_config``."""
        raise NotImplementedError

    def start(self) -> None:
        """Make a connection, or a cluster."""

    def end(self) -> None:
        """End what ``start`` made."""

    def killed(self) -> tuple[type[BaseException], ...]:
        """What the backend raises where a worker was killed."""
        return (BrokenExecutor,)

    def __enter__(self) -> Workers:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def unordered(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Outcome[Result]]:
        """Do all tasks and yield their outcomes as they end.

        Args:
            function: what is done; a function of a module, so that other processes find it.
            tasks: its arguments, one each, which are taken one by one as workers become free.

        Raises:
            WorkerKilled: a worker was killed. What had not ended is lost.
        """
        home = Home.here()
        with joblib.parallel_config(n_jobs=self.jobs, **self.config()):
            run = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs")
            calls = (joblib.delayed(attempt)(home, function, place, task) for place, task in enumerate(tasks))
            try:
                yield from run(calls)
            except self.killed() as error:
                raise WorkerKilled(one_line(error)) from error

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Result]:
        """Do all tasks and yield their results in their order.

        Raises:
            Exception: the first that a task raised.
            ScenarioError: a worker was killed.
        """
        found: dict[int, Outcome[Result]] = {}
        awaited = 0
        try:
            with contextlib.closing(self.unordered(function, tasks)) as outcomes:  # type: ignore[type-var]
                for outcome in outcomes:
                    found[outcome.place] = outcome
                    while awaited in found:
                        yield found.pop(awaited).unwrap()
                        awaited += 1
        except WorkerKilled as error:
            raise ScenarioError(
                "parallel: a worker was killed (too little memory?); start again with a smaller parallel.jobs"
            ) from error


class Joblib(Workers):
    """This machine.

    Args:
        jobs: workers; with one, the work is done in this process.
        backend: ``loky``: processes; ``threading``: threads, for work that lets go of Python's lock.
    """

    def __init__(self, jobs: Threads = 2, backend: Backend = "loky") -> None:
        super().__init__(jobs)
        self.backend = backend

    def config(self) -> dict[str, Any]:
        """See ``Workers``."""
        return {"backend": self.backend, **({"inner_max_num_threads": 1} if self.backend == "loky" else {})}
