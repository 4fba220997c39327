"""The reference simulator against answers worked out on paper. The numbers of the network are drawn in ``toy.py``."""

from dataclasses import replace

import numpy as np
import pytest
import toy
from reference import (
    DELAY,
    INVALID_ACTION,
    LINK_CAPACITY,
    NO_FEASIBLE_ACTION,
    REJECTED_BY_POLICY,
    STEP_LIMIT,
    VM_CAPACITY,
    ReferenceSimulator,
    cheapest_walk,
)
from toy import DUO, REJECT, SOLO, action, toy_catalogue, toy_scenario, workload_of


def simulate(*requests, timeline=None, **changes):
    """The toy network with these requests, or with its own workload if none is named."""
    workload = workload_of(*requests) if requests else toy.toy_workload()
    return ReferenceSimulator(toy_scenario(**changes), workload, timeline)


def offered(simulator):
    return {index for index, valid in enumerate(simulator.mask()) if valid}


def play(simulator, actions):
    for index in actions:
        result = simulator.step(index)
    return result


def reserved(simulator):
    """What is taken, in Mcycles/s and Mbit/s."""
    vms = {key[:2]: amount / 1e6 for key, amount in simulator.vm_reserved.items() if amount}
    links = {link: amount / 1e6 for link, amount in enumerate(simulator.link_reserved.values()) if amount}
    return vms, links


# Actions: 4 n + 2 v + s. To node 0: 0, 1; to node 1: 4 to 7; to node 2: 8, 9; to node 3: 12 to 15; reject 16.


def test_mask_at_the_ingress():
    # From 0 to its neighbours 1 (two VMs) and 2 (one); VM 1 of nodes 0 and 2 does not exist.
    assert offered(simulate()) == {4, 5, 6, 7, 8, 9}
    # With colocation A may also go to 0.0 without a hop.
    assert offered(simulate(colocation=True)) == {1, 4, 5, 6, 7, 8, 9}
    # Admission control adds reject.
    assert offered(simulate(admission_control=True)) == {4, 5, 6, 7, 8, 9, REJECT}
    # All of it leaves time to reach 3: the slowest are A at 1.0, 110 + 250 + 185 = 545, and at 2.0, 220 + 200 + 130.
    assert offered(simulate(mask="feasible")) == {4, 5, 6, 7, 8, 9}


def test_mask_after_the_first_function():
    # At 1 after 110 + 250 = 360 ms; neighbours 0, 2, 3.
    simulator = simulate()
    simulator.step(action(1, 0, True))
    assert offered(simulator) == {0, 1, 8, 9, 12, 13, 14, 15}
    # feasible: B at 0.0 takes 360 + 110 + 500 = 970 and 295 more; B at 3.0 takes 360 + 300 + 1000. Both are over 1050.
    simulator = simulate(mask="feasible")
    simulator.step(action(1, 0, True))
    assert offered(simulator) == {0, 8, 9, 12, 14, 15}
    # With colocation also B at 1.0 (360 + 500 + 185 = 1045) and at 1.1 (360 + 200 + 185).
    simulator = simulate(mask="feasible", colocation=True)
    simulator.step(action(1, 0, True))
    assert offered(simulator) == {0, 5, 7, 8, 9, 12, 14, 15}
    # 5 ms less of budget leave B at 1.0 in with 1045 to the point, 6 ms less leave it out.
    for budget, valid in [(1045.0, True), (1044.0, False)]:
        simulator = simulate(mask="feasible", colocation=True, catalogue=toy_catalogue(duo_delay=budget))
        simulator.step(action(1, 0, True))
        assert simulator.mask()[action(1, 0, True)] is valid


def test_mask_when_all_functions_are_placed():
    simulator = simulate()
    play(simulator, [action(1, 0, True), action(2, 0, True)])
    # At 2 after 360 + 55 + 400 = 815 ms, nothing left to place: forwarding to 0, 1 (by either VM) and 3.
    assert offered(simulator) == {0, 4, 6, 8 + 4, 8 + 6}
    simulator = simulate(mask="feasible", colocation=True)
    play(simulator, [action(1, 0, True), action(2, 0, True)])
    # By 0: 815 + 220 + 295; by 1: 815 + 55 + 185 = 1055. Only 3 is within 1050, at 945.
    assert offered(simulator) == {12, 14}


