"""Failures and repairs: order, statistics and JSON."""

from __future__ import annotations

import numpy as np
import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from strategies import substrates

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline, sample_timeline
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

probability = st.sampled_from([0.0, 0.05, 0.3, 0.9, 1.0])
models = st.builds(FailureModel, probability, probability, probability)


def draw(model: FailureModel, substrate, horizon: int, seed: int = 0) -> FailureTimeline:
    return sample_timeline(model, substrate, horizon, np.random.default_rng(seed))


@given(model=models, substrate=substrates(), horizon=st.integers(1, 40), seed=st.integers(0, 1000))
def test_what_holds_of_every_timeline(model, substrate, horizon, seed):
    """Events come by slot, repairs first; only what exists and works fails; only what failed earlier is repaired."""
    timeline = draw(model, substrate, horizon, seed)
    keys = list(zip(timeline.slot.tolist(), (~timeline.up).tolist(), timeline.resource.tolist(), strict=True))
    assert keys == sorted(set(keys))
    vms = substrate.num_nodes * substrate.max_vms
    since: dict[int, int] = {}
    for slot, failed, resource in keys:
        assert 0 <= slot < horizon
        if resource < vms:
            vm_of, vm = divmod(resource, substrate.max_vms)
            assert vm < substrate.vm_count[vm_of]
            assert model.p_fail_vm > 0
        else:
            assert resource < vms + substrate.num_links
            assert model.p_fail_link > 0
        if failed:
            assert resource not in since
            since[resource] = slot
        else:
            assert model.p_repair > 0
            assert since.pop(resource) < slot


def test_off_is_empty():
    assert len(draw(FailureModel(p_repair=0.5), toy.toy_substrate(), 100)) == 0
    assert len(paper_scenario().failure_timeline(0)) == 0


def test_certain_failure_and_repair_by_hand():
    """With both certain everything fails in slot 0, then is repaired and fails again in every slot."""
    timeline = draw(FailureModel(p_fail_vm=1.0, p_repair=1.0), toy.toy_substrate(), 3)
    vms = [0, 2, 3, 4, 6, 7]  # VMs 1 and 5 do not exist
    assert timeline.slot.tolist() == [0] * 6 + [1] * 12 + [2] * 12
    assert timeline.resource.tolist() == vms * 5
    assert timeline.up.tolist() == [False] * 6 + ([True] * 6 + [False] * 6) * 2


def test_without_repair_each_fails_once():
    timeline = draw(FailureModel(p_fail_link=0.5), toy.toy_substrate(), 100)
    assert sorted(timeline.resource.tolist()) == [8, 9, 10, 11, 12]
    assert not timeline.up.any()


def test_statistics():
    """The share d of resources that are down after a slot's events settles where a slot leaves it as it is.

    With p_fail 0.02 and p_repair 0.1: 0.9 d were down and not repaired, of the rest, the just repaired included, 0.02
    fail. d = 0.9 d + 0.02 (1 - 0.9 d), so d = 0.02 / (0.1 + 0.018) = 0.1695.
    """
    substrate = draw_random_substrate(30, 0)
    timeline = draw(FailureModel(0.02, 0.02, 0.1), substrate, 4000)
    resources = int(substrate.vm_count.sum()) + substrate.num_links
    change = np.bincount(timeline.slot, weights=np.where(timeline.up, -1, 1), minlength=4000)
    assert (np.cumsum(change) / resources)[500:].mean() == pytest.approx(0.1695, rel=0.03)


def test_stream_of_its_own():
    model = {"p_fail_vm": 0.01, "p_fail_link": 0.01, "p_repair": 0.1}
    base = paper_scenario(horizon=200, failures=model)
    other = paper_scenario(horizon=200, failures=model, arrival_rate=3, endpoints="uniform")
    np.testing.assert_array_equal(base.failure_timeline(4).slot, other.failure_timeline(4).slot)
    assert base.failure_timeline(4).slot.tolist() != base.failure_timeline(5).slot.tolist()
    np.testing.assert_array_equal(base.workload(4).slot, paper_scenario(horizon=200).workload(4).slot)


