"""What the paper can also be read to say: steps shared in a slot, placing once all is placed. On the toy network."""

from __future__ import annotations

import numpy as np
import pytest
import toy
from driving import begin, mask_of, outcome_of, play
from reference import STEP_LIMIT, ReferenceSimulator
from strategies import Instance
from toy import DUO, SOLO, action

from nfv_torchrl.planners.base import Planner
from nfv_torchrl.planners.milp import MilpPlanner
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.simulator import Reason, Simulator

SLOW = toy.toy_catalogue(duo_delay=1e6, solo_delay=1e6)


def both(*requests, **changes):
    """The compiled simulator and the plain one at the first of ``requests``."""
    scenario = toy.toy_scenario(catalogue=SLOW, **changes)
    workload = toy.workload_of(*requests)
    return begin([Instance(scenario, workload, FailureTimeline.empty())]), ReferenceSimulator(scenario, workload)


def take(pair, actions: list[int]) -> list[str | None]:
    """Take ``actions`` in both; the reasons, which are the same."""
    simulator, reference = pair
    reasons = []
    for each in actions:
        result = reference.step(each)
        play(simulator, [each])
        outcome = outcome_of(simulator)
        code = int(outcome["reason"])
        assert (None if code < 0 else Reason(code).name.lower()) == result["reason"]
        assert (outcome["lost_steps"], outcome["lost_cost"]) == (result["lost_steps"], result["lost_cost"])
        reasons.append(result["reason"])
    return reasons


def steps_planned(planner: Planner, simulator: Simulator) -> int:
    plans, steps = np.zeros((1, 4), np.int64), np.zeros(1, np.int64)
    planner.prepare(simulator)
    planner.plan_rows(simulator.world, np.array([0]), plans, steps)
    return int(steps[0])


def test_steps_of_a_slot_are_shared_by_the_requests_of_a_service():
    duo, other, later = (0, DUO, 0, 3, 9.0), (0, DUO, 1, 3, 9.0), (1, DUO, 0, 3, 9.0)
    walk = toy.DUO_0_TO_3[2]
    pair = both(duo, duo, duo, other, later, max_steps=5, step_budget="slot")
    assert take(pair, walk) == [None] * 3
    # Two of the five steps are left for 0-3: the third is one too many, and the two that passed are used up.
    assert take(pair, walk) == [None, None, STEP_LIMIT]
    assert outcome_of(pair[0])["lost_steps"] == 2
    assert outcome_of(pair[0])["lost_cost"] == 12 + 41
    assert take(pair, walk[:1]) == [STEP_LIMIT]
    # The duo from 1 to 3 is another of the paper's services: it has five steps of its own. So has 0-3 in the next slot.
    assert take(pair, [action(2), action(1), action(2, 0, True), action(3, 1, True)]) == [None] * 4
    assert take(pair, walk) == [None] * 3


def test_uniform_endpoints_make_a_type_a_service():
    pair = both((0, DUO, 0, 3, 9.0), (0, DUO, 1, 3, 9.0), (0, SOLO, 3, 0, 9.0), max_steps=3, step_budget="slot",
                endpoints="uniform", endpoint_pairs=None)  # fmt: skip
    assert take(pair, toy.DUO_0_TO_3[2]) == [None] * 3
    assert take(pair, [action(2)]) == [STEP_LIMIT]
    assert take(pair, toy.SOLO_3_TO_0[2]) == [None] * 3


def test_the_feasible_mask_and_planners_know_what_is_left():
    simulator, _ = both(*[(0, DUO, 0, 3, 9.0)] * 2, max_steps=4, step_budget="slot", mask="feasible")
    planners = [MyopicPlanner(), MilpPlanner()]
    assert all(steps_planned(planner, simulator) in (3, 4) for planner in planners)
    play(simulator, toy.DUO_0_TO_3[2])
    # One step is left, and the egress with both functions is further away.
    assert [steps_planned(planner, simulator) for planner in planners] == [0, 0]
    play(simulator, [action(2)])
    assert np.flatnonzero(mask_of(simulator)).tolist() == [toy.REJECT]


@pytest.mark.parametrize("mask", ["adjacency", "feasible"])
def test_placing_once_all_is_placed_counts_as_forwarding(mask):
    for rule, valid in [("masked", {0, 4, 6, 12, 14}), ("forwards", {0, 1, 4, 5, 6, 7, 12, 13, 14, 15})]:
        simulator, reference = pair = both((0, DUO, 0, 3, 9.0), placing_after_chain=rule, mask=mask)
        take(pair, toy.DUO_0_TO_3[2][:2])  # A at 1.0, B at 2.0; on to 3, on either VM
        assert set(np.flatnonzero(mask_of(simulator)).tolist()) == valid
        assert mask_of(simulator) == reference.mask()
    # It costs what the link costs and reserves nothing on 3.1.
    assert take(pair, [action(3, 1, True)]) == [None]
    assert outcome_of(simulator)["request_cost"] == 55
    assert simulator.world.ledger.vm_used[0, 0] == 30_000_000
    assert reference.running[0].steps == [[1, 0, 0], [2, 0, 1], [3, 1, None]]
