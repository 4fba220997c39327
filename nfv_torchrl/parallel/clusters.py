"""Ray and Dask, by joblib's backends for them: of this machine, or a cluster that is there already."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from types import ModuleType
from typing import Any

from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.parallel.workers import Workers
from nfv_torchrl.settings.values import Threads

Callback = Callable[[Any], object]


class Ray(Workers):
    """A Ray cluster, through ``ray.util.joblib``. Cells need a folder that all its machines share.

    Args:
        jobs: tasks at the same time; with one, the work is done in this process.
        address: of a cluster that is there (``ray start --head``), such as ``auto`` or ``10.0.0.1:6379``; null: a local
            one, which ends with the command.
    """

    def __init__(self, jobs: Threads = 2, address: str | None = None) -> None:
        super().__init__(jobs)
        self.address = address
        self._started = False

    def start(self) -> None:
        """See ``Workers``.

        Raises:
            ScenarioError: Ray is not installed, or there is no such cluster.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray = _installed("ray", "ray")
        if ray.is_initialized():
            return
        local = {"num_cpus": self.jobs, "include_dashboard": False} if self.address is None else {}
        try:
            ray.init(self.address or "local", log_to_driver=False, logging_level="error", **local)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise _unreached(self.address, error) from error
        self._started = True

    def end(self) -> None:
        """See ``Workers``."""
        if self._started:
            _installed("ray", "ray").shutdown()
            self._started = False

    def config(self) -> dict[str, Any]:
        """See ``Workers``."""
        return {"backend": _ray_backend()}

    def killed(self) -> tuple[type[BaseException], ...]:
        """See ``Workers``."""
        return (BrokenExecutor, _installed("ray.exceptions", "ray").RayError)


class Dask(Workers):
    """A Dask cluster. Cells need a folder that all its machines share.

    Args:
        jobs: workers of a local cluster; a cluster that is there has its own.
        address: of its scheduler, such as ``tcp://10.0.0.1:8786``; null: a local one, which ends with the command.
    """

    def __init__(self, jobs: Threads = 2, address: str | None = None) -> None:
        super().__init__(jobs)
        self.address = address
        self._client: Any = None
        self._open = contextlib.ExitStack()

    def start(self) -> None:
        """See ``Workers``.

        Raises:
            ScenarioError: Dask is not installed, or there is no such cluster.
        """
        distributed = _installed("distributed", "dask")
        try:
            place = self.address or self._local_cluster()
            self._client = self._open.enter_context(distributed.Client(place, set_as_default=False))
        except (OSError, ValueError) as error:
            self._open.close()
            raise _unreached(self.address, error) from error

    def end(self) -> None:
        """See ``Workers``."""
        self._open.close()

    def config(self) -> dict[str, Any]:
        """See ``Workers``."""
        return {"backend": _dask_backend(self._client)}

    def killed(self) -> tuple[type[BaseException], ...]:
        """See ``Workers``."""
        return (BrokenExecutor, _installed("distributed", "dask").KilledWorker)

    def _local_cluster(self) -> Any:
        # A worker that memory was too little for is not tried again by itself.
        once = {"distributed.scheduler.allowed-failures": 0}
        self._open.enter_context(_installed("dask.config", "dask").set(once))
        made = _installed("distributed", "dask").LocalCluster(
            n_workers=self.jobs, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
        )
        return self._open.enter_context(made)


def _ray_backend() -> Any:
    class Streaming(_installed("ray.util.joblib.ray_backend", "ray").RayBackend):  # type: ignore[misc]
        """Ray's backend, which yields results as they come, and gives a task to the worker that has least to do."""

        supports_return_generator = True  # it does, through its callbacks; its parent class says otherwise

        def configure(self, n_jobs: int = 1, *args: Any, **more: Any) -> int:
            workers = super().configure(n_jobs, *args, **more)
            self._tasks = [0] * workers
            self._pool._next_actor_index = lambda: self._tasks.index(min(self._tasks))
            return workers

        def submit(self, func: Callable[[], Any], callback: Callback | None = None) -> Any:
            worker = self._pool._next_actor_index()

            def ended(result: Any) -> None:
                self._tasks[worker] -= 1
                if callback is not None:
                    callback(result)

            submitted = super().submit(func, ended)
            self._tasks[worker] += 1
            return submitted

    return Streaming()


def _dask_backend(client: Any) -> Any:
    _installed("distributed", "dask")

    class Telling(_installed("joblib._dask", "dask").DaskDistributedBackend):  # type: ignore[misc]
        """Dask's backend, which also tells joblib of a task that failed; otherwise joblib would wait for it forever."""

        def submit(self, func: Callable[[], Any], callback: Callback | None = None) -> Any:
            submitted = super().submit(func, callback)

            def ended(future: Any) -> None:
                if callback is not None and not future.cancelled() and future.exception() is not None:
                    callback(future.exception())

            submitted.add_done_callback(ended)
            return submitted

    return Telling(client=client)


def _installed(module: str, extra: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ScenarioError(
            f"parallel: {extra} is not installed; run pip install 'nfv_torchrl[{extra}]', or use parallel=joblib"
        ) from error


def _unreached(address: str | None, error: BaseException) -> ScenarioError:
    where = "a local cluster" if address is None else address
    return ScenarioError(f"parallel.address: {where} cannot be reached ({one_line(error)}); start it or name another")