# ---------------------------------------------------------------- JSON


@given(model=models, substrate=substrates(), seed=st.integers(0, 1000))
def test_events_round_trip(model, substrate, seed):
    timeline = draw(model, substrate, 15, seed)
    again = FailureTimeline.from_events(timeline.to_events(substrate), substrate)
    for name in ("slot", "resource", "up"):
        expected, actual = getattr(timeline, name), getattr(again, name)
        assert actual.dtype == expected.dtype
        np.testing.assert_array_equal(actual, expected)


def test_events_by_hand():
    timeline = toy.timeline_of((1, 3, False), (2, 3, True), (2, 10, False))
    assert timeline.to_events(toy.toy_substrate()) == [
        {"slot": 1, "event": "failure", "vm": [1, 1]},
        {"slot": 2, "event": "repair", "vm": [1, 1]},
        {"slot": 2, "event": "failure", "link": [1, 2]},
    ]


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (None, "must be a list"),
        ([{"slot": 1, "event": "failure"}], "entry 0: .* is no repair or failure"),
        ([{"slot": 1, "event": "explosion", "vm": [0, 0]}], "is no repair or failure"),
        ([{"slot": -1, "event": "failure", "vm": [0, 0]}], "is no repair or failure"),
        ([{"slot": 10**30, "event": "failure", "vm": [0, 0]}], "is no repair or failure"),
        ([{"slot": 1, "event": "failure", "vm": [0, 1]}], "is no repair or failure"),
        ([{"slot": 1, "event": "failure", "link": [0, 3]}], "is no repair or failure"),
        ([{"slot": 1, "event": "repair", "vm": [0, 0]}], "it works already"),
        ([{"slot": s, "event": "failure", "vm": [0, 0]} for s in (1, 2)], "entry 1: .* it has failed already"),
        ([{"slot": s, "event": "failure", "vm": [s, 0]} for s in (2, 1)], "entry 1: is out of order"),
    ],
)
def test_refuses_events(events, message):
    with pytest.raises(ScenarioError, match=message):
        FailureTimeline.from_events(events, toy.toy_substrate())


@pytest.mark.parametrize("key", ["p_fail_vm", "p_fail_link", "p_repair"])
@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_refuses_what_is_no_probability(key, value):
    with pytest.raises(ScenarioError, match=f"failures.{key}"):
        FailureModel(**{key: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slot": [2, 1]}, "out of order"),
        ({"slot": [-1, 1]}, "out of order"),
        ({"slot": [1, 1], "up": [False, True]}, "repairs before failures"),
        ({"slot": [1.5, 2.0]}, "slot is float64"),
        ({"up": [0, 1]}, "up is int64"),
        ({"resource": [3]}, r"resource is int64 \[1\]; use int64 \[E\]"),
        ({"slot": 3}, r"slot is int64 \[\]"),
    ],
)
def test_refuses_columns_from_python(changes, message):
    columns = {"slot": [1, 2], "resource": [3, 3], "up": [False, True]}
    with pytest.raises(ScenarioError, match=message):
        FailureTimeline(**{name: np.array(column) for name, column in {**columns, **changes}.items()})


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([(1, 1, False)], "does not have"),  # node 0 has one VM
        ([(1, 13, False)], "does not have"),  # 8 places of VMs, 5 links
        ([(1, -1, False)], "does not have"),
        ([(1, 3, True)], "repairs what works"),
        ([(1, 3, False), (2, 8, False), (3, 3, False)], "fails what has failed"),
    ],
)
def test_a_simulator_refuses_the_timeline_of_another_network(events, message):
    """Before the compiled kernels, which would index past their arrays."""
    simulator = Simulator(toy.toy_scenario(), 1)
    with pytest.raises(ScenarioError, match=message):
        simulator.start(0, toy.toy_workload(), toy.timeline_of(*events))


@given(model=models, substrate=substrates(), seed=st.integers(0, 1000))
def test_what_is_drawn_fits(model, substrate, seed):
    draw(model, substrate, 40, seed).check_fits(substrate)
