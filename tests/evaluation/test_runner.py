"""Methods run on workloads: what they decide is theirs alone, and what is recorded stands up to the audit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import toy
from stepwise import StepByStep
from tensordict.nn import TensorDictModule

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import MOST_TOGETHER, run_method, scenario_for
from nfv_torchrl.methods import PlannerMethod, PolicyMethod, RandomMethod, WholeWalks
from nfv_torchrl.methods.base import WholePlay
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator.reasons import Reason

DECISIONS = ("accepted", "reason", "delay_ms", "cost", "hops", "interrupted_at", "step_offsets", "step_node", "step_vm",
             "step_function")  # fmt: skip


def small_scenario(seed=0, nodes=6, **changes):
    """Loaded well beyond its capacity within 40 slots, with failures."""
    settings = {
        "horizon": 40,
        "arrival_rate": 30,
        "mean_lifetime": 30,
        "substrate": {"vms_max": 2, "vm_capacity": (100.0, 300.0)},
        "failures": {"p_fail_vm": 0.01, "p_fail_link": 0.01, "p_repair": 0.2},
    }
    return paper_scenario(nodes, seed, **(settings | changes))


def methods():
    return [
        RandomMethod(),
        RandomMethod(name="random_feasible", mask="feasible"),
        PlannerMethod(GreedyPlanner(), name="greedy"),
        PlannerMethod(MyopicPlanner(), name="myopic_optimal"),
    ]


def assert_same_decisions(first, second):
    for name in DECISIONS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


@pytest.mark.parametrize("method", methods(), ids=lambda method: method.name)
def test_decisions_depend_on_the_seed_alone(method):
    scenario = small_scenario()
    together = run_method(scenario, method, [3, 1, 2])
    assert [record.workload_seed for record in together] == [3, 1, 2]
    for record in together:
        (alone,) = run_method(scenario, method, [record.workload_seed])
        assert_same_decisions(alone, record)
    assert not np.array_equal(together[0].cost[:40], together[1].cost[:40])


class Careless(GreedyPlanner):
    """Some of its plans end too soon, and some begin with no action at all."""

    def plan_rows(self, world, rows, plans, lengths):
        super().plan_rows(world, rows, plans, lengths)
        for b in rows:
            kind = world.env["cursor"][b] % 5
            lengths[b] = max(lengths[b] - (kind == 1), 0)
            if kind == 2:
                plans[b, 0] = -1


WHOLE = [
    PlannerMethod(MyopicPlanner(), name="myopic_optimal"),
    PlannerMethod(Careless(), name="careless"),
    RandomMethod(),
]


@pytest.mark.parametrize("method", WHOLE, ids=lambda method: method.name)
@pytest.mark.parametrize("changes", [{}, {"step_budget": "slot", "max_steps": 8}, {"mask": "feasible"}])
@pytest.mark.parametrize("threads", [1, 2])
def test_whole_walks_and_horizons_are_those_of_single_steps(method, changes, threads):
    assert isinstance(method, WholeWalks | WholePlay)
    runs = (run_method(small_scenario(**changes), each, [0, 1, 2], threads=threads)
            for each in (method, StepByStep(method)))  # fmt: skip
    for whole, single in zip(*runs, strict=True):
        assert_same_decisions(whole, single)
        assert 0 < whole.accepted.mean() < 1


@pytest.mark.parametrize("colocation", [False, True])
@pytest.mark.parametrize("method", methods(), ids=lambda method: method.name)
def test_every_record_stands_up_to_the_audit(method, colocation, tmp_path):
    scenario = small_scenario(colocation=colocation, warmup=5)
    for record in run_method(scenario, method, [0, 1]):
        assert 0 < record.accepted.mean() < 1
        assert (record.interrupted_at >= 0).any()
        folder = write_run(tmp_path / str(record.workload_seed), record, compute_metrics(record))
        assert audit_run(folder).problems == []


class Blind:
    """Any index at all, now and then none that exists."""

    decides_admission, one_hot = False, False

    def __init__(self, mask):
        self.name, self.mask = "blind", mask

    def prepare(self, simulator, seeds):
        self._rng = np.random.default_rng(seeds[0])

    def act(self, simulator):
        valid = [self._rng.choice(np.flatnonzero(row)) for row in simulator.world.seen.mask]
        any_index = self._rng.integers(-2, simulator.num_actions + 2, simulator.batch_size)
        return np.where(self._rng.random(simulator.batch_size) < 0.02, any_index, valid)


@pytest.mark.parametrize("mask", ["adjacency", "feasible"])
@pytest.mark.parametrize("admission_control", [False, True])
def test_the_reason_of_every_rejection_is_audited(mask, admission_control, tmp_path):
    changes = {"admission_control": admission_control, "max_steps": 8, "substrate": {"vm_capacity": (20.0, 60.0)}}
    networks = [small_scenario(seed, nodes, **changes) for seed, nodes in ((0, 4), (1, 7))]
    reasons = set()
    for record in run_method(networks, Blind(mask), [0, 1]):
        folder = write_run(tmp_path / str(record.workload_seed), record, compute_metrics(record))
        assert audit_run(folder).problems == []
        reasons |= set(record.reason[~record.accepted].tolist())
    checks = {Reason.VM_CAPACITY, Reason.DELAY, Reason.STEP_LIMIT}
    expected = {Reason.INVALID_ACTION} | (checks if mask == "adjacency" else {Reason.NO_FEASIBLE_ACTION})
    assert reasons >= expected | ({Reason.REJECTED_BY_POLICY} if admission_control else set())


def test_each_seed_may_have_a_network_of_its_own(tmp_path):
    networks = [small_scenario(seed, nodes) for seed, nodes in ((0, 4), (1, 7), (2, 5))]
    method = PlannerMethod(MyopicPlanner(), name="myopic_optimal")
    records = run_method(networks, method, [5, 6, 7])
    for network, record in zip(networks, records, strict=True):
        assert record.scenario.substrate is network.substrate
        # Sizes are padded to the largest network of the batch; decisions do not show it.
        assert_same_decisions(run_method(network, method, [record.workload_seed])[0], record)
        assert audit_run(write_run(tmp_path / str(record.workload_seed), record, compute_metrics(record))).clean


def test_more_seeds_than_run_together():
    scenario = small_scenario(horizon=2)
    records = run_method(scenario, RandomMethod(), range(MOST_TOGETHER + 2))
    assert len(records) == MOST_TOGETHER + 2
    assert_same_decisions(records[-1], run_method(scenario, RandomMethod(), [MOST_TOGETHER + 1])[0])


def test_threads_and_progress_change_nothing():
    scenario, seen = small_scenario(), []
    records = run_method(scenario, RandomMethod(), [0, 1, 2], progress=seen.append, threads=2)
    assert sum(seen) == sum(record.num_requests for record in records)
    for record, other in zip(records, run_method(scenario, RandomMethod(), [0, 1, 2]), strict=True):
        assert_same_decisions(record, other)


def test_a_method_brings_its_own_mask_and_refusal():
    scenario = small_scenario()
    feasible, planner = RandomMethod(mask="feasible"), PlannerMethod(GreedyPlanner(), name="greedy")
    assert scenario_for(scenario, RandomMethod()) is scenario
    assert scenario_for(scenario, feasible).mask == "feasible"
    assert scenario_for(scenario, planner).admission_control
    (record,) = run_method(scenario, planner, [0])
    # What a planner does not embed is its refusal, not an invalid action; its plans pass every check.
    assert set(record.reason[~record.accepted]) == {Reason.REJECTED_BY_POLICY}
    (record,) = run_method(scenario, feasible, [0])
    assert record.scenario.mask == "feasible"
    assert set(record.reason[~record.accepted]) == {Reason.NO_FEASIBLE_ACTION}


def test_steps_are_walks_with_functions_in_order():
    scenario = toy.toy_scenario()
    workload = toy.workload_of((0, toy.SOLO, 3, 0, 2.0), (1, toy.DUO, 0, 3, 2.0))
    method = PlannerMethod(MyopicPlanner(), name="myopic_optimal")
    (record,) = run_method(scenario, method, [0], workloads=[workload])
    assert record.accepted.all() and record.workload is workload
    chains = scenario.catalogue.chain_length
    for r, (first, last) in enumerate(itertools.pairwise(record.step_offsets)):
        functions = record.step_function[first:last]
        assert functions[functions >= 0].tolist() == list(range(chains[workload.service[r]]))
        assert record.step_node[last - 1] == workload.egress[r]
        route = [workload.ingress[r], *record.step_node[first:last]]
        assert record.hops[r] == sum(a != b for a, b in itertools.pairwise(route))


def test_decisions_are_timed_by_the_clock_that_is_given():
    """A clock that ticks once a reading: one second a decision, whatever it took; shared out by requests."""
    ticks = iter(range(10**6))
    decisions = []

    class Counting(StepByStep):
        def __init__(self):
            super().__init__(method := RandomMethod())
            self.act = lambda simulator: decisions.append(1) or method.act(simulator)

    records = run_method(small_scenario(horizon=4), Counting(), [0, 1], clock=lambda: float(next(ticks)))
    assert sum(record.seconds for record in records) == pytest.approx(len(decisions))


def test_a_horizon_of_one_slot_and_one_without_requests():
    scenario = small_scenario(horizon=1, arrival_rate=0.5)
    empty = [seed for seed in range(20) if len(scenario.workload(seed)) == 0]
    records = run_method(scenario, RandomMethod(), range(20))
    assert 0 < len(empty) < 20
    for record in records:
        metrics = compute_metrics(record)
        assert np.isnan(metrics["aar"]) == (record.workload_seed in empty)


def test_what_cannot_be_run_is_said():
    scenario = small_scenario(horizon=2)
    with pytest.raises(ScenarioError, match="at least one workload seed"):
        run_method(scenario, RandomMethod(), [])
    with pytest.raises(ScenarioError, match="2 scenarios were given for 3 seeds"):
        run_method([scenario, scenario], RandomMethod(), [0, 1, 2])
    with pytest.raises(ScenarioError, match="1 workloads were given for 2 seeds"):
        run_method(scenario, RandomMethod(), [0, 1], workloads=[scenario.workload(0)])
    wrong = PolicyMethod(TensorDictModule(lambda mask: mask.long(), ["action_mask"], ["action"]))
    with pytest.raises(ScenarioError, match="act returned shape"):
        run_method(scenario, wrong, [0])
