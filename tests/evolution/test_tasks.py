"""What generations are measured on."""

from __future__ import annotations

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evolution import FixedNetwork, RandomNetworks
from nfv_torchrl.evolution.tasks import FIRST_SCENARIO_SEED

BASE = {"horizon": 100, "mean_lifetime": 80.0}


def test_random_networks_are_as_asked_and_always_the_same():
    source = RandomNetworks(BASE, nodes=[5, 9], rho=[0.5, 2.0], arrival_rate=[3.0], horizon=[50], vms_max=[2, 3])
    tasks = [task for generation in range(4) for task in source.draw(0, generation, 2)]
    for task in tasks:
        scenario = task.scenario
        assert 5 <= scenario.substrate.num_nodes <= 9 and 0.5 <= scenario.offered_load() <= 2.0
        assert scenario.seed >= FIRST_SCENARIO_SEED and scenario.horizon == 50 and scenario.arrival_rate == 3.0
        assert scenario.substrate.vm_count.max() <= 3
    assert len({task.scenario.substrate.num_nodes for task in tasks}) > 2
    assert [task.scenario.colocation for task in tasks] == [False, True] * 4
    again = source.draw(0, 3, 2)
    assert again[1].scenario.seed == tasks[7].scenario.seed
    assert np.array_equal(again[1].workload.lifetime, tasks[7].workload.lifetime)
    assert source.draw(1, 3, 2)[1].scenario.seed != tasks[7].scenario.seed


def test_rules_take_turns():
    source = RandomNetworks(BASE, nodes=[5, 5], arrival_rate=[3.0], horizon=[50], observe_lifetime=[False, True])
    turns = [(task.scenario.colocation, task.scenario.observe_lifetime) for task in source.draw(0, 1, 4)]
    assert turns == [(False, False), (True, False), (False, True), (True, True)]
    assert not RandomNetworks(BASE).observe_lifetime[0]


def test_a_fixed_network_meets_other_requests_in_every_generation():
    source = FixedNetwork(BASE)
    first, second = source.draw(0, 0, 2)
    assert first.scenario is second.scenario
    later = source.draw(0, 1, 1)[0]
    workloads = [first.workload, second.workload, later.workload, first.scenario.workload(0)]
    firsts = {tuple(workload.lifetime[:3]) for workload in workloads}
    assert len(firsts) == 4  # and none is that of an evaluation


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"nodes": [9, 5]}, "tasks.nodes"), ({"rho": [0.0, 1.0]}, "tasks.rho"), ({"colocation": []}, "tasks.colocation")],
)
def test_bad_ranges_are_named(changes, message):
    with pytest.raises(ScenarioError, match=message):
        RandomNetworks(BASE, **changes)
