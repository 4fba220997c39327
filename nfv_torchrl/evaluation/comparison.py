"""Several methods on the same requests, seed by seed, and the statistics of their differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.metrics import compute_metrics, paired_cost
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.evaluation.statistics import (
    Interval,
    gap_closed,
    mean_interval,
    paired_difference,
    relative_difference,
)
from nfv_torchrl.scenario.request_file import Columns
from nfv_torchrl.scenario.scenario import Scenario

MYOPIC = "myopic_optimal"
"""Where the gap to a bound begins."""


@dataclass(eq=False)
class Comparison:
    """The runs of an evaluation, added one by one with ``add``; whole walks are not kept.

    A workload seed names a run. Runs may be on networks of their own (other scenario seeds), of which ``scenario`` is
    the first; what all methods are paired by is then scenario seed and workload seed together.
    ``metrics[method][seed]`` holds the metrics of a run, ``bounds[name][seed]`` an upper bound on AAR.
    """

    scenario: Scenario
    metrics: dict[str, dict[int | None, dict[str, float]]] = field(default_factory=dict)
    bounds: dict[str, dict[int | None, float]] = field(default_factory=dict)
    _records: dict[str, dict[int | None, RunRecord]] = field(default_factory=dict, repr=False)

    def add(self, record: RunRecord, metrics: dict[str, float] | None = None) -> dict[str, float]:
        """Add a run and return its metrics (computed unless given).

        Raises:
            ScenarioError: another method met other requests under the same seed.
        """
        for other in self._records.values():
            if record.workload_seed in other:
                _check_same_requests(other[record.workload_seed], record)
        metrics = compute_metrics(record) if metrics is None else metrics
        self.metrics.setdefault(record.method, {})[record.workload_seed] = metrics
        self._records.setdefault(record.method, {})[record.workload_seed] = _without_steps(record)
        return metrics

    def add_bound(self, name: str, seed: int | None, aar: float) -> None:
        """Add an upper bound on the AAR of the workload of ``seed``."""
        self.bounds.setdefault(name, {})[seed] = aar

    def scenario_of(self, method: str) -> Scenario:
        """The scenario as ``method`` ran it: mask and admission control may be its own."""
        return next(iter(self._records[method].values())).scenario

    def scenarios(self) -> dict[int | None, Scenario]:
        """The scenario of every seed: one and the same, or one for each where the scenario seed changes too."""
        return {seed: run.scenario for runs in self._records.values() for seed, run in runs.items()}

    @property
    def scenario_seeds(self) -> list[int]:
        """The different scenario seeds that runs were made on."""
        return list(dict.fromkeys(scenario.seed for scenario in self.scenarios().values()))

    @property
    def methods(self) -> list[str]:
        return list(self.metrics)

    def metric_names(self) -> list[str]:
        """The metrics there are, in the order in which they were computed."""
        return list(dict.fromkeys(key for runs in self.metrics.values() for run in runs.values() for key in run))

    def interval(self, method: str, metric: str) -> Interval:
        """Mean over seeds of a metric of one method, with its interval."""
        return mean_interval([run.get(metric, math.nan) for run in self.metrics[method].values()])

    def difference(self, method: str, reference: str, metric: str = "aar") -> Interval:
        """Paired difference of ``method`` to ``reference`` over the seeds both ran."""
        return paired_difference(*self._both(method, reference, metric))

    def relative_difference(self, method: str, reference: str, metric: str = "aar") -> Interval:
        """The same as a share of the reference's mean."""
        return relative_difference(*self._both(method, reference, metric))

    def paired_cost(self, method: str, reference: str) -> Interval:
        """Cost of ``method`` over that of ``reference`` for the requests both accept: mean over seeds of the ratio."""
        mine, other = self._records[method], self._records[reference]
        return mean_interval([paired_cost(mine[seed], other[seed]) for seed in mine if seed in other])

    def bound(self, name: str) -> Interval:
        """Mean over seeds of a bound."""
        return mean_interval(list(self.bounds[name].values()))

    def gap_closed(self, method: str, bound: str) -> Interval | None:
        """The share of the gap from `myopic_optimal` to the bound that ``method`` closes: a ratio of means over seeds.

        None where there is no gap to close (or no `myopic_optimal` to start from).
        """
        if MYOPIC not in self.metrics or bound not in self.bounds:
            return None
        start, mine, limit = self.metrics[MYOPIC], self.metrics[method], self.bounds[bound]
        seeds = [seed for seed in limit if seed in start and seed in mine]
        return gap_closed(
            [mine[seed]["aar"] for seed in seeds], [start[seed]["aar"] for seed in seeds], [limit[s] for s in seeds]
        )

    def _both(self, method: str, reference: str, metric: str) -> tuple[Sequence[float], Sequence[float]]:
        mine, other = self.metrics[method], self.metrics[reference]
        seeds = [seed for seed in mine if seed in other]
        return [mine[seed][metric] for seed in seeds], [other[seed][metric] for seed in seeds]


def _check_same_requests(first: RunRecord, second: RunRecord) -> None:
    if first.scenario.seed != second.scenario.seed:
        raise ScenarioError(
            f"{first.method} and {second.method} met the networks of scenario seeds {first.scenario.seed} and "
            f"{second.scenario.seed} under workload seed {first.workload_seed}; compare methods on the same network"
        )
    for name in Columns._fields:
        if not np.array_equal(getattr(first.workload, name), getattr(second.workload, name)):
            raise ScenarioError(
                f"{first.method} and {second.method} met different requests under seed {first.workload_seed} "
                f"({name} differs); compare methods on the same workload"
            )


def _without_steps(record: RunRecord) -> RunRecord:
    none = np.zeros(0, np.int32)
    offsets = np.zeros(record.num_requests + 1, np.int64)
    arrays = {name: getattr(record, name) for name in _KEPT}
    return RunRecord(**arrays, step_offsets=offsets, step_node=none, step_vm=none, step_function=none)


_KEPT = (
    "method", "workload_seed", "scenario", "workload", "timeline", "accepted", "reason", "delay_ms", "cost", "hops",
    "interrupted_at", "seconds", "unproved",
)  # fmt: skip
