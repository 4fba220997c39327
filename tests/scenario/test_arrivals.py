"""Arrival processes: their means, their course over time worked out by hand, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import toy
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.inputs import world_digests
from nfv_torchrl.methods import RandomMethod
from nfv_torchrl.scenario.arrivals import ArrivalProcess, busy_share, parse_arrivals, relative_rates
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.formats.demands import demand_matrix
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.scenario.traffic import Traffic

LONG = 20_000
"""Slots over which means are taken."""
ERRORS = 5
"""Standard errors that a mean may be off: in every example of every property, once in 50 million."""


def scenario(**changes) -> Scenario:
    """The toy network with any arrivals."""
    return toy.toy_scenario(endpoints="uniform", endpoint_pairs=None, **changes)


def counts(world: Scenario, seed: int = 0) -> np.ndarray:
    return np.bincount(world.workload(seed).slot, minlength=world.horizon)


rates = st.floats(0.01, 20)


@settings(max_examples=15)
@given(rate=rates, seed=st.integers(0, 1000))
def test_poisson_arrivals_have_the_mean_and_variance_of_their_law(rate, seed):
    here = counts(scenario(horizon=LONG, arrivals="poisson", arrival_rate=rate), seed)
    assert abs(here.mean() - rate) < ERRORS * math.sqrt(rate / LONG)
    spread = math.sqrt((rate + 2 * rate**2) / LONG)  # of the variance: fourth moment rate + 3 rate^2
    assert abs(here.var() - rate) < ERRORS * spread + 1e-3


@settings(max_examples=15)
@given(
    rate=rates, busy=st.floats(1, 20), mean_busy=st.floats(1, 30), mean_calm=st.floats(1, 60), seed=st.integers(0, 1000)
)
def test_modulated_arrivals_have_the_mean_in_the_long_run(rate, busy, mean_busy, mean_calm, seed):
    law = ArrivalProcess("modulated", busy=busy, mean_busy=mean_busy, mean_calm=mean_calm)
    here = counts(scenario(horizon=LONG, arrivals=law, arrival_rate=rate), seed)
    share = busy_share(law)
    calm = rate / (1 + (busy - 1) * share)
    between = share * (1 - share) * (calm * (busy - 1)) ** 2  # variance of the rate, remembered from slot to slot
    memory = 2 / (1 / mean_busy + 1 / mean_calm)
    assert abs(here.mean() - rate) < ERRORS * math.sqrt((rate + between * max(memory, 1)) / LONG)


def test_modulated_arrivals_by_hand():
    """States of one slot each alternate: half of the slots at half the rate, half at three halves."""
    law = {"process": "modulated", "busy": 3, "mean_busy": 1, "mean_calm": 1}
    here = counts(scenario(horizon=100, arrivals=law, arrival_rate=10_000))
    low, high = sorted([here[0::2], here[1::2]], key=lambda part: part.sum())
    assert np.all(np.abs(low - 5_000) < 6 * math.sqrt(5_000))
    assert np.all(np.abs(high - 15_000) < 6 * math.sqrt(15_000))
    # Stays of 2 and 5 slots on average: a share of 2 / 7 is busy.
    law = ArrivalProcess("modulated", busy=1e6, mean_busy=2, mean_calm=5)
    busy = counts(scenario(horizon=LONG, arrivals=law, arrival_rate=30)) > 10
    assert abs(busy.mean() - 2 / 7) < 0.02
    assert abs(busy.sum() / np.sum(busy[1:] & ~busy[:-1]) - 2) < 0.1


@pytest.mark.parametrize(
    ("rates", "period", "start", "expected"),
    [
        ((0, 2), 4, 0, [0, 0, 2, 2, 0, 0, 2, 2]),
        ((0, 2), 4, 3, [2, 0, 0, 2, 2, 0, 0, 2]),
        ((1, 3), 3, 0, [0.5, 1, 1.5, 0.5, 1, 1.5]),  # the second slot lies in both halves
        ((3, 3, 3), 86400, 0, [1, 1, 1]),
        ((0, 0, 4, 0), 2, 0, [0, 2, 0, 2]),  # parts shorter than a slot
    ],
)
def test_profiles_by_hand(rates, period, start, expected):
    law = ArrivalProcess("profile", rates=rates, period=period, start=start)
    assert relative_rates(law, len(expected)) == pytest.approx(expected, abs=1e-12)


@settings(max_examples=15)
@given(
    rate=rates,
    rates=st.lists(st.floats(0, 5), min_size=1, max_size=6).filter(lambda several: sum(several) > 0.1),
    period=st.integers(1, 50),
    seed=st.integers(0, 1000),
)
@example(rate=1.0, rates=[0.0, 1.078125, 0.5, 0.25, 0.0], period=5, seed=0)  # a rate of 0 came out as -9e-16
def test_profiles_have_the_mean_over_whole_periods(rate, rates, period, seed):
    horizon = LONG // period * period
    law = ArrivalProcess("profile", rates=tuple(rates), period=period, start=seed % period)
    here = counts(scenario(horizon=horizon, arrivals=law, arrival_rate=rate), seed)
    assert abs(here.mean() - rate) < ERRORS * math.sqrt(rate / horizon)
    assert relative_rates(law, horizon).mean() == pytest.approx(1, rel=1e-9)


# ---------------------------------------------------------------- traffic matrices


def written(folder: Path, time: str, demands: str) -> None:
    """A native SNDlib file of demands between the nodes of ``toy.py``."""
    nodes = "".join(f"  {name} ( {place}.0 1.0 )\n" for place, name in enumerate("0123"))
    rows = "".join(
        f"  D{k} ( {row.split()[0]} {row.split()[1]} ) 1 {row.split()[2]} UNLIMITED\n"
        for k, row in enumerate(demands.split(", "))
    )
    text = f"?SNDlib native format; type: network; version: 1.0\nMETA (\n  time = {time}\n  unit = MBITPERSEC\n)\n"
    text += f"NODES (\n{nodes})\nLINKS (\n)\nDEMANDS (\n{rows})\nADMISSIBLE_PATHS (\n)\n"
    (folder / f"{time}.txt").write_text(text)


def series(*several: list[tuple[str, str, float]], times: tuple[str, ...] = ()) -> list:
    stamps = times or ("",) * len(several)
    return [demand_matrix("week", "0123", rows, "Mbit/s", time) for rows, time in zip(several, stamps, strict=True)]


def test_matrices_by_hand():
    net = toy.toy_substrate()
    rows = [("0", "1", 3.0), ("1", "0", 1.0)], [("2", "3", 12.0)], [("0", "1", 0.0)]
    # Ten s of 4, ten of 12, ten of nothing: 16 / 3 on average.
    traffic = Traffic(series(*rows), net, 10)
    relative = traffic.relative_totals(40)
    assert relative.tolist() == pytest.approx([0.75] * 10 + [2.25] * 10 + [0] * 10 + [0.75] * 10)
    slot = np.repeat([0, 9, 10, 25, 35], 10_000)
    ends = np.stack(traffic.draw_ends(slot, np.random.default_rng(0)), axis=1)
    assert {*map(tuple, ends[slot == 10].tolist())} == {(2, 3)}
    for at in (0, 9, 25, 35):  # in slot 25 there is no traffic: the next matrix, which is the first
        mine = ends[slot == at]
        assert {*map(tuple, mine.tolist())} == {(0, 1), (1, 0)}
        assert abs((mine[:, 0] == 0).mean() - 0.75) < 5 * math.sqrt(0.75 * 0.25 / 10_000)
    # By their times the first holds 300 s, the second 600 s, the last as long as that.
    times = ("20040301-0000", "20040301-0005", "2004-03-01 00:15")
    relative = Traffic(series(*rows, times=times), net, None).relative_totals(1500)
    mean = (4 * 300 + 12 * 600) / 1500
    assert relative == pytest.approx([4 / mean] * 300 + [12 / mean] * 600 + [0] * 600)
    assert Traffic(series(rows[0]), net, None).relative_totals(3).tolist() == [1, 1, 1]


def test_a_folder_of_matrices_from_the_scenario_to_the_audit(tmp_path):
    (tmp_path / "week").mkdir()
    written(tmp_path / "week", "20040301-0000", "0 1 3, 1 0 1")
    written(tmp_path / "week", "20040301-0001", "2 3 12")
    law = {"process": "matrix", "path": str(tmp_path / "week")}
    world = scenario(horizon=120, arrivals=law, arrival_rate=40)
    requests = world.workload(0)
    pairs = np.stack([requests.ingress, requests.egress], axis=1)
    assert np.unique(pairs[requests.slot < 60], axis=0).tolist() == [[0, 1], [1, 0]]
    assert np.unique(pairs[requests.slot >= 60], axis=0).tolist() == [[2, 3]]
    first, second = counts(world)[:60].mean(), counts(world)[60:].mean()  # 4 and 12, of which 8 is the mean
    assert abs(first - 20) < 5 * math.sqrt(20 / 60) and abs(second - 60) < 5 * math.sqrt(60 / 60)
    other = world.replace(horizon=3)
    assert other.traffic is world.traffic  # read once
    (record,) = run_method(other, RandomMethod(name="random", mask="feasible"), [0])
    write_run(tmp_path / "run", record, compute_metrics(record))
    assert audit_run(tmp_path / "run").problems == []
    again = read_run_folder(tmp_path / "run").scenario
    assert again.arrivals == other.arrivals
    np.testing.assert_array_equal(again.workload(5).egress, other.workload(5).egress)
    before = world_digests([world])
    written(tmp_path / "week", "20040301-0001", "2 3 11")
    assert world_digests([scenario(horizon=120, arrivals=law, arrival_rate=40)]) != before


# ---------------------------------------------------------------- all of them

LAWS = [
    "uniform",
    "poisson",
    {"process": "modulated", "busy": 4, "mean_busy": 3, "mean_calm": 9},
    {"process": "profile", "rates": [1, 4, 2], "period": 7},
]


@pytest.mark.parametrize("law", LAWS, ids=["uniform", "poisson", "modulated", "profile"])
def test_a_seed_gives_the_same_arrivals_and_a_longer_horizon_continues_them(law):
    world = scenario(horizon=50, arrivals=law, arrival_rate=2.0)
    longer = world.replace(horizon=90).workload(3, 1)
    here = world.workload(3, 1)
    for name in ("slot", "service", "ingress", "egress", "lifetime"):
        np.testing.assert_array_equal(getattr(here, name), getattr(world.workload(3, 1), name))
        np.testing.assert_array_equal(getattr(here, name), getattr(longer, name)[: len(here)])
    assert not np.array_equal(counts(world, 1), counts(world, 2))
    assert parse_arrivals(world.arrivals.to_config(), "arrivals") == world.arrivals


def test_the_papers_arrivals_are_drawn_as_ever():
    world = scenario(horizon=500, arrival_rate=7.5)
    first = generator(11, Stream.WORKLOAD).integers(2**63, size=4)[0]
    drawn = np.random.default_rng(int(first)).integers(0, 15, size=500, endpoint=True)
    np.testing.assert_array_equal(counts(world, 11), drawn)


REFUSED = [
    ({"arrivals": "bursty"}, "arrivals: 'bursty' is unknown; use one of uniform, poisson, modulated"),
    ({"arrivals": 3}, "arrivals: 3 where one of uniform"),
    ({"arrivals": {"process": "modulated", "busy": 2}}, "arrivals.mean_busy: is missing; modulated needs busy"),
    ({"arrivals": {"process": "poisson", "rates": [1]}}, "arrivals.rates: poisson has no use for it; remove it"),
    ({"arrivals": {"process": "profile", "rates": [0, 0]}}, "arrivals.rates: .0.0, 0.0.; list numbers of at least 0"),
    ({"arrivals": {"process": "profile", "rates": [1], "period": 0}}, "arrivals.period: 0.0; use a number from 1"),
    ({"arrivals": {"process": "modulated", "busy": 0.5, "mean_busy": 2, "mean_calm": 2}}, "arrivals.busy: 0.5"),
    ({"arrivals": {"process": "poisson", "speed": 2}}, "arrivals.speed: unknown"),
    ({"arrivals": "file"}, "arrivals: file, but workload.path is null"),
    ({"arrivals": "poisson", "arrival_rate": 0.0}, "arrival_rate: 0.0; use a positive number"),
    ({"arrival_rate": 0.14}, "arrival_rate: 0.14; .* or arrivals=poisson, which takes any rate"),
    ({"arrivals": "poisson", "workload_path": "requests.csv"}, "arrivals: poisson, but requests come from"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_refuses(changes, message):
    with pytest.raises(ScenarioError, match=message):
        scenario(**changes)


def test_refuses_traffic_that_does_not_go_with_the_network():
    net, good = toy.toy_substrate(), [("0", "1", 1.0)]
    with pytest.raises(ScenarioError, match="week: demands name a node that the network lacks: unknown node '9'"):
        Traffic([demand_matrix("week", "09", [("0", "9", 1.0)])], net, 1)
    with pytest.raises(ScenarioError, match="week: all demands are 0"):
        Traffic(series([("0", "1", 0.0)]), net, 1)
    with pytest.raises(ScenarioError, match=r"week: its time is '', .*; set arrivals.interval"):
        Traffic(series(good, good), net, None)
    with pytest.raises(ScenarioError, match="matrices have the same time"):
        Traffic(series(good, good, times=("200403010000",) * 2), net, None)
    with pytest.warns(ScenarioWarning, match="demands from a node to itself are not used"):
        Traffic(series([*good, ("1", "1", 5.0)]), net, 1)
    with pytest.raises(ScenarioError, match="matrix draws the ends of requests; set endpoints=uniform"):
        toy.toy_scenario(arrivals={"process": "matrix", "path": "week"})
