"""The compiled simulator on the toy network, held against answers worked out on paper in ``toy.py``."""

import numpy as np
import pytest
import toy
from driving import assert_books_balance, begin, mask_of, outcome_of, play
from strategies import Instance
from toy import DUO, REJECT, SOLO, action, toy_catalogue, toy_scenario, workload_of

from nfv_torchrl.scenario.units import LEDGER_UNITS
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.reasons import Reason


def simulate(*requests, timeline=None, record=False, **changes) -> Simulator:
    workload = workload_of(*requests) if requests else toy.toy_workload()
    return begin([Instance(toy_scenario(**changes), workload, timeline)], record=record)


def offered(simulator: Simulator) -> set[int]:
    return {index for index, valid in enumerate(mask_of(simulator)) if valid}


def reserved(simulator: Simulator) -> tuple[dict, dict]:
    """What is taken, in Mcycles/s and Mbit/s."""
    ledger = simulator.world.ledger
    vms = {divmod(i, toy.VMS): x / LEDGER_UNITS for i, x in enumerate(ledger.vm_reserved[0].ravel().tolist()) if x}
    return vms, {i: x / LEDGER_UNITS for i, x in enumerate(ledger.link_reserved[0].tolist()) if x}


def test_masks():
    assert offered(simulate()) == {4, 5, 6, 7, 8, 9}
    assert offered(simulate(colocation=True)) == {1, 4, 5, 6, 7, 8, 9}
    assert offered(simulate(admission_control=True)) == {4, 5, 6, 7, 8, 9, REJECT}
    simulator = simulate(mask="feasible", colocation=True)
    play(simulator, [action(1, 0, True)])
    assert offered(simulator) == {0, 5, 7, 8, 9, 12, 14, 15}
    # B at 1.0 ends at 1045 ms: in with that very budget, out with less.
    for budget, valid in [(1045.0, True), (1044.0, False)]:
        simulator = simulate(mask="feasible", colocation=True, catalogue=toy_catalogue(duo_delay=budget))
        play(simulator, [action(1, 0, True)])
        assert mask_of(simulator)[action(1, 0, True)] is valid


@pytest.mark.parametrize(
    ("request_", "changes", "walk"),
    [
        ((0, DUO, 0, 3, 9.0), {}, toy.DUO_0_TO_3),
        ((0, DUO, 0, 3, 9.0), {"colocation": True}, toy.DUO_0_TO_3_COLOCATED),
        ((0, SOLO, 3, 0, 9.0), {}, toy.SOLO_3_TO_0),
        ((0, SOLO, 3, 0, 9.0), {"mask": "feasible", "colocation": True}, toy.SOLO_3_TO_0),
    ],
)
def test_walks(request_, changes, walk):
    cost, delay, actions = walk
    simulator = simulate(request_, (5, SOLO, 2, 0, 1.0), **changes)
    outcome = play(simulator, actions)
    assert (outcome["accepted"], outcome["request_done"], outcome["reason"]) == (1, 1, -1)
    assert (outcome["request_cost"], outcome["request_delay"]) == pytest.approx((cost, delay))
    assert outcome["slots_closed"] == 5
    assert outcome["slot_cost"] == pytest.approx(5 * cost)
    assert (outcome["service"], outcome["request_slot"], outcome["done"]) == (request_[1], 0, 0)


def test_a_whole_horizon():
    simulator = simulate()
    assert [play(simulator, [a])["step_cost"] for a in toy.DUO_0_TO_3[2]] == pytest.approx([12, 41, 2])
    outcome = play(simulator, [action(1, 1, True), action(3), action(3, 1, True)])
    assert (outcome["request_cost"], outcome["request_delay"], outcome["request_hops"]) == pytest.approx((136, 760, 2))
    assert (outcome["slots_closed"], outcome["slot_cost"]) == pytest.approx((1, 55 + 136))
    # Of 330 Mcycles/s 60 are taken, of 49 Mbit/s 3 and 2.
    assert (outcome["slot_vm_use"], outcome["slot_link_use"]) == pytest.approx((60 / 330, 5 / 49))
    play(simulator, toy.SOLO_3_TO_0[2])
    assert reserved(simulator)[0] == {(1, 0): 10, (1, 1): 10, (2, 0): 40, (3, 1): 20}
    assert reserved(simulator)[1] == {0: 4, 2: 3, 3: 1, 4: 3}
    outcome = play(simulator, [action(1, 0, True), action(2, 0, True)])
    assert (outcome["passed"], outcome["reason"], outcome["step_cost"]) == (0, Reason.VM_CAPACITY, 0)
    assert (outcome["slots_closed"], outcome["slot_cost"]) == pytest.approx((2, 55 + 136 + 50))
    assert reserved(simulator) == ({}, {})
    outcome = play(simulator, toy.DUO_0_TO_3[2])
    assert (outcome["slots_closed"], outcome["slot_cost"], outcome["done"]) == pytest.approx((3, 165, 1))
    assert offered(simulator) == {REJECT}


