"""``first_fit``, worked by hand on the network of four nodes, and on general requests against the exact search."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from exhaustive import plan_of
from general_cases import general_case, plan_and_play
from test_heuristics import duo_case
from toy import action

from nfv_torchrl.planners import FirstFitPlanner, MyopicPlanner
from nfv_torchrl.simulator.tables import Rules


def test_each_function_takes_the_nearest_node_whatever_it_costs():
    """From 0 by propagation: 1 is 10 ms away, 2 is 15 (by 1), 3 is 45. A goes to VM 1.0, B from there to 2.0 (5 ms).

    The walk ends at 3: 110 + 250, 55 + 400, 130 ms are 945 in all. With no room for A on 1.0, it takes VM 1.1.
    """
    expected = [action(1, 0, True), action(2, 0, True), action(3)]
    assert plan_of(FirstFitPlanner(), duo_case(1050.0)) == expected
    assert plan_of(FirstFitPlanner(), duo_case(944.0)) == []  # nothing is taken back for a lower delay
    case = duo_case(1050.0)
    case.vm_offered[1, 0] = 9_999_999
    assert plan_of(FirstFitPlanner(), case) == [action(1, 1, True), *expected[1:]]


def test_with_colocation_the_node_itself_is_nearest():
    """Both on VM 0.0, then 0-1-2-3: 250 + 500 + 110 + 55 + 130 = 1045 ms."""
    expected = [action(0, 0, True), action(0, 0, True), action(1), action(2), action(3)]
    assert plan_of(FirstFitPlanner(), duo_case(1050.0, colocation=True)) == expected


def test_a_node_behind_a_full_link_is_passed_over():
    """No room on l2 (1-2): B cannot go on from 1 to 2, and is 10 ms from 0, where it fits; then 0-1-2-3 has none."""
    case = duo_case(5000.0)
    case.link_offered[2] = 0
    assert plan_of(FirstFitPlanner(), case) == []
    case.vm_offered[1, 0] = case.vm_offered[1, 1] = 0  # A is 15 ms away on 2, but by l2; so on 3, also by l2
    assert plan_of(FirstFitPlanner(), case) == []
    case.link_offered[2] = 1_000_000  # room for A's way to 2 alone; B goes on to 3, the end
    assert plan_of(FirstFitPlanner(), case) == [action(1), action(2, 0, True), action(3, 0, True)]


def test_plans_are_carried_out_and_no_cheaper_than_the_best():
    found = 0
    for seed in range(60):
        cost, best = (
            plan_and_play(FirstFitPlanner(), general_case(seed)),
            plan_and_play(MyopicPlanner(), general_case(seed)),
        )
        assert cost >= best - 1e-9
        found += math.isfinite(cost)
    assert found > 6


def test_a_free_ingress_is_drawn_by_the_number_of_the_request_and_the_seed():
    case = duo_case(5000.0)._replace(ingress=-1, egress=-1, rules=Rules(True, False, False, 100, free_ends=True))
    world, plan = case.world, np.zeros(100, np.int64)

    def nodes(seed: int) -> list[int]:
        planner, found = FirstFitPlanner(seed=seed), []
        for number in range(400):
            world.env["cursor"] = number
            lengths = np.zeros(1, np.int64)
            planner.plan_rows(world, np.zeros(1, np.int64), plan[None], lengths)
            assert lengths[0] == 2
            found.append(int(plan[0]) // 4)
        return found

    assert nodes(0) == nodes(0) != nodes(1)
    assert all(70 <= times <= 130 for times in Counter(nodes(0)).values())  # each of the four a quarter
