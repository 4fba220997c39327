"""A run of three slots whose every metric is worked out by hand.

========  ====  =======  ========  ==================  ====  ====  =====
request   slot  service  lifetime  answer              cost  hops  delay
========  ====  =======  ========  ==================  ====  ====  =====
0         0     duo      1.5       accepted, leaves 2    55     3    945
1         0     solo     0.4       accepted, leaves 1    50     3    945
2         1     duo      5         vm_capacity
3         2     duo      10        accepted, stays       95     3    795
========  ====  =======  ========  ==================  ====  ====  =====

Running after the arrivals of slot 0: requests 0 and 1 ($105), of slot 1: request 0 ($55), of slot 2: request 3 ($95).
Duo loads VMs with 30 Mcycles/s and each of its hops with 1 Mbit/s, solo with 20 and 2; the network has 330 and 49.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import toy
from handmade import first_fit
from toy import DUO, SOLO

from nfv_torchrl.evaluation.metrics import compute_metrics, paired_cost, per_slot_cost, running_total
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.simulator.reasons import Reason


def three_slots(warmup: int = 0, **changes) -> RunRecord:
    walks = [
        [(1, 0, 0), (2, 0, 1), (3, 0, -1)],
        [(2, 0, 0), (1, 0, -1), (0, 0, -1)],
        [],
        [(1, 0, 0), (2, 0, -1), (3, 0, -1), (3, 1, 1)],
    ]
    node, vm, function = np.array([step for walk in walks for step in walk], np.int32).T
    record = RunRecord(
        method="hand",
        workload_seed=0,
        scenario=toy.toy_scenario(horizon=3, warmup=warmup),
        workload=toy.workload_of((0, DUO, 0, 3, 1.5), (0, SOLO, 3, 0, 0.4), (1, DUO, 0, 3, 5), (2, DUO, 0, 3, 10)),
        timeline=FailureTimeline.empty(),
        accepted=np.array([True, True, False, True]),
        reason=np.array([-1, -1, Reason.VM_CAPACITY, -1], np.int8),
        delay_ms=np.array([945.0, 945.0, math.nan, 795.0]),
        cost=np.array([55.0, 50.0, math.nan, 95.0]),
        hops=np.array([3, 3, 0, 3]),
        interrupted_at=np.full(4, -1),
        step_offsets=np.cumsum([0, *map(len, walks)]),
        step_node=node,
        step_vm=vm,
        step_function=function,
        seconds=0.5,
    )
    return replace(record, **changes)


def test_every_metric():
    metrics = compute_metrics(three_slots())
    mean_load = (30 + 20) / 2
    expected = {
        "rho": 1 * 2 * (1 - math.exp(-3 / 2)) * mean_load / 330,
        "arrived": 4,
        "accepted": 3,
        "aar": 3 / 4,
        "aar/duo": 2 / 3,
        "aar/solo": 1,
        "anuc": (105 + 55 + 95) / 3,
        "cost_per_accepted": 200 / 3,
        "cost_per_accepted/duo": 75,
        "cost_per_accepted/solo": 50,
        "rejected/link_capacity": 0,
        "rejected/vm_capacity": 1 / 4,
        "rejected/delay": 0,
        "rejected/step_limit": 0,
        "rejected/no_feasible_action": 0,
        "rejected/rejected_by_policy": 0,
        "rejected/invalid_action": 0,
        "refused/duo": 0,
        "refused/solo": 0,
        "mean_hops": 3,
        "mean_delay_ms": 895,
        "vm_utilisation": (50 + 30 + 30) / 3 / 330,
        "vm_utilisation_peak": 50 / 330,
        "link_utilisation": (9 + 3 + 3) / 3 / 49,
        "link_utilisation_peak": 9 / 49,
        "interrupted": 0,
        "lost_service_time": 0,
        "decision_seconds": 0.5,
        "decisions_per_second": 8,
    }
    assert metrics == pytest.approx(expected, rel=1e-12)


def test_slot_by_slot():
    record = three_slots()
    assert per_slot_cost(record).tolist() == [105, 55, 95]
    assert running_total(record, np.ones(4, np.int64)).tolist() == [2, 1, 1]


def test_interrupted_request_stays_accepted_but_runs_no_more():
    metrics = compute_metrics(three_slots(interrupted_at=np.array([1, -1, -1, -1])))
    assert metrics["aar"] == 3 / 4
    assert metrics["anuc"] == pytest.approx((105 + 0 + 95) / 3)
    assert metrics["interrupted"] == pytest.approx(1 / 3)
    assert metrics["lost_service_time"] == 1  # slot 1, the last before it would have left


def test_warmup_leaves_slots_and_their_requests_out():
    metrics = compute_metrics(three_slots(warmup=1))
    assert (metrics["arrived"], metrics["accepted"], metrics["aar"]) == (2, 1, 1 / 2)
    assert math.isnan(metrics["aar/solo"])
    assert metrics["anuc"] == (55 + 95) / 2  # request 0 came in the warm-up and still runs in slot 1
    assert metrics["cost_per_accepted"] == 95
    assert metrics["vm_utilisation_peak"] == 30 / 330
    assert metrics["rejected/vm_capacity"] == 1 / 2


def test_nothing_accepted():
    nothing = first_fit(refuse=frozenset(range(5)))
    metrics = compute_metrics(nothing)
    assert (metrics["aar"], metrics["anuc"], metrics["vm_utilisation"]) == (0, 0, 0)
    assert math.isnan(metrics["cost_per_accepted"])
    assert math.isnan(metrics["mean_delay_ms"])


def test_paired_cost_is_over_the_requests_both_accept():
    record = three_slots()
    other = three_slots(
        accepted=np.array([True, False, True, True]),
        reason=np.array([-1, Reason.DELAY, -1, -1], np.int8),
        cost=np.array([110.0, math.nan, 1000.0, 90.0]),
    )
    assert paired_cost(record, other) == (55 + 95) / (110 + 90)  # not request 1, which one of them rejects, nor 2
    assert paired_cost(other, record) == (110 + 90) / (55 + 95)
    assert math.isnan(paired_cost(record, three_slots(accepted=np.zeros(4, bool))))
