"""Requests that were rejected although they fitted."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from nfv_torchrl.errors import AuditError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.turned_away import shares_turned_away, turned_away
from nfv_torchrl.methods import PlannerMethod, RandomMethod
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.scenario.scenario import Scenario

WEB = {"chain": ["NAT", "FW"], "rate": 0.1, "tolerable_delay": 500, "weight": 1}
WORLD = {
    "substrate": {"nodes": 6},
    "horizon": 60,
    "arrival_rate": 10,
    "services": {"web": WEB, "never": {**WEB, "tolerable_delay": 0.01}},
}


class Refusing(MyopicPlanner):
    """The cheapest walk, but for every second request of those that have one; for one environment."""

    def __init__(self):
        super().__init__()
        self.had, self.refused = 0, []

    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        for b in rows.tolist():
            self.had += lengths[b] > 0
            self.refused.append(bool(lengths[b] > 0 and self.had % 2 == 0))
            lengths[b] *= not self.refused[-1]


def run(method, **changes):
    return run_method(Scenario.from_config({**WORLD, **changes}), method, [0])[0]


def test_a_request_without_any_walk_is_not_turned_away():
    planner = Refusing()
    record = run(PlannerMethod(planner, name="refusing"))
    assert turned_away(record).tolist() == planner.refused
    assert 0 < sum(planner.refused) < (~record.accepted).sum()
    web = record.workload.service == 0
    share = np.mean(np.array(planner.refused)[web])
    assert shares_turned_away(record) == {"turned_away/web": share, "turned_away/never": 0.0}


@pytest.mark.parametrize(
    "changes", [{}, {"colocation": True}, {"mean_lifetime": 5, "failures": {"p_fail_link": 0.02, "p_repair": 0.2}}]
)
def test_the_exact_search_turns_nobody_away(changes):
    crowded = {"substrate": {"nodes": 6, "vm_capacity": [5, 15]}, "services": {"web": {**WEB, "rate": 4}}, **changes}
    record = run(PlannerMethod(MyopicPlanner(), name="myopic_optimal"), **crowded)
    assert not record.accepted.all() and not turned_away(record).any()


def test_walks_that_failed_on_the_way_are_asked_about_too():
    record = run(RandomMethod(name="random"))
    assert turned_away(record).sum() > (~record.accepted & (record.workload.service == 0)).sum() / 2


def test_a_record_of_something_else_is_refused():
    record = run(PlannerMethod(MyopicPlanner(), name="myopic_optimal"))
    with pytest.raises(AuditError, match="comes out differently"):
        turned_away(dataclasses.replace(record, cost=record.cost + 1))
