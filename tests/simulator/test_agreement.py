"""The compiled simulator against the plain-Python one, step by step."""

import random

import numpy as np
import pytest
from driving import begin, counters_of, mask_of, outcome_of
from hypothesis import given
from hypothesis import strategies as st
from reference import ReferenceSimulator
from strategies import general_instances, instances, random_action

from nfv_torchrl.simulator import REASON_NAMES, Simulator


def assert_same_state(simulator: Simulator, reference: ReferenceSimulator) -> None:
    assert mask_of(simulator) == reference.mask()
    ledger = simulator.world.ledger
    for place in reference.vm_capacity:
        assert ledger.vm_reserved[0][place] == reference.vm_reserved[place]
        assert ledger.vm_offered[0][place] == reference.vm_available(*place)
    for link, name in enumerate(reference.link_capacity):
        assert ledger.link_reserved[0, link] == reference.link_reserved[name]
        assert ledger.link_offered[0, link] == reference.link_available(name)
    e = simulator.world.env[0]
    assert (bool(e["done"]), e["slot"], e["num_running"]) == (reference.done, reference.slot, len(reference.running))
    assert e["running_cost"] == pytest.approx(reference.running_cost, abs=1e-6)
    observation = reference.observation()
    if reference.done:
        observation = observation[:-5]  # no request to describe
    else:
        walk = ("cursor", "node", "function", "steps", "last_vm", "hops")
        expected = ("cursor", "current_node", "function_index", "step_count", "last_vm", "hops")
        theirs = [getattr(reference, name) for name in expected]
        assert [e[name] for name in walk] == [-1 if value is None else value for value in theirs]
    seen = simulator.world.seen.flat[0, : len(observation)]
    np.testing.assert_allclose(seen, np.array(observation, np.float32), rtol=1e-6)


def assert_same_outcome(simulator: Simulator, result: dict) -> None:
    outcome = outcome_of(simulator)
    for name in ("passed", "request_done", "accepted", "done"):
        assert bool(outcome[name]) == result[name], name
    assert (None if outcome["reason"] < 0 else REASON_NAMES[int(outcome["reason"])]) == result["reason"]
    named = {"step_cost": "step_cost", "request_cost": "request_cost", "request_delay": "delay", "request_hops": "hops"}
    named |= {"lost_steps": "lost_steps", "lost_cost": "lost_cost"}
    for name, theirs in named.items():
        assert outcome[name] == pytest.approx(result[theirs], rel=1e-9, abs=1e-9), name
    assert outcome["slots_closed"] == len(result["slots_closed"])
    assert outcome["slot_cost"] == pytest.approx(sum(result["slots_closed"]), abs=1e-6)


def run_both(instance, seed: int) -> None:
    rng = random.Random(seed)
    reference, simulator = ReferenceSimulator(*instance), begin([instance])
    lost = 0
    assert_same_state(simulator, reference)
    while not reference.done:
        action = random_action(reference.mask(), rng)
        result = reference.step(action)
        simulator.step(np.array([action]))
        lost += outcome_of(simulator)["interrupted"]
        assert_same_outcome(simulator, result)
        assert_same_state(simulator, reference)
    assert lost == len(reference.interrupted)
    # Past the horizon nothing changes.
    before = counters_of(simulator)
    simulator.step(np.array([0]))
    assert outcome_of(simulator)["done"] == 1
    assert counters_of(simulator) == before


# Each rule gets examples of its own: with all left to chance, a combination would come up rarely.
@pytest.mark.parametrize("colocation", [False, True])
@pytest.mark.parametrize("mask", ["adjacency", "feasible"])
def test_agrees_with_the_reference(mask, colocation):
    @given(instances(mask=mask, colocation=colocation), st.integers(0, 2**32))
    def check(instance, seed):
        run_both(instance, seed)

    check()


@given(general_instances(), st.integers(0, 2**32))
def test_agrees_on_the_general_model(instance, seed):
    """Several kinds of resources, rates of segments, free ends, distinct nodes, full duplex, forwarding nodes."""
    run_both(instance, seed)
