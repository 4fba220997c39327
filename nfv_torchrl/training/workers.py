"""What runs in a worker process: its part of the environments, with a collector that can say where it is."""

from __future__ import annotations

import math
import pickle
import signal
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from queue import Empty
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.env_state import EnvState

SECONDS_BETWEEN_LOOKS = 0.5
"""At whether a worker that says nothing is still there."""


@dataclass
class Part:
    """A worker's part of the environments; calling it makes them.

    Args:
        make_env: of scenarios and a batch size.
        scenarios: where the environments live, in turn.
        size: number of environments.
        first: number of the first of them among all.
        random: torch's random numbers that the worker begins with.
        state: of its environments, to go on from; None: they begin anew.
    """

    make_env: Callable[[Sequence[Scenario], int], NFVEnv]
    scenarios: Sequence[Scenario]
    size: int
    first: int
    random: Tensor
    state: Mapping[str, Any] | None

    def __call__(self) -> NFVEnv:
        """The environments, with ``random_numbers`` for the collector."""
        env = self.make_env(self.scenarios, self.size)
        env.first = self.first
        env.random_numbers = self.random
        if self.state is not None:
            EnvState(env).load_state_dict(self.state)
        return env


class WorkerCollector(Collector):
    """A collector that begins with the random numbers of its part, and whose state is all that it goes on from."""

    _began = False

    def rollout(self) -> TensorDictBase:
        """The next batch."""
        if not self._began:
            # As late as can be: making the collector draws some. Ctrl-C is for the main process, which ends this one.
            _ignore_interrupts()
            torch.set_rng_state(self.env.random_numbers)
            self._began = True
        return super().rollout()

    def receive_policy(self, weights: Mapping[str, Tensor]) -> None:
        """Act by ``weights`` from now on, a ``state_dict`` of the policy on the CPU; how Ray's actors get them."""
        assert isinstance(self.policy, nn.Module)
        self.policy.load_state_dict(weights)

    def state_dict(self) -> OrderedDict:
        """Environments and random numbers as one tensor of bytes, which any channel carries."""
        state = {"env": EnvState(self.env).state_dict(), "random": torch.get_rng_state()}
        return OrderedDict(state=torch.from_numpy(np.frombuffer(pickle.dumps(state), np.uint8).copy()))


class Answers:
    """A queue in which a worker says that it has the weights; TorchRL would wait for a dead one for ever."""

    def __init__(self, queue: Any, process: BaseProcess) -> None:
        self._queue, self._process = queue, process

    def get(self, timeout: float | None = None) -> Any:
        """The next answer, also for a worker that is gone: what it fails at is said where its next batch is asked for.

        Raises:
            queue.Empty: ``timeout`` (s) is over.
        """
        end = math.inf if timeout is None else time.monotonic() + timeout
        while True:
            try:
                return self._queue.get(timeout=min(SECONDS_BETWEEN_LOOKS, max(end - time.monotonic(), 0)))
            except Empty:
                if not self._process.is_alive():
                    return "updated"
                if time.monotonic() >= end:
                    raise


def unpack_worker(state: Mapping[str, Any]) -> dict[str, Any]:
    """What ``WorkerCollector.state_dict`` packed; it comes from a process of this run, so it may be a pickle."""
    return pickle.loads(state["state"].numpy().tobytes())


def _ignore_interrupts() -> None:
    try:
        for number in (signal.SIGINT, signal.SIGUSR1):
            signal.signal(number, signal.SIG_IGN)
    except ValueError:  # Ray's actors work in threads, and Ray sees to signals itself
        pass
