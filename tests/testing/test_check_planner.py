"""``check_planner`` passes the project's planners and catches a planted fault of each kind."""

import numpy as np
import pytest

from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, PricedPlanner, TabuPlanner
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.testing import check_planner


@pytest.mark.parametrize("planner", [GreedyPlanner, MyopicPlanner, PricedPlanner, TabuPlanner])
def test_the_planners_of_the_project_pass(planner):
    check_planner(planner())


class OverbooksVms(GreedyPlanner):
    """Plans as if every VM were empty."""

    def plan_rows(self, world, rows, plans, lengths):
        whole = world.tables.vm_capacity[world.env["net"]]
        super().plan_rows(world._replace(ledger=world.ledger._replace(vm_offered=whole)), rows, plans, lengths)


class WritesIntoTheWorld(GreedyPlanner):
    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        world.ledger.vm_offered[rows, 0, 0] -= 1


class WritesIntoOtherRows(GreedyPlanner):
    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        lengths[np.setdiff1d(np.arange(len(lengths)), rows)] = 0


class StopsEarly(GreedyPlanner):
    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        lengths[rows] = (lengths[rows] - 1).clip(0)


class DependsOnTheOthers(GreedyPlanner):
    """Refuses one of several requests."""

    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        if len(rows) > 1:
            lengths[rows[-1]] = 0


class HasTooManyActions(GreedyPlanner):
    def plan_rows(self, world, rows, plans, lengths):
        lengths[rows] = plans.shape[1] + 1


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (OverbooksVms, r"refused by the network \(vm_capacity\)"),
        (WritesIntoTheWorld, "writes into the world"),
        (WritesIntoOtherRows, "rows that it was not asked for"),
        (StopsEarly, "a plan ends before"),
        (DependsOnTheOthers, "alone instead of among others"),
        (HasTooManyActions, "actions; 0 to"),
    ],
)
def test_a_fault_is_named(faulty, complaint):
    with pytest.raises(AssertionError, match=complaint):
        check_planner(faulty())


class RefusesAll(Planner):
    """One request at a time, in plain Python."""

    def plan(self, world, b, plan):
        return 0


def test_a_planner_in_plain_python_is_one_method():
    check_planner(RefusesAll())
