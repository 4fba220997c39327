"""The books: whatever is done to the network, they balance to the last unit."""

import random

import numpy as np
import toy
from driving import (
    assert_books_balance,
    assert_network_is_idle,
    begin,
    counters_of,
    mask_of,
    outcome_of,
    play,
    random_actions,
)
from hypothesis import given
from hypothesis import strategies as st
from reference import ReferenceSimulator
from strategies import Instance, instances

from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.reasons import Reason


@given(instances(), st.integers(0, 2**32), st.sampled_from([0.03, 0.5]))
def test_books_balance_after_every_step(instance, seed, invalid):
    simulator, rng = begin([instance]), random.Random(seed)
    assert_books_balance(simulator)
    while not simulator.world.env["done"][0]:
        simulator.step(random_actions(simulator, [rng], invalid))
        assert_books_balance(simulator)


@given(instances(min_requests=6, max_requests=30), st.integers(0, 2**32))
def test_an_emptied_network_is_idle_to_the_bit(instance, seed):
    scenario, workload, timeline = instance
    # Long enough for the last one to leave.
    scenario = scenario.replace(horizon=int(workload.departure.max()) + 1)
    simulator, rng = begin([Instance(scenario, workload, timeline)]), random.Random(seed)
    while not simulator.world.env["done"][0]:
        simulator.step(random_actions(simulator, [rng]))
    assert_network_is_idle(simulator)
    assert_books_balance(simulator)
    shares = simulator.world.seen.flat[0, : simulator.world.ledger.vm_offered[0].size]
    np.testing.assert_array_equal(shares, simulator.world.ledger.vm_failed[0].ravel().astype(np.float32))


@given(instances(), st.integers(0, 2**32))
def test_a_second_horizon_begins_afresh(instance, seed):
    used, rng = begin([instance]), random.Random(seed)
    for _ in range(10):
        used.step(random_actions(used, [rng]))
    used.start(0, instance.workload, instance.timeline)
    fresh = begin([instance])
    while not fresh.world.env["done"][0]:
        assert mask_of(used) == mask_of(fresh)
        assert counters_of(used) == counters_of(fresh)
        np.testing.assert_array_equal(used.world.seen.flat, fresh.world.seen.flat)
        actions = random_actions(fresh, [rng])
        used.step(actions)
        fresh.step(actions)
        assert outcome_of(used) == outcome_of(fresh)


def roomy_scenario(**changes):
    """The toy network with ten thousand times the capacity: delays are propagation and little else."""
    substrate = toy.toy_substrate()
    vm_capacity, link_capacity = substrate.vm_capacity * 1e4, substrate.link_capacity * 1e4
    roomy = type(substrate)(
        **{name: getattr(substrate, name) for name in ("name", "labels", "vm_count", "vm_unit_cost", "links")},
        vm_capacity=vm_capacity,
        link_capacity=link_capacity,
        link_delay=substrate.link_delay,
        link_unit_cost=substrate.link_unit_cost,
    )
    return toy.toy_scenario(substrate=roomy, **changes)


def test_pools_grow_without_losing_a_request():
    many = toy.workload_of(*[(0, toy.DUO, 0, 3, 1.0 + i % 3) for i in range(1500)], (5, toy.SOLO, 3, 0, 1.0))
    few = toy.workload_of((0, toy.SOLO, 3, 0, 3.0), (4, toy.DUO, 0, 3, 1.0))
    scenario = roomy_scenario()
    simulator = Simulator(scenario, 2)
    simulator.start(0, many)
    simulator.start(1, few)
    records = simulator.world.running.record_next.shape[1]
    reference = ReferenceSimulator(scenario, many)
    walk, answered = toy.DUO_0_TO_3[2], 0
    while simulator.world.env["cursor"][0] < 1500:
        action = walk[simulator.world.env["steps"][0]]
        reference.step(action)
        # The other one waits in the middle of its walk, then answers its last request.
        first = (*toy.SOLO_3_TO_0[2], *walk)
        other = first[answered] if answered < len(first) else 0
        answered += 1
        simulator.step(np.array([action, other]))
    assert simulator.world.running.record_next.shape[1] > records
    assert simulator.world.env["slot"].tolist() == [5, 6]
    assert_books_balance(simulator)
    assert_network_is_idle(simulator, 0)
    assert_network_is_idle(simulator, 1)
    assert reference.slot == 5
    assert simulator.world.env["running_cost"][0] == reference.running_cost == 0.0


def test_running_requests_count_while_pools_grow():
    scenario = roomy_scenario()
    workload = toy.workload_of(*[(0, toy.DUO, 0, 3, 50.0)] * 1000, (1, toy.SOLO, 3, 0, 1.0))
    simulator = begin([Instance(scenario, workload, None)])
    outcome = play(simulator, toy.DUO_0_TO_3[2] * 1000)
    assert simulator.world.env["num_running"][0] == 1000
    # Each holds 10 at 1.0 and 20 at 2.0, and one Mbit/s of three links.
    assert simulator.world.ledger.vm_reserved[0, [1, 2], 0, 0].tolist() == [10_000_000_000, 20_000_000_000]
    assert simulator.world.env["link_used"][0] == 3_000_000_000
    assert outcome["slot_cost"] == 55_000


def test_long_walks_fit_the_log():
    # 401 hops between 0 and 1 before the chain begins: more than the log first has room for.
    scenario = roomy_scenario(max_steps=700, catalogue=toy.toy_catalogue(duo_delay=1e9))
    workload = toy.workload_of(*[(0, toy.DUO, 0, 3, 1.0)] * 3)
    simulator = begin([Instance(scenario, workload, None)], record=True)
    walk = [toy.action(1), toy.action(0)] * 200 + toy.DUO_0_TO_3[2]
    play(simulator, walk * 3)
    log = simulator.world.log
    assert log.start[0, :4].tolist() == [0, len(walk), 2 * len(walk), 3 * len(walk)]
    assert log.action[0, : 3 * len(walk)].tolist() == walk * 3
    assert log.reason[0, :3].tolist() == [-1, -1, -1]


def test_the_log_of_a_horizon_forgets_the_one_before():
    scenario, workload = toy.toy_scenario(), toy.toy_workload()
    failure = toy.timeline_of((1, toy.vm_resource(1, 0), False))
    simulator = begin([Instance(scenario, workload, failure)], record=True)
    play(simulator, [*toy.DUO_0_TO_3[2], toy.REJECT])
    log = simulator.world.log
    assert log.interrupted_at[0, :2].tolist() == [1, -1]
    assert log.reason[0, :2].tolist() == [-1, Reason.INVALID_ACTION]
    assert (log.cost[0, 0], log.delay[0, 0], log.hops[0, 0]) == (55, 945, 3)
    simulator.start(0, workload)
    play(simulator, [toy.REJECT] * 2)
    assert log.interrupted_at[0, :2].tolist() == [-1, -1]
    assert np.isnan(log.cost[0, 0])
    # A refused request leaves what it tried, here ``reject`` alone.
    assert log.start[0, :3].tolist() == [0, 1, 2]
    assert log.action[0, :2].tolist() == [toy.REJECT] * 2
