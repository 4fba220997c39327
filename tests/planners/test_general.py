"""Requests of the general model: the exact search against the integer programme, other planners against both."""

import math

import numpy as np
import pytest
from general_cases import compare, general_case, plan_and_play

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.planners.priced import PricedPlanner
from nfv_torchrl.planners.tabu import TabuPlanner


def test_the_search_costs_what_the_programme_does():
    assert 10 < sum(compare(seed) for seed in range(40)) < 30


@pytest.mark.parametrize("planner", [GreedyPlanner, TabuPlanner, PricedPlanner])
def test_plans_are_carried_out_and_no_cheaper_than_the_best(planner):
    found = 0
    for seed in range(40):
        simulator = general_case(seed)
        if planner is TabuPlanner and simulator.world.rules.free_ends:
            with pytest.raises(ScenarioError, match="tabu: plans requests whose ingress and egress are both given"):
                plan_and_play(planner(), simulator)
            continue
        cost, best = plan_and_play(planner(), simulator), plan_and_play(MyopicPlanner(), general_case(seed))
        assert cost >= best - 1e-9
        assert planner is not PricedPlanner or math.isfinite(cost) == math.isfinite(best)
        found += bool(np.isfinite(cost))
    assert found > 3