def test_mask_at_the_egress_with_functions_left():
    simulator = simulate()
    play(simulator, [action(1, 1, True), action(3)])
    # The remaining functions go to VMs of the egress: B at 3.0 or 3.1.
    assert offered(simulator) == {13, 15}
    simulator = simulate(mask="feasible")
    play(simulator, [action(1, 1, True), action(3)])
    # After 110 + 100 + 300 = 510 ms only 3.1 (250 ms) is quick enough.
    assert offered(simulator) == {15}


def test_cheapest_duo():
    # A at 1.0 and B at 2.0 on 0-1-2-3: $10 + $40 + links 2 + 1 + 2 = $55; 110 + 250 + 55 + 400 + 130 = 945 ms.
    # Cheaper for B would be 1.0 ($20) or 3.0 ($20, 1000 ms). B at 1.0 takes 500 ms, links from 0 to 3 at least 295, and
    # A must come on an earlier hop: A at 1.0, bounce to 2, back to 1: 110 + 250 + 55 + 55 + 500 + 185 = 1155; A at 2.0,
    # then B at 1.0: 110 + 55 + 200 + 55 + 500 + 185 = 1105. Both exceed 1050. A at 1.1 just fits but costs $50.
    cost, delay, actions = toy.DUO_0_TO_3
    simulator = simulate()
    assert cheapest_walk(simulator) == (pytest.approx(cost), actions)
    assert [simulator.step(index)["step_cost"] for index in actions[:-1]] == [pytest.approx(12), pytest.approx(41)]
    result = simulator.step(actions[-1])
    assert result == {
        "passed": True,
        "reason": None,
        "request_done": True,
        "accepted": True,
        "step_cost": pytest.approx(2),
        "request_cost": pytest.approx(cost),
        "delay": pytest.approx(delay),
        "hops": 3,
        "lost_steps": 0,
        "lost_cost": 0,
        "slots_closed": [],
        "done": False,
    }
    assert reserved(simulator) == ({(1, 0): 10, (2, 0): 20}, {0: 1, 2: 1, 4: 1})
    assert simulator.running[0].steps == [[1, 0, 0], [2, 0, 1], [3, 0, None]]


def test_cheapest_duo_with_colocation():
    # Both on 1.0: $10 + $20 + links 2 + 1 + 2 = $35; 110 + 250 + 500 + 55 + 130 = 1045 ms.
    cost, delay, actions = toy.DUO_0_TO_3_COLOCATED
    simulator = simulate(colocation=True)
    assert cheapest_walk(simulator) == (pytest.approx(cost), actions)
    result = play(simulator, actions)
    assert (result["accepted"], result["delay"], result["hops"]) == (True, pytest.approx(delay), 3)
    assert reserved(simulator) == ({(1, 0): 30}, {0: 1, 2: 1, 4: 1})


def test_cheapest_solo():
    # A at 1.0 ($20) takes 545 + 500 = 1045 ms at least, over 1000. A at 2.0 ($40): by 3-2-0 650 + 400 = 1050, too slow;
    # by 3-2-1-0 545 + 400 = 945 for $40 + 4 + 2 + 4 = $50.
    cost, delay, actions = toy.SOLO_3_TO_0
    for colocation in (False, True):
        simulator = simulate((0, SOLO, 3, 0, 1.0), colocation=colocation)
        assert cheapest_walk(simulator) == (pytest.approx(cost), actions)
        result = play(simulator, actions)
        assert (result["delay"], result["hops"]) == (pytest.approx(delay), 3)


