"""Fitness: what a policy wins over ``myopic_optimal`` on the same requests, whole horizons, compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import fmean
from typing import NamedTuple

import numpy as np

from nfv_torchrl.bounds.bound import blind_bound, hindsight_bound
from nfv_torchrl.evaluation.statistics import cost_ratio
from nfv_torchrl.evolution.tasks import Task
from nfv_torchrl.methods.evolved import Evolvable, Player
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.planners.learned_prices import LearnedPrices
from nfv_torchrl.simulator import Simulator


class Score(NamedTuple):
    """How one policy did on one task."""

    aar: float
    myopic_aar: float  # of `myopic_optimal` on the same requests
    paired_cost: float  # over `myopic_optimal`, over the requests both accept
    fitness: float


class Baseline(NamedTuple):
    """What ``myopic_optimal`` does on a task: cost of every request, float64 [R] (NaN: rejected), and the gap above."""

    costs: np.ndarray
    gap: float


def summary(scores: Sequence[Score]) -> dict[str, float]:
    """Means over tasks: ``fitness``, ``aar``, ``aar_gain`` (over ``myopic_optimal``) and ``paired_cost``."""
    aar, myopic, paired, fitness = (fmean(column) for column in zip(*scores, strict=True))
    return {"fitness": fitness, "aar": aar, "aar_gain": aar - myopic, "paired_cost": paired}


class Arena:
    """Plays policies on tasks in several threads; results do not depend on how many.

    The fitness of a task is (AAR - AAR of ``myopic_optimal``) / (gap + spread) - cost_weight * max(0, paired cost - 1)
    - saving_weight * (paired cost - 1). ``gap`` is what the bound on AAR leaves above ``myopic_optimal`` (the
    lifetime-blind bound, or that in hindsight where lifetimes are seen): a network with little to win counts as much as
    one with much.

    Args:
        threads: threads, each with simulators of its own.
        cost_weight: for every unit by which the paired cost exceeds that of ``myopic_optimal``.
        saving_weight: for the paired cost itself, above or below.
        spread: keeps the division tame where there is hardly a gap.
    """

    def __init__(
        self, *, threads: int = 2, cost_weight: float = 1.0, saving_weight: float = 0.05, spread: float = 0.01
    ) -> None:
        self.threads = threads
        self.cost_weight, self.saving_weight, self.spread = cost_weight, saving_weight, spread
        self._pool = ThreadPoolExecutor(threads)

    def scores(self, policies: Sequence[Evolvable], tasks: Sequence[Task]) -> list[list[Score]]:
        """Every policy on every task: a list for each policy."""
        baselines = list(self._pool.map(self._baseline, tasks))
        jobs = [(policy, task, base) for policy in policies for task, base in zip(tasks, baselines, strict=True)]
        flat = list(self._pool.map(lambda job: self._score(*job), jobs))
        size = len(tasks)
        return [flat[first : first + size] for first in range(0, len(flat), size)]

    def _baseline(self, task: Task) -> Baseline:
        costs = self._costs(LearnedPrices(PriceNetwork().weights()), task)
        myopic = float(np.isfinite(costs).mean())
        if myopic == 1.0:
            return Baseline(costs, 0.0)
        upper = hindsight_bound if task.scenario.observe_lifetime else blind_bound
        return Baseline(costs, max(upper(task.scenario, task.workload, task.timeline).aar - myopic, 0.0))

    def _score(self, policy: Evolvable, task: Task, baseline: Baseline) -> Score:
        settled = Task(policy.settings(task.scenario), task.workload, task.timeline)
        costs = self._costs(policy.player(), settled)
        paired = cost_ratio(costs, baseline.costs)
        paired = 1.0 if math.isnan(paired) else paired
        aar, myopic = float(np.isfinite(costs).mean()), float(np.isfinite(baseline.costs).mean())
        gain = (aar - myopic) / (baseline.gap + self.spread)
        fitness = gain - self.cost_weight * max(0.0, paired - 1.0) - self.saving_weight * (paired - 1.0)
        return Score(aar, myopic, paired, fitness)

    def _costs(self, player: Player, task: Task) -> np.ndarray:
        """What every request of the task cost ($), float64 [R], NaN if it was not accepted."""
        simulator = Simulator(task.scenario, 1)
        simulator.start(0, task.workload, task.timeline)
        player.prepare(simulator.world)
        costs = np.full(len(task.workload), np.nan)
        player.play(simulator, 0, costs)
        return costs

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()
