"""Methods run on workloads: what they decide is theirs alone, and what is recorded stands up to the audit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
import toy
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import MOST_TOGETHER, run_method, scenario_for
from nfv_torchrl.methods import PlannerMethod, PolicyMethod, RandomMethod, methods_from_config
from nfv_torchrl.observations import RequestObservation
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


class RejectAll:
    """A user's own method."""

    name, decides_admission, mask, one_hot = "reject_all", True, None, False

    def __init__(self, scenario=None):
        self.scenario = scenario

    def prepare(self, simulator, seeds):
        pass

    def act(self, simulator):
        return np.full(simulator.batch_size, simulator.num_actions - 1)


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


class Counter(TensorDictModuleBase):
    """Takes the first valid action and counts its steps in a state that it is given back."""

    in_keys, out_keys = ["action_mask"], ["action", ("next", "count")]

    def __init__(self):
        super().__init__()
        self.counts = []

    def forward(self, tensordict):
        count = tensordict.get("count", torch.zeros(tensordict.batch_size)) + 1
        self.counts.append(int(count[0]))
        return tensordict.update({"action": tensordict["action_mask"].long().argmax(-1), "next": {"count": count}})


def test_a_policy_sees_what_the_environment_shows():
    seen = {}

    def first_valid(mask, observation, egress):
        seen.update(mask=mask, observation=observation, egress=egress)
        return mask.long().argmax(-1)

    keys = ["action_mask", "observation", ("request", "egress")]
    actor = TensorDictModule(first_valid, in_keys=keys, out_keys=["action"])
    scenario = small_scenario(horizon=4)
    records = run_method(scenario, PolicyMethod(actor, [RequestObservation()], one_hot=True), [0, 1])
    assert seen["mask"].shape == (2, 2 * 6 * 2 + 1) and seen["egress"].shape == (2,)
    plain = PolicyMethod(TensorDictModule(lambda mask: mask.long().argmax(-1), ["action_mask"], ["action"]))
    for record, other in zip(records, run_method(scenario, plain, [0, 1]), strict=True):
        assert_same_decisions(record, other)
        assert record.seconds > 0 and np.isfinite(record.decisions_per_second)


def test_decisions_are_timed_by_the_clock_that_is_given():
    """A clock that ticks once a reading: one second a decision, whatever it took; shared out by requests."""
    ticks = iter(range(10**6))
    decisions = []

    class Counting(RandomMethod):
        def act(self, simulator):
            decisions.append(1)
            return super().act(simulator)

    records = run_method(small_scenario(horizon=4), Counting(), [0, 1], clock=lambda: float(next(ticks)))
    assert sum(record.seconds for record in records) == pytest.approx(len(decisions))


def test_a_recurrent_state_is_carried_and_dropped_at_the_start():
    actor = Counter()
    method = PolicyMethod(actor)
    scenario = small_scenario(horizon=5)
    for _ in range(2):
        actor.counts.clear()
        run_method(scenario, method, [0])
        steps = actor.counts[1:]  # the first call warms up
        assert steps == list(range(1, len(steps) + 1))


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


def test_methods_come_from_their_targets():
    scenario = small_scenario(horizon=2)
    own = f"{__name__}.RejectAll"
    first, second = methods_from_config(
        {
            "a": {"_target_": "nfv_torchrl.methods.RandomMethod"},
            "b": {"_target_": own, "_partial_": True},
        },
        scenario,
    )
    assert first.name == "random" and second.scenario is scenario
    (record,) = run_method(scenario, second, [0])
    assert set(record.reason) == {Reason.REJECTED_BY_POLICY}
    for config, problem in (
        ({}, "names no method"),
        ({"a": {"name": "x"}}, "give _target_"),
        ({"a": {"_target_": "builtins.dict"}}, "dict lacks 'name'"),
        ({"a": {"_target_": own}, "b": {"_target_": own}}, "is called 'reject_all' too"),
    ):
        with pytest.raises(ScenarioError, match=problem):
            methods_from_config(config, scenario)
