"""Environments of a batch do not know of each other: alone, together, padded, in threads, stopped and resumed."""

import random
from dataclasses import replace

import numpy as np
import pytest
import toy
from driving import assert_books_balance, begin, counters_of, mask_of, outcome_of, random_actions
from hypothesis import given
from hypothesis import strategies as st
from strategies import Instance, catalogues, random_action, scenarios, workloads

from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.snapshot import restore_snapshot, take_snapshot


@st.composite
def batches(draw, same_substrate: bool = False) -> list[Instance]:
    """Two to four instances that may share a batch: same services, horizon and rules."""
    first = draw(scenarios(catalogue=draw(catalogues())))
    shared = ("catalogue", "horizon", "colocation", "mask", "admission_control", "max_steps")
    shared += ("step_budget", "placing_after_chain")
    fixed = {name: getattr(first, name) for name in shared}
    together = [first]
    for _ in range(draw(st.integers(1, 3))):
        together.append(first if same_substrate else draw(scenarios(**fixed)))
    return [
        Instance(scenario, draw(workloads(scenario)), scenario.failure_timeline(draw(st.integers(0, 1000))))
        for scenario in together
    ]


def translated(action: int, own: Simulator, padded: Simulator) -> int:
    """``action`` of a network alone as an action among the padded sizes."""
    if action == own.num_actions - 1:
        return padded.num_actions - 1
    place, put = divmod(action, 2)
    node, vm = divmod(place, own.tables.vm_capacity.shape[2])
    return 2 * (node * padded.tables.vm_capacity.shape[2] + vm) + put


def assert_same(own: Simulator, padded: Simulator, b: int) -> None:
    """Environment ``b`` of a padded batch is where it is when alone."""
    valid = {translated(action, own, padded) for action in np.flatnonzero(own.world.seen.mask[0]).tolist()}
    assert set(np.flatnonzero(padded.world.seen.mask[b]).tolist()) == valid
    assert counters_of(padded, b) == counters_of(own)
    assert outcome_of(padded, b) == outcome_of(own)
    nodes, vms = own.world.ledger.vm_offered.shape[1:3]
    links = own.world.ledger.link_offered.shape[1]
    for name, ours in own.world.ledger._asdict().items():
        theirs = getattr(padded.world.ledger, name)[b]
        theirs_own = theirs[:nodes, :vms] if ours.ndim >= 3 else theirs if name == "vm_used" else theirs[:links]
        np.testing.assert_array_equal(theirs_own, ours[0])
    # Shares of VMs and links, then the service's; nodes and VMs are scaled by the batch's sizes.
    all_nodes, all_vms = padded.world.ledger.vm_offered.shape[1:3]
    all_links = padded.world.ledger.link_offered.shape[1]
    flat = padded.world.seen.flat[b]
    shares = flat[: all_nodes * all_vms].reshape(all_nodes, all_vms)
    assert np.count_nonzero(shares) == np.count_nonzero(shares[:nodes, :vms])
    np.testing.assert_array_equal(shares[:nodes, :vms].ravel(), own.world.seen.flat[0, : nodes * vms])
    padded_links = flat[all_nodes * all_vms :][:links]
    np.testing.assert_array_equal(padded_links, own.world.seen.flat[0, nodes * vms :][:links])
    for place in (0, 3, 4):
        assert flat[all_nodes * all_vms + all_links + place] == own.world.seen.flat[0, nodes * vms + links + place]


@given(batches(), st.integers(0, 2**32))
def test_networks_of_different_sizes_in_one_batch(batch, seed):
    padded, alone = begin(batch), [begin([instance]) for instance in batch]
    rngs = [random.Random(seed + b) for b in range(len(batch))]
    while not padded.world.env["done"].all():
        for b, own in enumerate(alone):
            assert_same(own, padded, b)
        actions = [random_action(mask_of(own), rng) for own, rng in zip(alone, rngs, strict=True)]
        for own, action in zip(alone, actions, strict=True):
            own.step(np.array([action]))
        padded.step(np.array([translated(a, own, padded) for a, own in zip(actions, alone, strict=True)]))
        assert_books_balance(padded)


@given(batches(same_substrate=True), st.integers(0, 2**32))
def test_an_environment_alone_and_in_a_batch(batch, seed):
    together = begin(batch)
    alone = [begin([instance]) for instance in batch]
    rngs = [random.Random(seed + b) for b in range(len(batch))]
    while not together.world.env["done"].all():
        actions = random_actions(together, rngs)
        together.step(actions)
        for b, own in enumerate(alone):
            own.step(actions[b : b + 1])
            assert outcome_of(own) == outcome_of(together, b)
            assert counters_of(own) == counters_of(together, b)
            assert mask_of(own) == mask_of(together, b)
            np.testing.assert_array_equal(own.world.seen.flat[0], together.world.seen.flat[b])


def started(batch_size: int, seed: int = 0, **options) -> Simulator:
    """Paper networks that fail now and then, each with requests of its own."""
    scenario = paper_scenario(horizon=30, failures={"p_fail_vm": 0.02, "p_fail_link": 0.02, "p_repair": 0.2})
    simulator = Simulator(scenario, batch_size, one_hot=True, **options)
    for b in range(batch_size):
        simulator.start(b, scenario.workload(seed, b), scenario.failure_timeline(seed, b))
    return simulator


