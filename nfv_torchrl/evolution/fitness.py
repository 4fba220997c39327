"""Fitness: what a policy wins over ``myopic_optimal`` on the same requests, whole horizons, compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from statistics import fmean
from typing import NamedTuple

import numpy as np

from nfv_torchrl.bounds.bound import blind_bound, blind_bound_applies, hindsight_bound
from nfv_torchrl.evaluation.statistics import cost_ratio
from nfv_torchrl.evolution.tasks import Task
from nfv_torchrl.methods.evolved import Evolvable, Player
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.parallel import Joblib, Workers
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


class Weights(NamedTuple):
    """What the fitness weighs, see ``Arena``."""

    cost_weight: float = 1.0
    saving_weight: float = 0.05
    spread: float = 0.01


class Arena:
    """Plays policies on tasks, several at the same time; results do not depend on how many, nor where.

    The fitness of a task is (AAR - AAR of ``myopic_optimal``) / (gap + spread) - cost_weight * max(0, paired cost - 1)
    - saving_weight * (paired cost - 1). ``gap`` is what the bound on AAR leaves above ``myopic_optimal`` (the
    lifetime-blind bound, or that in hindsight where lifetimes are seen or come from a file): a network with little to
    win counts as much as one with much.

    Args:
        workers: who plays, each with simulators of its own; threads serve well, since playing is compiled. What they
            have started has to be there, and is ended by whoever made them.
        cost_weight: for every unit by which the paired cost exceeds that of ``myopic_optimal``.
        saving_weight: for the paired cost itself, above or below.
        spread: keeps the division tame where there is hardly a gap.
        bound: measure gains against the gap. Without it the gap counts as 0, and gains are divided by ``spread`` alone:
            for scenarios where the bound's linear programme takes longer than all plays.
    """

    def __init__(
        self,
        workers: Workers | None = None,
        *,
        cost_weight: float = 1.0,
        saving_weight: float = 0.05,
        spread: float = 0.01,
        bound: bool = True,
    ) -> None:
        self.workers = Joblib(jobs=1) if workers is None else workers
        self.weights = Weights(cost_weight, saving_weight, spread)
        self.bound = bound

    def baselines(self, tasks: Sequence[Task]) -> list[Baseline]:
        """What ``myopic_optimal`` does on every task."""
        return list(self.workers.map(partial(baseline, bound=self.bound), tasks))

    def scores(
        self, policies: Sequence[Evolvable], tasks: Sequence[Task], baselines: Sequence[Baseline] | None = None
    ) -> list[list[Score]]:
        """Every policy on every task: a list for each policy. ``baselines`` are those of the tasks, if they are known
        already."""
        baselines = self.baselines(tasks) if baselines is None else baselines
        games = [(policy, task, base) for policy in policies for task, base in zip(tasks, baselines, strict=True)]
        flat = list(self.workers.map(partial(score, weights=self.weights), games))
        size = len(tasks)
        return [flat[first : first + size] for first in range(0, len(flat), size)]


def baseline(task: Task, bound: bool = True) -> Baseline:
    """What ``myopic_optimal`` does on a task; ``bound``: see ``Arena``."""
    costs = costs_of(LearnedPrices(PriceNetwork().weights()), task)
    myopic = float(np.isfinite(costs).mean())
    if myopic == 1.0 or not bound:
        return Baseline(costs, 0.0)
    # Of requests from files always in hindsight: this is what the published policies were evolved with.
    blind = task.scenario.workload_path is None and blind_bound_applies(task.scenario)
    upper = blind_bound if blind else hindsight_bound
    return Baseline(costs, max(upper(task.scenario, task.workload, task.timeline).aar - myopic, 0.0))


def score(game: tuple[Evolvable, Task, Baseline], weights: Weights) -> Score:
    """How a policy does on a task."""
    policy, task, base = game
    settled = Task(policy.settings(task.scenario), task.workload, task.timeline)
    costs = costs_of(policy.player(), settled)
    paired = cost_ratio(costs, base.costs)
    paired = 1.0 if math.isnan(paired) else paired
    aar, myopic = float(np.isfinite(costs).mean()), float(np.isfinite(base.costs).mean())
    gain = (aar - myopic) / (base.gap + weights.spread)
    fitness = gain - weights.cost_weight * max(0.0, paired - 1.0) - weights.saving_weight * (paired - 1.0)
    return Score(aar, myopic, paired, fitness)


def costs_of(player: Player, task: Task) -> np.ndarray:
    """What every request of the task cost ($), float64 [R], NaN if it was not accepted."""
    simulator = Simulator(task.scenario, 1)
    simulator.start(0, task.workload, task.timeline)
    player.prepare(simulator.world)
    costs = np.full(len(task.workload), np.nan)
    player.play(simulator, 0, costs)
    return costs