def test_warm_up_is_left_out():
    simulator = simulate((0, DUO, 0, 3, 9.0), (3, DUO, 0, 3, 1.0), warmup=2)
    outcome = play(simulator, toy.DUO_0_TO_3[2])
    assert (outcome["slots_closed"], outcome["slot_cost"]) == (1, 55)


def test_observation():
    simulator = simulate()
    assert not simulator.world.seen.flat.any()
    play(simulator, [action(1, 1, True)])
    # 1.1: 10 of 100, l0: 1 of 10; service 0, node 1 of 0..3, VM 1 of 0..1, one of two functions, 210 of 1050 ms.
    vms, links = [0, 0, 0, 0.1, 0, 0, 0, 0], [0.1, 0, 0, 0, 0]
    assert simulator.world.seen.flat[0].tolist() == pytest.approx([*vms, *links, 0, 1 / 3, 1, 0.5, 0.2])


def test_one_hot_features():
    scenario = toy_scenario()
    simulator = Simulator(scenario, 1, one_hot=True)
    simulator.start(0, toy.toy_workload())

    def hot() -> list[list[int]]:
        """Positions set among two services, the four nodes twice, and 0 to 2 functions."""
        parts = np.split(simulator.world.seen.flat[0, 18:], np.cumsum([2, 4, 4]))
        return [np.flatnonzero(part).tolist() for part in parts]

    assert simulator.world.seen.flat.shape == (1, 18 + 2 + 4 + 4 + 3)
    assert hot() == [[DUO], [0], [3], [0]]
    play(simulator, [action(1, 0, True)])
    assert hot() == [[DUO], [1], [3], [1]]
    play(simulator, [action(2, 0, True)])
    assert hot() == [[DUO], [2], [3], [2]]
    play(simulator, [action(3), REJECT])
    assert hot() == [[SOLO], [3], [0], [0]]


def test_each_check_rejects_and_gives_back():
    patient = toy_catalogue(duo_delay=1e6)
    over_l1 = [action(2), action(0)] * 3
    assert play(simulate((0, DUO, 0, 3, 1.0), catalogue=patient), over_l1)["reason"] == Reason.LINK_CAPACITY
    short = simulate((0, DUO, 0, 3, 1.0), catalogue=patient, max_steps=2)
    assert play(short, over_l1[:3])["reason"] == Reason.STEP_LIMIT
    slow = simulate((0, SOLO, 3, 0, 1.0))
    assert play(slow, [action(1), action(0, 0, True)])["reason"] == Reason.DELAY
    for simulator in (short, slow):
        assert reserved(simulator) == ({}, {})
    # The last step allowed may be the one that arrives.
    both = [action(1, 1, True), action(3, 1, True)]
    assert play(simulate((0, DUO, 0, 3, 1.0), max_steps=2), both)["accepted"]


def test_checks_are_made_in_order():
    failures = [(0, toy.link_resource(2), False), (0, toy.vm_resource(1, 0), False)]
    for events, reason in [(failures, Reason.LINK_CAPACITY), (failures[1:], Reason.VM_CAPACITY), ([], Reason.DELAY)]:
        timeline = toy.timeline_of(*events) if events else None
        simulator = simulate(
            (0, DUO, 0, 3, 1.0), timeline=timeline, catalogue=toy_catalogue(duo_delay=230.0), max_steps=1
        )
        assert play(simulator, [action(2)])["passed"]
        assert play(simulator, [action(1, 0, True)])["reason"] == reason