def test_cheapest_duo_on_a_used_network():
    # Two duos leave 50 - 40 = 10 Mcycles/s on 2.0, no room for a third B, and 40 - 20 = 20 on 1.0, just enough ($20).
    # A at 1.1, bounce to 2, B at 1.0, on by 2: $50 + $20 + links 2 + 1 + 1 + 1 + 2 = $77;
    # 110 + 100 + 55 + 55 + 500 + 55 + 130 = 1005 ms. A anywhere cheaper is too slow before B at 1.0 (see above), and
    # with B at 3.1 ($80) the least is A at 1.0 and 0-1-2-3: $95.
    cost, delay, actions = toy.DUO_0_TO_3_THIRD
    simulator = simulate(*[(0, DUO, 0, 3, 9.0)] * 3)
    for _ in range(2):
        play(simulator, toy.DUO_0_TO_3[2])
    assert cheapest_walk(simulator) == (pytest.approx(cost), actions)
    result = play(simulator, actions)
    assert (result["delay"], result["hops"]) == (pytest.approx(delay), 5)
    assert reserved(simulator) == ({(1, 0): 40, (1, 1): 10, (2, 0): 40}, {0: 3, 2: 5, 4: 3})


def test_a_whole_horizon():
    simulator = simulate()
    assert simulator.slots_closed_at_start == []
    assert play(simulator, toy.DUO_0_TO_3[2])["slots_closed"] == []

    # A at 1.1, then straight to the egress and B at 3.1: $52 + $4 + $80 = $136, 210 + 300 + 250 = 760 ms, two links.
    result = play(simulator, [action(1, 1, True), action(3), action(3, 1, True)])
    assert (result["request_cost"], result["delay"], result["hops"]) == (pytest.approx(136), pytest.approx(760), 2)
    assert result["slots_closed"] == [pytest.approx(55 + 136)]

    assert simulator.slot == 1
    assert play(simulator, toy.SOLO_3_TO_0[2])["slots_closed"] == []
    assert reserved(simulator)[0] == {(1, 0): 10, (1, 1): 10, (2, 0): 40, (3, 1): 20}
    assert reserved(simulator)[1] == {0: 4, 2: 3, 3: 1, 4: 3}

    # 2.0 has 10 left: B does not fit, A comes back. Slot 1 ends with three running, slot 2 begins with their departure.
    simulator.step(action(1, 0, True))
    assert simulator.vm_reserved[1, 0, 0] == 20_000_000
    result = simulator.step(action(2, 0, True))
    assert (result["passed"], result["reason"], result["request_done"]) == (False, VM_CAPACITY, True)
    assert (result["step_cost"], result["request_cost"]) == (0, 0)
    assert result["slots_closed"] == [pytest.approx(55 + 136 + 50), 0]
    assert simulator.slot == 3
    assert reserved(simulator) == ({}, {})

    # The last duo runs beyond the end: slots 3, 4 and 5 close with it.
    result = play(simulator, toy.DUO_0_TO_3[2])
    assert result["slots_closed"] == [pytest.approx(55)] * 3
    assert result["done"]
    assert offered(simulator) == {REJECT}
    with pytest.raises(RuntimeError):
        simulator.step(REJECT)


def test_slots_before_the_first_request_close_at_the_start():
    simulator = simulate((2, DUO, 0, 3, 1.0))
    assert simulator.slots_closed_at_start == [0, 0]
    assert simulator.slot == 2


def test_departure_slot():
    # Lifetimes 0.2, 1 and 1.5 from slot 0 on leave at 1, 1 and 2.
    simulator = simulate((0, DUO, 0, 3, 0.2), (0, DUO, 0, 3, 1.0), (0, DUO, 0, 3, 1.5))
    assert [request.departure for request in simulator.requests] == [1, 1, 2]


def test_link_capacity_counts_the_walks_own_use():
    # l1 carries 5 Mbit/s: five crossings by one duo, not a sixth.
    simulator = simulate((0, DUO, 0, 3, 1.0), catalogue=toy_catalogue(duo_delay=1e6))
    for node in (2, 0, 2, 0, 2):
        assert simulator.step(action(node))["passed"]
    assert simulator.step(action(0))["reason"] == LINK_CAPACITY
    assert reserved(simulator) == ({}, {})


