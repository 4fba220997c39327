"""What an agent is compared with while it trains: rules, exact search and a bound on the same held-out requests."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfv_torchrl import __version__
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.bounds import aar_bounds
from nfv_torchrl.evaluation.metrics import compute_metrics, counted_cost
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.statistics import cost_ratio
from nfv_torchrl.evaluation.walk_figure import Walk, example_requests, walk_of
from nfv_torchrl.inputs import world_digests
from nfv_torchrl.methods import Method, PlannerMethod, RandomMethod
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner
from nfv_torchrl.scenario.arrivals import UNIFORM
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.tensor_files import load_file, save_file

FILE = "references.pt"
"""In the folder of a run."""
EXACT = "myopic_optimal"
PAIRED = ("greedy", EXACT)
"""Those whose costs the agent's are compared with, request by request."""
LARGEST_FILE = 10**9
Report = Callable[[int], object]
"""Told how many more requests were answered."""


def reference_methods() -> list[Method]:
    """``greedy``, ``myopic_optimal`` and ``random_feasible``, as ``recipes/config/method/`` has them."""
    return [
        PlannerMethod(GreedyPlanner(paths=10), name="greedy"),
        PlannerMethod(MyopicPlanner(), name=EXACT),
        RandomMethod(name="random_feasible", mask="feasible"),
    ]


@dataclass(frozen=True)
class References:
    """What the reference methods did on the held-out workloads, S of them.

    Attributes:
        metrics: the metrics of ``docs/metrics.md`` by name of the method, means over the workloads.
        costs: by name of a method of ``PAIRED``, cost of every request of each workload, S tensors float64 [R], $, NaN
            where it was rejected or does not count.
        bound: no method accepts a larger share, mean over the workloads; NaN if none is known.
        walks: how ``myopic_optimal`` answered some requests of the first workload, by number of the request.
    """

    metrics: dict[str, dict[str, float]]
    costs: dict[str, list[Tensor]]
    bound: float
    walks: dict[int, Walk]

    def paired_costs(self, records: Sequence[RunRecord]) -> dict[str, float]:
        """Cost of an agent over that of each method of ``PAIRED``, over the requests that both accept: mean over the
        workloads of ``records``, NaN where no request was accepted by both."""
        mine = [counted_cost(record) for record in records]
        ratios = {
            name: [cost_ratio(a, b.numpy()) for a, b in zip(mine, costs, strict=True)]
            for name, costs in self.costs.items()
        }
        return {name: _mean(values) for name, values in ratios.items()}

    @classmethod
    def of(cls, folder: Path, scenario: Scenario, seeds: Sequence[int], report: Report | None = None) -> References:
        """Those of the run in ``folder``: read from its file, or computed and written there.

        Args:
            folder: of the run.
            scenario: what the agent is evaluated in.
            seeds: the held-out workload seeds.
            report: told of requests answered, and not called where the file serves.
        """
        asked = _digest(scenario, seeds)
        try:
            content = load_file(folder / FILE, largest=LARGEST_FILE)
            if content.get("of") == asked:
                return cls._from_content(content, scenario.substrate.num_nodes)
        except (CheckpointError, KeyError, TypeError, ValueError, AttributeError):
            pass  # missing, damaged or of another version: computing them again takes seconds
        made = cls.compute(scenario, seeds, report)
        walks = {str(request): walk.content() for request, walk in made.walks.items()}
        content = {"of": asked, "metrics": made.metrics, "costs": made.costs, "bound": made.bound, "walks": walks}
        save_file(folder / FILE, content)
        return made

    @classmethod
    def compute(cls, scenario: Scenario, seeds: Sequence[int], report: Report | None = None) -> References:
        """Let every reference method answer the workloads of ``seeds``."""
        metrics, costs, walks = {}, {}, {}
        for method in reference_methods():
            records = run_method(scenario, method, seeds, progress=report)
            metrics[method.name] = mean_metrics(records)
            if method.name in PAIRED:
                costs[method.name] = [torch.from_numpy(counted_cost(record)) for record in records]
            if method.name == EXACT:
                walks = {request: walk_of(records[0], request) for request in example_requests(records[0])}
        return cls(metrics, costs, _bound(scenario, seeds), walks)

    @classmethod
    def _from_content(cls, content: Mapping[str, Any], nodes: int) -> References:
        walks = {int(request): Walk.from_content(walk, nodes) for request, walk in content["walks"].items()}
        return cls(content["metrics"], content["costs"], float(content["bound"]), walks)


def mean_metrics(records: Sequence[RunRecord]) -> dict[str, float]:
    """The metrics of ``docs/metrics.md``, means over ``records``; what one of them lacks is NaN."""
    runs = [compute_metrics(record) for record in records]
    return {key: fmean(run[key] for run in runs) for key in runs[0]}


def _bound(scenario: Scenario, seeds: Sequence[int]) -> float:
    """The bound that leaves least room: that of methods which do not see lifetimes, where the agent does not either."""
    bounds = [aar_bounds(scenario, seed) for seed in seeds]
    return _mean([each.get("blind", each["hindsight"]) for each in bounds])


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return fmean(known) if known else math.nan


def _digest(scenario: Scenario, seeds: Sequence[int]) -> str:
    """What the references depend on."""
    rules = {name: getattr(scenario, name) for name in RULES}
    if scenario.arrivals != UNIFORM:
        rules["arrivals"] = scenario.arrivals
    parts = (__version__, rules, world_digests([scenario]), [int(seed) for seed in seeds], np.__version__)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


RULES = (
    "seed", "horizon", "warmup", "arrival_rate", "mean_lifetime", "endpoints", "colocation", "mask",
    "admission_control", "observe_lifetime", "max_steps", "step_budget", "placing_after_chain", "failures",
)  # fmt: skip
"""Of a scenario, beside its network, services and endpoints."""
