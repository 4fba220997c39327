"""Why a request was rejected, and results as pandas."""

import builtins

import numpy as np
import pytest
import toy
from toy import DUO, SOLO

from nfv_torchrl import PlannerMethod, RandomMethod, paper_scenario, run_method
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.data_frames import metrics_frame, requests_frame
from nfv_torchrl.evaluation.why import simulator_before, why_rejected
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.simulator.state import OUTCOME


class Refuser:
    """Rejects the first request and takes what the exact search finds for the others."""

    decides_admission, mask, one_hot, name = True, None, False, "refuser"

    def __init__(self):
        self.exact = PlannerMethod(MyopicPlanner(), name="exact")

    def prepare(self, simulator, seeds):
        self.exact.prepare(simulator, seeds)

    def act(self, simulator):
        first = simulator.world.env["cursor"] == 0
        return np.where(first, simulator.num_actions - 1, self.exact.act(simulator))


def test_the_answer_names_what_ended_it_and_what_was_possible():
    workload = toy.workload_of((0, DUO, 0, 3, 2.0), (1, SOLO, 3, 0, 2.0))
    scenario = toy.toy_scenario(admission_control=True)
    (record,) = run_method(scenario, Refuser(), [0], workloads=[workload])
    (free,) = run_method(scenario, PlannerMethod(MyopicPlanner(), name="exact"), [0], workloads=[workload])
    words = why_rejected(record, 0)
    assert words.startswith(
        "Request 0 (duo from 0 to 3, slot 0) was rejected by refuser: the method chose to reject it"
    )
    walk = f"a walk of {free.hops[0]} hops, {free.delay_ms[0]:.0f} ms and {free.cost[0]:,.1f} $."
    assert words.endswith(walk)
    with pytest.raises(ScenarioError, match="request 1 was accepted"):
        why_rejected(record, 1)
    with pytest.raises(ScenarioError, match="request 2: the run has requests 0 to 1"):
        why_rejected(record, 2)


def test_the_run_is_played_again_to_the_bit_and_the_exact_search_agrees_with_its_own_run():
    scenario = paper_scenario(5, arrival_rate=8, horizon=60, substrate={"target_rho": 3.0})
    exact = PlannerMethod(MyopicPlanner(), name="exact")
    (record,) = run_method(scenario, exact, [3])
    lost = np.flatnonzero(~record.accepted)
    assert lost.size > 3
    assert "finds no walk" in why_rejected(record, int(lost[-1]))

    (random,) = run_method(scenario, RandomMethod(mask="feasible"), [3])
    taken = int(np.flatnonzero(random.accepted)[-1])
    simulator = simulator_before(random, taken)
    assert simulator.world.env["cursor"][0] == taken
    for step in range(random.step_offsets[taken], random.step_offsets[taken + 1]):
        vms = scenario.substrate.vm_capacity.shape[1]
        action = 2 * (random.step_node[step] * vms + random.step_vm[step]) + (random.step_function[step] >= 0)
        simulator.step(np.array([action], np.int64))
    assert simulator.world.outcome[0, OUTCOME.request_cost] == random.cost[taken]


def test_frames_hold_what_the_records_hold():
    scenario = paper_scenario(5, arrival_rate=8, horizon=60, substrate={"target_rho": 3.0})
    (record,) = run_method(scenario, RandomMethod(name="random"), [3])
    frame = requests_frame(record)
    assert len(frame) == record.num_requests
    assert frame["accepted"].mean() == record.accepted.mean()
    assert frame["cost"].sum() == pytest.approx(np.nansum(record.cost))
    assert frame.loc[~frame["accepted"], ["reason"]].notna().all().all()
    assert frame.loc[~frame["accepted"], "hops"].isna().all() and frame.loc[frame["accepted"], "reason"].isna().all()
    assert frame["hops"].sum() == record.hops[record.accepted].sum()
    assert set(frame["service"]) <= {kind.name for kind in scenario.catalogue.types}

    comparison = Comparison(scenario)
    metrics = comparison.add(record)
    comparison.add_bound("blind", 3, 0.9)
    table = metrics_frame(comparison)
    assert table.loc[("random", 3), "aar"] == metrics["aar"]
    assert table.loc[("bound: blind", 3), "aar"] == 0.9


def test_without_pandas_the_error_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ScenarioError, match="pip install pandas"):
        metrics_frame(Comparison(toy.toy_scenario()))
