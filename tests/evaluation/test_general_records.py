"""Runs on the general model: the audit agrees with the simulator, the bounds hold, the files bring it all back."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import Instance, general_instances

from nfv_torchrl.bounds import hindsight_bound, hindsight_least_cost
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.network_figure import mean_use
from nfv_torchrl.evaluation.records import RunRecord, write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.snapshot import restore_snapshot, take_snapshot

SEED = 3


class RandomSteps:
    """Any valid action, placing more often than not, and now and then what is none."""

    name, mask, decides_admission, one_hot = "random steps", None, False, True

    def prepare(self, simulator: Simulator, seeds: list[int]) -> None:
        self.rng = np.random.default_rng(0)

    def act(self, simulator: Simulator) -> np.ndarray:
        world = simulator.world
        return np.array([self.choose(world.seen.valid[b, : world.env["mask_count"][b]]) for b in range(len(world.env))])

    def choose(self, valid: np.ndarray) -> int:
        placing = valid[valid % 2 == 1]
        if self.rng.random() < 0.03:
            return int(self.rng.integers(-1, 5))
        return int(self.rng.choice(placing if len(placing) and self.rng.random() < 0.7 else valid))


def check_files(record: RunRecord) -> None:
    """The run passes the audit, and its folder brings the scenario back."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        write_run(path, record, compute_metrics(record))
        assert audit_run(path).problems == []
        back, here = read_run_folder(path), record.scenario
        assert back.scenario.placement_rule == here.placement_rule
        assert back.scenario.catalogue.types == here.catalogue.types
        np.testing.assert_array_equal(back.scenario.substrate.capacity_by_kind, here.substrate.capacity_by_kind)
        np.testing.assert_array_equal(back.workload.ingress, record.workload.ingress)


@settings(max_examples=15)
@given(general_instances())
def test_audit_and_bounds(instance: Instance):
    scenario, workload, _ = instance
    timeline = scenario.failure_timeline(SEED)
    bound = hindsight_bound(scenario, workload, timeline).accepted
    for method in (RandomSteps(), PlannerMethod(MyopicPlanner(), name="myopic_optimal")):
        (record,) = run_method(scenario, method, [SEED], workloads=[workload])
        check_files(record)
        assert all(((share >= 0) & (share <= 1 + 1e-9)).all() for share in mean_use(record))
        accepted = int(record.accepted.sum())
        assert accepted <= bound + 1e-9
        if accepted:
            least = hindsight_least_cost(scenario, workload, accepted, timeline)
            assert least <= record.cost[record.accepted].sum() + 1e-6


@settings(max_examples=10)
@given(general_instances(), st.integers(1, 12), st.booleans())
def test_snapshots(instance: Instance, steps: int, one_hot: bool):
    simulator, method = Simulator(instance.scenario, 1, one_hot=one_hot), RandomSteps()
    simulator.start(0, instance.workload, instance.timeline)
    method.prepare(simulator, [0])
    for _ in range(steps):
        simulator.step(method.act(simulator))
    copies = take_snapshot(simulator.world)
    again = take_snapshot(restore_snapshot(simulator.world, copies))
    assert all(np.array_equal(copies[name], again[name]) for name in copies)
