"""The method of a planner: it plans a request as a whole when it arrives, and plays the plan step by step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nfv_torchrl.planners.base import Planner
from nfv_torchrl.simulator import Simulator


class PlannerMethod:
    """A planner that plans each request when it arrives and then plays its plan action by action.

    A request without an embedding, or refused by the planner, is answered with ``reject``.
    """

    decides_admission = True
    mask: str | None = None
    one_hot = False

    def __init__(self, planner: Planner, *, name: str) -> None:
        self.planner, self.name = planner, name

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._rows = np.arange(simulator.batch_size)
        self._plans = np.zeros((simulator.batch_size, simulator.world.rules.max_steps), np.int64)
        self._lengths = np.zeros(simulator.batch_size, np.int64)
        self.planner.prepare(simulator.world)
        if self.planner.unproved is not None:
            self.planner.unproved[:] = 0
        # A compiled planner compiles with its first call, be there nothing to plan.
        self.planner.plan_rows(simulator.world, self._rows[:0], self._plans, self._lengths)

    def unproved(self) -> np.ndarray | None:
        """See ``MayStop``."""
        return self.planner.unproved

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        env = simulator.world.env
        steps = env["steps"]
        fresh = np.flatnonzero((steps == 0) & (env["done"] == 0))
        if fresh.size:
            self.planner.plan_rows(simulator.world, fresh, self._plans, self._lengths)
        reject = simulator.num_actions - 1
        return np.where(steps < self._lengths, self._plans[self._rows, steps], reject)

    def plan(self, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
        """See ``WholeWalks``."""
        rows = np.flatnonzero(simulator.world.env["done"] == 0)
        self.planner.plan_rows(simulator.world, rows, self._plans, self._lengths)
        return self._plans, self._lengths


class PlannerPlay(PlannerMethod):
    """The method of a planner with ``play``, which answers all requests of a horizon in one compiled call."""

    def play(self, simulator: Simulator, b: int) -> None:
        """See ``WholePlay``."""
        self.planner.play(simulator, b)  # type: ignore[attr-defined]


def planner_method(planner: Planner, *, name: str) -> PlannerMethod:
    """``PlannerPlay`` for a planner that says it ``plays_whole``, ``PlannerMethod`` for any other."""
    return (PlannerPlay if getattr(planner, "plays_whole", False) else PlannerMethod)(planner, name=name)