def test_vm_capacity_counts_the_walks_own_use():
    # 2.0 holds 50: A and B of a duo take 30 with colocation, so the next duo's B (10 + 20 more) is one too many.
    simulator = simulate(*[(0, DUO, 0, 3, 9.0)] * 2, colocation=True, catalogue=toy_catalogue(duo_delay=1e6))
    play(simulator, [action(2, 0, True), action(2, 0, True), action(3)])
    simulator.step(action(2, 0, True))
    assert simulator.step(action(2, 0, True))["reason"] == VM_CAPACITY
    assert reserved(simulator) == ({(2, 0): 30}, {1: 1, 4: 1})


def test_delay():
    # Solo by 3-1-0 with A at 0.0: 550 + 210 + 500 = 1260 ms.
    simulator = simulate((0, SOLO, 3, 0, 1.0))
    simulator.step(action(1))
    assert simulator.step(action(0, 0, True))["reason"] == DELAY


def test_step_limit():
    simulator = simulate((0, DUO, 0, 3, 1.0), catalogue=toy_catalogue(duo_delay=1e6), max_steps=2)
    simulator.step(action(2))
    simulator.step(action(0))
    assert simulator.step(action(2))["reason"] == STEP_LIMIT
    # The feasible mask has nothing left after the last step.
    simulator = simulate((0, DUO, 0, 3, 1.0), mask="feasible", max_steps=2)
    simulator.step(action(2))
    simulator.step(action(1))
    assert offered(simulator) == {REJECT}
    # An accepted walk may use the last step: A at 1.1, B on arriving at the egress.
    simulator = simulate((0, DUO, 0, 3, 1.0), max_steps=2)
    assert play(simulator, [action(1, 1, True), action(3, 1, True)])["accepted"]


def test_checks_are_made_in_order():
    # At 2 after 220 of 230 ms and the one step allowed, on to 1.0 over l2: with both failed all four checks fail.
    failures = [(0, toy.link_resource(2), False), (0, toy.vm_resource(1, 0), False)]
    tight = toy_catalogue(duo_delay=230.0)
    for events, reason in [(failures, LINK_CAPACITY), (failures[1:], VM_CAPACITY), ([], DELAY)]:
        timeline = toy.timeline_of(*events) if events else None
        simulator = simulate((0, DUO, 0, 3, 1.0), timeline=timeline, catalogue=tight, max_steps=1)
        assert simulator.step(action(2))["passed"]
        assert simulator.step(action(1, 0, True))["reason"] == reason


@pytest.mark.parametrize("index", [action(3), action(2, 1), action(0), action(0, 0, True), -1, REJECT + 1])
def test_actions_outside_the_mask(index):
    # Not a neighbour, no such VM, the node itself (twice), out of range (twice).
    simulator = simulate()
    assert simulator.step(index)["reason"] == INVALID_ACTION
    assert simulator.cursor == 1


def test_feasible_mask_makes_the_rest_invalid():
    # B at 3.0 is possible in the paper's sense and fails by its delay; under the feasible mask it is no action at all.
    for mask, reason in [("adjacency", DELAY), ("feasible", INVALID_ACTION)]:
        simulator = simulate(mask=mask)
        simulator.step(action(1, 0, True))
        assert simulator.step(action(3, 0, True))["reason"] == reason


def test_reject():
    assert simulate().step(REJECT)["reason"] == INVALID_ACTION
    assert simulate(admission_control=True).step(REJECT)["reason"] == REJECTED_BY_POLICY
    # 0 to 3 takes 295 ms at the very least.
    nothing_fits = toy_catalogue(duo_delay=294.0)
    for admission_control in (False, True):
        simulator = simulate(catalogue=nothing_fits, mask="feasible", admission_control=admission_control)
        assert offered(simulator) == {REJECT}
        assert simulator.step(action(1))["reason"] == INVALID_ACTION
        assert simulator.step(REJECT)["reason"] == NO_FEASIBLE_ACTION


