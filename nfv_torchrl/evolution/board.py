"""What an evolution shows of itself in TensorBoard: the centre of its search beside rules, in pictures and words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np

from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.walk_figure import example_requests, walk_of
from nfv_torchrl.evolution.fitness import Baseline
from nfv_torchrl.evolution.tasks import Task
from nfv_torchrl.methods import Method
from nfv_torchrl.methods.evolved import Evolvable
from nfv_torchrl.parallel import Workers
from nfv_torchrl.training.evaluating import draw_pictures
from nfv_torchrl.training.logger import RunLogger
from nfv_torchrl.training.page import standing, what_evolves
from nfv_torchrl.training.references import EXACT, References, mean_metrics, reference_methods


class EvolutionBoard:
    """Logs every evaluation of an evolution.

    Args:
        logger: of the run.
        config: of the run; ``logger.references`` says whether rules play too, ``logger.figures`` whether pictures are
            drawn.
        held_out: the horizons of evaluations, K of them.
        baselines: what ``myopic_optimal`` does there, K of them.
        workers: who lets the rules play.
    """

    def __init__(
        self,
        logger: RunLogger,
        config: Mapping[str, Any],
        held_out: Sequence[Task],
        baselines: Sequence[Baseline],
        workers: Workers,
    ) -> None:
        self.logger, self.config, self.held_out = logger, config, held_out
        self.references = _references(held_out, baselines, workers) if config["logger"]["references"] else None

    def show(self, centre: Evolvable, values: Mapping[str, float], frames: int) -> None:
        """Log ``values`` (``fitness.summary``) of the centre of the search, and what they are read against."""
        self.logger.scalars({f"eval/{name}": value for name, value in values.items()}, frames)
        if self.references is None:
            self.logger.compared(EXACT, {"aar": values["aar"] - values["aar_gain"]}, frames)
        else:
            for name, its in self.references.metrics.items():
                self.logger.compared(name, {"aar": its["aar"]}, frames)
            self.logger.compared("bound", {"aar": self.references.bound}, frames)
        if not self.logger.resumed and not frames:
            page = what_evolves(self.config, len(self.held_out), self.references)
            self.logger.text("1 what you see", page, frames)
        self.logger.text("2 how it stands", standing(values, {}, self.references, frames), frames)
        if self.config["logger"]["figures"]:
            record = _play(self.held_out[0], centre.method("policy"))
            draw_pictures(record, self.references, self.logger, frames)


def _references(held_out: Sequence[Task], baselines: Sequence[Baseline], workers: Workers) -> References:
    """Rules and bound on the held-out horizons. Like the AAR of the agent, theirs counts every request."""
    games = [(name, task) for name in _rules() for task in held_out]
    played = list(workers.map(_rule_metrics, games))
    metrics = {
        name: {key: fmean(run[key] for run in runs) for key in runs[0]}
        for first, name in enumerate(_rules())
        if (runs := played[first * len(held_out) : (first + 1) * len(held_out)])
    }
    bound = fmean(float(np.isfinite(base.costs).mean()) + base.gap for base in baselines)
    exact = _play(held_out[0], _rules()[EXACT])
    return References(metrics, {}, bound, {request: walk_of(exact, request) for request in example_requests(exact)})


def _rules() -> dict[str, Method]:
    return {method.name: method for method in reference_methods()}


def _rule_metrics(game: tuple[str, Task]) -> dict[str, float]:
    """What a rule reaches on one horizon."""
    name, task = game
    record = _play(task, _rules()[name])
    return mean_metrics([record]) | {"aar": float(record.accepted.mean())}


def _play(task: Task, method: Method) -> RunRecord:
    """The record of a method on one horizon."""
    (record,) = run_method(task.scenario, method, [0], workloads=[task.workload])
    return record
