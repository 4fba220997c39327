"""Which policy of a training is kept: the best on networks that it neither trains on nor is reported on.

A score on one small network cannot tell that a policy refuses, or wanders, on larger ones. So a run may name random
networks of other sizes, ``eval.networks``, and the policy that does best there is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np
from hydra.utils import instantiate

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.metrics import compute_metrics, counted_cost
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.statistics import cost_ratio
from nfv_torchrl.methods import Method, PlannerMethod
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.scenario.scenario import Scenario

COST_WEIGHT = 0.1
"""What a score loses where accepted requests cost twice what they cost ``myopic_optimal``: as the reward weighs
costs."""
SEED, GENERATION = 0, 1
"""The held-out networks are those of this draw, whatever the seed of a training, which uses generation 0."""


class HeldOut:
    """Networks, a workload on each, and what the exact search of each request does there.

    Args:
        scenarios: one for each network, of the same rules.
    """

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        self.scenarios = list(scenarios)
        self.seeds = list(range(len(self.scenarios)))
        records = run_method(self.scenarios, PlannerMethod(MyopicPlanner(), name="myopic_optimal"), self.seeds)
        self._costs = [counted_cost(record) for record in records]

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> HeldOut | None:
        """Those that the config of a run names, or None.

        Raises:
            ScenarioError: networks that are drawn with different rules.
        """
        source, count = config["eval"].get("networks"), config["eval"].get("count", 0)
        if source is None or not count:
            return None
        tasks = instantiate(source)(config["scenario"]).draw(SEED, GENERATION, count)
        scenarios = [task.scenario for task in tasks]
        if len({scenario.colocation for scenario in scenarios}) > 1:
            raise ScenarioError("eval.networks.colocation: several values; held-out networks share the rules of a step")
        return cls(scenarios)

    def scores(self, method: Method) -> dict[str, float]:
        """What a policy does: ``held_out_aar``, ``held_out_paired_cost`` (over ``myopic_optimal``, on the requests that
        both accept) and ``held_out_score``, the first less ``COST_WEIGHT`` times what the second has above 1."""
        records = run_method(self.scenarios, method, self.seeds)
        aar = fmean(compute_metrics(record)["aar"] for record in records)
        ratios = [cost_ratio(counted_cost(record), cost) for record, cost in zip(records, self._costs, strict=True)]
        known = [ratio for ratio in ratios if np.isfinite(ratio)]
        cost = fmean(known) if known else np.inf
        score = aar - COST_WEIGHT * (cost - 1.0) if known else 0.0
        return {"held_out_aar": aar, "held_out_paired_cost": cost, "held_out_score": score}