@pytest.mark.parametrize(
    "index",
    [action(3), action(2, 1), action(0), action(0, 0, True), -1, REJECT, REJECT + 1, 2**40, -(2**40), 2**62, -(2**63)],
)
def test_actions_outside_the_mask(index):
    # Not a neighbour, no such VM, the node itself (twice), reject where another action is valid, out of range.
    simulator = simulate()
    outcome = play(simulator, [index])
    assert (outcome["reason"], outcome["request_done"], outcome["passed"]) == (Reason.INVALID_ACTION, 1, 0)
    assert simulator.world.env["cursor"][0] == 1
    assert_books_balance(simulator)


def test_reject():
    assert play(simulate(admission_control=True), [REJECT])["reason"] == Reason.REJECTED_BY_POLICY
    nothing_fits = toy_catalogue(duo_delay=294.0)
    for admission_control in (False, True):
        simulator = simulate(catalogue=nothing_fits, mask="feasible", admission_control=admission_control)
        assert offered(simulator) == {REJECT}
        assert play(simulator, [action(1)])["reason"] == Reason.INVALID_ACTION
        assert play(simulator, [REJECT])["reason"] == Reason.NO_FEASIBLE_ACTION


def test_failures_interrupt_and_heal():
    vm = toy.vm_resource(1, 0)
    simulator = simulate(timeline=toy.timeline_of((1, vm, False), (3, vm, True)), record=True)
    play(simulator, toy.DUO_0_TO_3[2])
    outcome = play(simulator, [action(1, 1, True), action(3), action(3, 1, True)])
    assert (outcome["slot_cost"], outcome["interrupted"]) == pytest.approx((191, 1))
    assert simulator.world.log.interrupted_at[0, :2].tolist() == [1, -1]
    assert reserved(simulator) == ({(1, 1): 10, (3, 1): 20}, {0: 1, 3: 1})
    assert simulator.world.seen.flat[0, 2] == 1.0
    play(simulator, toy.SOLO_3_TO_0[2])
    # Forwarding through node 1 needs no VM, placing on 1.0 does.
    assert play(simulator, [action(1)])["passed"]
    outcome = play(simulator, [action(0), action(1, 0, True)])
    assert (outcome["reason"], outcome["slot_cost"]) == pytest.approx((Reason.VM_CAPACITY, 136 + 50))
    assert simulator.world.seen.flat[0, 2] == 0.0
    assert play(simulator, toy.DUO_0_TO_3[2])["accepted"]


def test_one_slot():
    simulator = simulate((0, DUO, 0, 3, 9.0), horizon=1)
    outcome = play(simulator, toy.DUO_0_TO_3[2])
    assert (outcome["accepted"], outcome["slots_closed"], outcome["slot_cost"], outcome["done"]) == (1, 1, 55, 1)


def test_no_requests():
    empty = toy_scenario()
    simulator = Simulator(empty, 1)
    nothing = type(toy.toy_workload())(*(np.zeros(0, np.int64) for _ in range(4)), np.zeros(0))
    simulator.start(0, nothing)
    assert simulator.world.env["done"][0] == 1
    assert offered(simulator) == {REJECT}
    simulator.step(np.array([REJECT]))
    assert (outcome_of(simulator)["done"], outcome_of(simulator)["request_done"]) == (1, 0)


def test_a_later_start_is_on_a_loaded_network():
    requests = [(slot, DUO, 0, 3, 3.0) for slot in range(6)]
    simulator = Simulator(toy_scenario(), 1, record=True)
    simulator.start(0, workload_of(*requests))
    loader = Loader(simulator)
    loader.forward(0, 4, np.random.default_rng(0))
    e = simulator.world.env[0]
    assert (e["slot"], e["cursor"]) == (4, 4)
    assert e["num_running"] > 0
    assert_books_balance(simulator)
    assert simulator.world.log.start[0, 4] == e["log_length"]
    # Past the end: the horizon is over.
    loader.forward(0, 99, np.random.default_rng(0))
    assert simulator.world.env["done"][0] == 1
