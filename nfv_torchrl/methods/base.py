"""What an evaluation runs: anything that answers B networks step by step, be it a rule, a planner or a trained policy.

A method of your own is any class with the attributes of ``Method``; in a recipe's yaml it is a ``_target_``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from nfv_torchrl.simulator import Simulator


class Method(Protocol):
    """Decides for every environment of a simulator, one step of its walk at a time.

    Attributes:
        name: what tables and folders call it.
        decides_admission: it refuses by itself: its run has ``admission_control`` on, so that ``reject`` is always
            valid (reason ``rejected_by_policy``). False: as the scenario says.
        mask: the mask of its run (``adjacency`` or ``feasible``), None: as the scenario says.
        one_hot: whether the flat observation of its run ends with the one-hot request features.
    """

    name: str
    decides_admission: bool
    mask: str | None
    one_hot: bool

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """Called once before a run, when all horizons have begun. ``seeds`` [B]: the workload seed of each environment.

        The place to compile, allocate and seed: what happens here is not counted as decision time. Whatever was
        carried from step to step in an earlier run is dropped.
        """

    def act(self, simulator: Simulator) -> np.ndarray:
        """The next action of every environment, int64 [B]; it does not matter for one past its horizon."""


@runtime_checkable
class WholePlay(Protocol):
    """A method that can also answer all requests of a horizon in one call, which a runner then prefers."""

    def play(self, simulator: Simulator, b: int) -> None:
        """Answer all requests of environment b, whose horizon has begun; ``prepare`` was called before."""


@runtime_checkable
class MayStop(Protocol):
    """A method that may answer a request before it knows the best answer, and counts how often it did."""

    def unproved(self) -> np.ndarray | None:
        """How many requests of each environment since ``prepare``, int64 [B]; None: it never does."""


@runtime_checkable
class WholeWalks(Protocol):
    """A method that can also answer a request with all its steps at once, which a runner prefers to step by step."""

    def plan(self, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
        """Actions int64 [B, J] for the request in hand of every environment, whose walk has not begun, and how many
        there are, int64 [B]; 0: reject. ``prepare`` was called before."""