def run(simulator: Simulator, steps: int, seed: int) -> list[np.ndarray]:
    rngs = [random.Random(seed + b) for b in range(simulator.batch_size)]
    outcomes = []
    for _ in range(steps):
        simulator.step(random_actions(simulator, rngs))
        outcomes.append(simulator.world.outcome.copy())
    return outcomes


def assert_same_world(one: Simulator, other: Simulator) -> None:
    theirs = take_snapshot(other.world)
    for name, array in take_snapshot(one.world).items():
        np.testing.assert_array_equal(array, theirs[name], err_msg=name)


def test_threads_change_nothing():
    one, two, many = started(5), started(5, threads=2), started(5, threads=9)
    assert (one.threads, two.threads, many.threads) == (1, 2, 5)
    expected = run(one, 300, seed=1)
    for simulator in (two, many):
        np.testing.assert_array_equal(run(simulator, 300, seed=1), expected)
        assert_same_world(simulator, one)


@pytest.mark.parametrize("steps", [0, 1, 137, 400])
def test_a_restored_snapshot_goes_on_to_the_bit(steps):
    simulator = started(3)
    run(simulator, steps, seed=2)
    snapshot = take_snapshot(simulator.world)
    expected = run(simulator, 200, seed=3)
    # Once on a simulator that is elsewhere, once on a new one; either has the arrivals.
    elsewhere = started(3)
    run(elsewhere, 50, seed=4)
    for other in (elsewhere, started(3)):
        other.world = restore_snapshot(other.world, snapshot)
        np.testing.assert_array_equal(run(other, 200, seed=3), expected)
        assert_same_world(other, simulator)


def test_a_snapshot_that_does_not_fit_is_refused():
    snapshot = take_snapshot(started(2).world)
    scenario = paper_scenario(horizon=30)
    for other, message in [
        (Simulator(scenario, 3, one_hot=True), "2 environments"),
        (Simulator(paper_scenario(nodes=12, horizon=30), 2, one_hot=True), "vm_reserved"),
        (Simulator(paper_scenario(horizon=31), 2, one_hot=True), "running.head"),
        (Simulator(scenario.replace(max_steps=20), 2, one_hot=True), "walk.action"),
        (Simulator(scenario, 2), "seen.flat"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            restore_snapshot(other.world, snapshot)
    del snapshot["walk.action"]
    with pytest.raises(CheckpointError, match=r"walk\.action is missing"):
        restore_snapshot(started(2).world, snapshot)


def test_what_does_not_fit_together_is_refused():
    scenario = toy.toy_scenario()
    with pytest.raises(ScenarioError, match="at least one scenario"):
        Simulator([], 1)
    with pytest.raises(ScenarioError, match="batch_size is 0"):
        Simulator(scenario, 0)
    for change, name in [
        ({"horizon": 7}, "horizon"),
        ({"warmup": 1}, "warmup"),
        ({"catalogue": toy.toy_catalogue(duo_delay=1.0)}, "catalogue"),
        ({"colocation": True}, "rules"),
        ({"max_steps": 5}, "rules"),
    ]:
        with pytest.raises(ScenarioError, match=name):
            Simulator([scenario, scenario.replace(**change)], 2)
    # Another network is no obstacle.
    Simulator([scenario, scenario.replace(substrate=replace(toy.toy_substrate(), name="other"))], 2)


def test_actions_of_another_shape_are_refused():
    simulator = started(2)
    for actions in (np.zeros(3, np.int64), np.zeros((2, 1), np.int64), np.zeros((), np.int64)):
        with pytest.raises(ValueError, match="shape"):
            simulator.step(actions)


def test_an_environment_of_a_large_network_takes_at_most_8_mb():
    """25 requests/s of 1200 s for 2000 s, if all were accepted: what a part of them takes, and pools half empty."""
    simulator = Simulator(paper_scenario(100, arrival_rate=25.0, mean_lifetime=1200.0, horizon=2000), 1)
    scenario = simulator.scenario(0)
    simulator.start(0, scenario.workload(0), None)
    Loader(simulator).forward(0, 100, np.random.default_rng(0))
    running, e = simulator.world.running, simulator.world.env[0]
    walk = 2 * scenario.max_steps
    bytes_each, others = 0.0, simulator.memory_bytes()
    for kind, free in (("record", e["free_records"]), ("entry", e["free_entries"])):
        arrays = [array for name, array in running._asdict().items() if name.startswith(kind)]
        used = arrays[0].shape[1] - free
        assert used > 2048, "the pools have grown several times"
        assert arrays[0].shape[1] <= 1.5 * (used + walk), kind
        bytes_each += sum(array.nbytes for array in arrays) / arrays[0].shape[1] * used / e["num_running"]
        others -= sum(array.nbytes for array in arrays)
    most = 25.0 * 1200.0 * -np.expm1(-2000.0 / 1200.0)
    assert others + 1.5 * most * bytes_each <= 8e6
