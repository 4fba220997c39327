"""Steps for the tests of the compiled simulator: start it on instances, drive it, look at one environment."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np
from strategies import Instance, random_action

from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import OUTCOME

# Counters that must not depend on who else is in the batch; places in the pools may.
COUNTERS = (
    "slot",
    "cursor",
    "service",
    "ingress",
    "egress",
    "node",
    "last_vm",
    "function",
    "steps",
    "hops",
    "elapsed",
    "cost",
    "running_cost",
    "num_running",
    "link_used",
    "event_cursor",
    "done",
)


def begin(instances: Sequence[Instance], **options) -> Simulator:
    """Environment b begins instance b."""
    simulator = Simulator([instance.scenario for instance in instances], len(instances), **options)
    for b, (_, workload, timeline) in enumerate(instances):
        simulator.start(b, workload, timeline)
    return simulator


def mask_of(simulator: Simulator, b: int = 0) -> list[bool]:
    return simulator.world.seen.mask[b].tolist()


def outcome_of(simulator: Simulator, b: int = 0) -> dict[str, float]:
    return dict(zip(OUTCOME._fields, simulator.world.outcome[b].tolist(), strict=True))


def counters_of(simulator: Simulator, b: int = 0) -> list[float]:
    return [simulator.world.env[name][b].item() for name in COUNTERS]


def play(simulator: Simulator, actions: Sequence[int]) -> dict[str, float]:
    """Take ``actions`` in an environment that is alone; what the last one brought."""
    for action in actions:
        simulator.step(np.array([action]))
    return outcome_of(simulator)


def random_actions(simulator: Simulator, rngs: Sequence[random.Random], invalid: float = 0.03) -> np.ndarray:
    return np.array([random_action(mask_of(simulator, b), rng, invalid) for b, rng in enumerate(rngs)])


def assert_books_balance(simulator: Simulator) -> None:
    """Reserved and offered make up the capacity of every resource, exactly; one that failed offers nothing."""
    ledger, tables, env = simulator.world.ledger, simulator.tables, simulator.world.env
    for reserved, offered, failed, capacity in (
        (ledger.vm_reserved, ledger.vm_offered, ledger.vm_failed, tables.vm_capacity[env["net"]]),
        (ledger.link_reserved, ledger.link_offered, ledger.link_failed, tables.link_capacity[env["net"]]),
    ):
        assert (reserved >= 0).all()
        assert (reserved <= capacity).all()
        failed = failed.reshape(*failed.shape, *[1] * (offered.ndim - failed.ndim))
        np.testing.assert_array_equal(offered, np.where(failed, 0, capacity - reserved))
    np.testing.assert_array_equal(ledger.vm_used, ledger.vm_reserved.sum(axis=(1, 2)))
    np.testing.assert_array_equal(env["link_used"], ledger.link_reserved.sum(axis=1))


def assert_network_is_idle(simulator: Simulator, b: int = 0) -> None:
    """Nothing is reserved, nothing runs, and every place of the pools is free again."""
    world = simulator.world
    e = world.env[b]
    assert not world.ledger.vm_reserved[b].any()
    assert not world.ledger.link_reserved[b].any()
    assert (e["running_cost"], e["num_running"], e["link_used"]) == (0.0, 0, 0)
    assert not world.ledger.vm_used[b].any()
    for following, first, free in (
        (world.running.record_next[b], e["free_record"], e["free_records"]),
        (world.running.entry_next[b], e["free_entry"], e["free_entries"]),
    ):
        places = []
        place = int(first)
        while place != -1:
            places.append(place)
            place = int(following[place])
        assert len(places) == free
        assert sorted(places) == list(range(len(following)))