def test_failures():
    # 1.0 is down from slot 1 to 3. Of the first two duos the first one sits there and is interrupted.
    vm = toy.vm_resource(1, 0)
    simulator = simulate(timeline=toy.timeline_of((1, vm, False), (3, vm, True)))
    play(simulator, toy.DUO_0_TO_3[2])
    result = play(simulator, [action(1, 1, True), action(3), action(3, 1, True)])
    assert result["slots_closed"] == [pytest.approx(191)]
    assert [request.interrupted_at for request in simulator.requests[:2]] == [1, None]
    assert reserved(simulator) == ({(1, 1): 10, (3, 1): 20}, {0: 1, 3: 1})
    assert simulator.observation()[2] == 1.0

    play(simulator, toy.SOLO_3_TO_0[2])
    # Forwarding through node 1 needs no VM, placing on 1.0 does.
    assert simulator.step(action(1))["passed"]
    simulator.step(action(0))
    result = simulator.step(action(1, 0, True))
    assert result["reason"] == VM_CAPACITY
    assert result["slots_closed"] == [pytest.approx(136 + 50), 0]
    # Repaired in slot 3, and empty.
    assert simulator.observation()[2] == 0.0
    assert play(simulator, toy.DUO_0_TO_3[2])["accepted"]


def test_failures_at_slot_zero_come_before_the_arrivals():
    l0 = toy.link_resource(0)
    simulator = simulate(mask="feasible", timeline=toy.timeline_of((0, l0, False)))
    assert offered(simulator) == {8, 9}
    # Repaired and failed again within a slot: repairs go first.
    simulator = simulate((1, DUO, 0, 3, 1.0), timeline=toy.timeline_of((0, l0, False), (1, l0, True), (1, l0, False)))
    assert simulator.step(action(1))["reason"] == LINK_CAPACITY


def test_observation():
    simulator = simulate()
    # Eight VM places, five links; service 0 of 4, at node 0, no VM yet.
    assert simulator.observation() == [0.0] * 18
    simulator.step(action(1, 0, True))
    # 1.0: 10 of 40; l0: 1 of 10; node 1 of 0..3; VM 0; one of two functions; 360 of 1050 ms.
    vms = [0, 0, 0.25, 0, 0, 0, 0, 0]
    links = [0.1, 0, 0, 0, 0]
    assert simulator.observation() == pytest.approx([*vms, *links, 0, 1 / 3, 0, 0.5, 360 / 1050])
    simulator.step(action(1, 0, True))  # not a neighbour of itself: rejected
    simulator.step(action(1, 1, True))
    # 1.1: 10 of 100; VM 1 of 0..1; 210 ms.
    vms = [0, 0, 0, 0.1, 0, 0, 0, 0]
    assert simulator.observation() == pytest.approx([*vms, *links, 0, 1 / 3, 1, 0.5, 210 / 1050])


def test_observation_of_the_service():
    # Services in order: duo 0-3, duo 1-3, solo 3-0, solo 2-0.
    requests = [(0, DUO, 0, 3, 1.0), (0, DUO, 1, 3, 1.0), (0, SOLO, 3, 0, 1.0), (0, SOLO, 2, 0, 1.0)]
    uniform = {"endpoints": "uniform", "endpoint_pairs": None}
    for changes, shares in [({}, [0, 1 / 3, 2 / 3, 1]), (uniform, [0, 0, 1, 1])]:
        simulator = simulate(*requests, **changes)
        for expected in shares:
            assert simulator.observation()[13] == pytest.approx(expected)
            simulator.step(REJECT)


def test_used_share_is_rounded_down_to_a_thousandth():
    # A duo's rate of 1 on a link of 7: 142.857 thousandths.
    substrate = replace(toy.toy_substrate(), link_capacity=np.array([7.0, 5.0, 20.0, 4.0, 10.0]))
    simulator = simulate(substrate=substrate)
    simulator.step(action(1))
    assert simulator.observation()[8] == 0.142


def test_delay_bounds():
    simulator = simulate()
    assert [simulator.delay_to[DUO][node, 3] for node in range(4)] == pytest.approx(toy.DUO_DELAY_TO_3)
    assert [simulator.delay_to[SOLO][node, 0] for node in range(4)] == pytest.approx(toy.SOLO_DELAY_TO_0)
