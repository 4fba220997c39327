"""Bounds where ends are free, functions stand apart, times are real, and a file says the law of lifetimes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import general_instances

from nfv_torchrl.bounds.bound import blind_bound, blind_bound_applies, hindsight_bound, lifetime_luck
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.bounds import aar_bounds, recompute_bound
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, TabuPlanner
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.formats.nfvdeep import read_nfvdeep
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.request_sets import mean_stay
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator

PAIR, TRIO = 0, 1


def row_of_nodes(nodes: int, vm: float, link: float, **changes) -> Scenario:
    """Nodes in a row. Chains of two ("pair") or three functions ("trio") of 5 cpu each, 4 Mbit/s between them."""
    substrate = Substrate(
        name="row", labels=tuple("abcdef"[:nodes]), vm_count=np.ones(nodes, np.int64),
        vm_capacity=np.full((nodes, 1), vm), vm_unit_cost=np.ones((nodes, 1)),
        links=np.array([[node, node + 1] for node in range(nodes - 1)]), link_capacity=np.full(nodes - 1, link),
        link_delay=np.zeros(nodes - 1), link_unit_cost=np.ones(nodes - 1), coordinates=None,
    )  # fmt: skip
    asked = {"tolerable_delay": None, "ingress": "any", "egress": "any"}
    types = tuple(
        ServiceType(name, ("L",) * count, rate=4.0, rates=(0.0, *[4.0] * (count - 1), 0.0), **asked)
        for name, count in (("pair", 2), ("trio", 3))
    )
    catalogue = ServiceCatalogue(types, {"L": {"cpu": 5.0}}, (Resource("cpu", False),))
    settings = {"endpoints": "uniform", "placement": "distinct", "mean_lifetime": 4.0, "arrival_rate": 1.0, **changes}
    return Scenario("row", 0, substrate, catalogue, 10, **settings)


def requests(*rows: tuple[float, int], lifetime: float = 9.0) -> Workload:
    """(arrival, service); within slots if some arrival is no whole number."""
    time, service = np.array([row[0] for row in rows], float), np.array([row[1] for row in rows], np.int64)
    ends, slot = np.full(len(rows), FREE), np.floor(time).astype(np.int64)
    stays = np.full(len(rows), lifetime)
    return Workload(slot, service, ends, ends, stays, time=None if np.array_equal(slot, time) else time)


def test_functions_on_different_nodes_need_links():
    """Two links of 4 Mbit/s carry two pairs, or one trio, at a time; the VMs would hold any number."""
    workload = requests((0, PAIR), (0, PAIR), (0, PAIR), (0, TRIO))
    bound = hindsight_bound(row_of_nodes(3, 100.0, 4.0), workload)
    assert (bound.accepted, bound.cuts) == (2, 1)
    assert hindsight_bound(row_of_nodes(3, 100.0, 4.0), requests((0, TRIO), (0, TRIO))).accepted == 1
    # The rule of walks: every further function comes with a hop. With colocation none is needed.
    assert hindsight_bound(row_of_nodes(3, 100.0, 4.0, placement="walk"), workload).accepted == 2
    assert hindsight_bound(row_of_nodes(3, 100.0, 4.0, placement="colocate"), workload).accepted == 4


def test_full_duplex_has_twice_the_links():
    scenario = row_of_nodes(3, 100.0, 4.0)
    both_ways = replace(scenario.substrate, back_capacity=np.full(2, 4.0))
    assert hindsight_bound(scenario.replace(substrate=both_ways), requests(*[(0, PAIR)] * 5)).accepted == 4


def test_blind_by_hand_between_whole_seconds():
    """Room for one pair; the second comes 1.5 s after the first, which is then there with exp(-1.5 / 4)."""
    scenario = row_of_nodes(2, 5.0, 4.0)
    assert blind_bound(scenario, requests((0.25, PAIR), (1.75, PAIR))).accepted == pytest.approx(2 - math.exp(-1.5 / 4))
    # In one slot, too; and whoever comes at the same time meets the other for sure.
    assert blind_bound(scenario, requests((1.25, PAIR), (1.75, PAIR))).accepted == pytest.approx(2 - math.exp(-0.5 / 4))
    assert blind_bound(scenario, requests((1.25, PAIR), (1.25, PAIR))).accepted == pytest.approx(1)


def best_of_all_blind_methods(workload: Workload, room: int, mean: float) -> float:
    """Expected number accepted by the best method that sees departures as they come: every state, every choice.

    ``room``: how many pairs there is room for at a time.
    """
    time = (workload.slot if workload.time is None else workload.time).tolist()

    @cache
    def worth(r: int, running: frozenset[int]) -> float:
        if r == len(time):
            return 0.0
        stay = math.exp(-(time[r] - time[r - 1]) / mean) if r else 1.0
        total = 0.0
        for size in range(len(running) + 1):
            for left in itertools.combinations(sorted(running), size):
                there = running - set(left)
                chance = stay ** len(there) * (1 - stay) ** size
                best = worth(r + 1, there)
                if len(there) < room:
                    best = max(best, 1 + worth(r + 1, there | {r}))
                total += chance * best
        return total

    return worth(0, frozenset())


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, 2.25, 3.0, 3.5, 6.0, 9.0]), min_size=1, max_size=6),
    st.integers(1, 3),
    st.sampled_from([0.5, 4.0, 50.0]),
)
def test_no_adaptive_method_beats_the_blind_bound(times, room, mean):
    """On two nodes with a link the programme's rows are all that matters, so that the best method can be tried."""
    workload = requests(*[(time, PAIR) for time in sorted(times)])
    by_vms = row_of_nodes(2, 5.0 * room, 100.0, mean_lifetime=mean)
    by_links = row_of_nodes(2, 100.0, 4.0 * room, mean_lifetime=mean)
    best = best_of_all_blind_methods(workload, room, mean)
    for scenario in (by_vms, by_links):
        bound = blind_bound(scenario, workload).accepted
        assert best <= bound + 1e-9
        if len(times) == 2 or len(times) <= room:
            assert bound == pytest.approx(best)


def accepted_by(planner: Planner, scenario: Scenario, workload: Workload, timeline: FailureTimeline) -> np.ndarray:
    """Which requests a planner accepts in the simulator, bool [R]."""
    simulator, accepted = Simulator([scenario], 1), np.zeros(len(workload), bool)
    simulator.start(0, workload, timeline)
    e = simulator.world.env[0]
    plans, lengths = np.zeros((1, scenario.max_steps), np.int64), np.zeros(1, np.int64)
    planner.prepare(simulator.world)
    while not e["done"]:
        request = int(e["cursor"])
        planner.plan_rows(simulator.world, np.zeros(1, np.int64), plans, lengths)
        for action in plans[0, : lengths[0]] if lengths[0] else [simulator.num_actions - 1]:
            simulator.step(np.array([action]))
        accepted[request] = bool(simulator.outcome["accepted"][0])
    return accepted


@pytest.mark.parametrize("planner", [GreedyPlanner, TabuPlanner, MyopicPlanner])
def test_planners_stay_below_the_blind_bound_on_average(planner):
    """Arrivals are fixed, stays drawn 150 times; without its luck no run is above, with it none is on average."""
    rng = np.random.default_rng(1)
    scenario = row_of_nodes(4, 10.0, 12.0, admission_control=True)
    rows = [(time, kind) for time, kind in zip(np.sort(rng.uniform(0, 10, 40)), rng.integers(0, 2, 40), strict=True)]
    workload, got, luck = requests(*rows), [], []
    bound = blind_bound(scenario, workload).accepted
    for _ in range(150):
        lived = replace(workload, lifetime=rng.exponential(4.0, 40))
        accepted = accepted_by(planner(), scenario, lived, FailureTimeline.empty())
        got.append(accepted.sum())
        luck.append(lifetime_luck(scenario, lived, accepted))
        assert got[-1] - luck[-1] <= bound + 1e-6
    assert np.mean(got) <= bound + 3 * np.std(got) / math.sqrt(len(got))
    assert abs(np.mean(luck)) <= 4 * np.std(luck) / math.sqrt(len(luck))
    assert np.mean(got) > 0.6 * bound, "so it says something"


@given(general_instances(admission_control=True), st.sampled_from([0.5, 3.0, 20.0]))
def test_without_its_luck_no_run_is_above_the_blind_bound(instance, mean):
    """Whatever the kinds, ends, rates, times, failures and rules."""
    scenario, workload, timeline = instance
    accepted = accepted_by(MyopicPlanner(), scenario, workload, timeline)
    luck = lifetime_luck(scenario, workload, accepted, timeline, mean_lifetime=mean)
    assert accepted.sum() - luck <= blind_bound(scenario, workload, timeline, mean_lifetime=mean).accepted + 1e-6
    assert accepted.sum() <= hindsight_bound(scenario, workload, timeline).accepted


LAWS = """
num_v_nets: 60
topology: {type: path}
v_net_size: {distribution: uniform, dtype: int, low: 2, high: 4}
arrival_rate: {distribution: poisson, dtype: float, lam: 0.05, reciprocal: true}
lifetime: {distribution: exponential, dtype: float, scale: 500}
node_attrs_setting: [{name: cpu, type: resource, owner: node, distribution: uniform, dtype: int, low: 0, high: 6}]
link_attrs_setting: [{name: bw, type: resource, owner: link, distribution: uniform, dtype: int, low: 0, high: 4}]
"""


@pytest.fixture
def chains(tmp_path) -> Scenario:
    path = tmp_path / "laws.yaml"
    path.write_text(LAWS)
    scenario = row_of_nodes(4, 20.0, 12.0, admission_control=True)
    catalogue = ServiceCatalogue(scenario.catalogue.types[:1], scenario.catalogue.vnfs, scenario.catalogue.resources)
    return scenario.replace(catalogue=catalogue, workload_path=str(path), horizon=2500)


def test_a_file_of_laws_says_how_long_requests_stay(chains, tmp_path):
    assert chains.file_mean_lifetime == 500 and blind_bound_applies(chains)
    workload = chains.workload(0)
    bound = blind_bound(chains, workload)
    # Every slot has a row, or those with arrivals: what is there only gets less in between.
    sampled = chains.replace(workload_path=None)
    vars(sampled)["profiles"] = chains.profiles
    assert blind_bound(sampled, workload, mean_lifetime=500.0).accepted == pytest.approx(bound.accepted, rel=1e-6)
    assert bound.accepted < hindsight_bound(chains, workload).accepted
    assert aar_bounds(chains, 0)["blind"] == bound.aar
    assert not blind_bound_applies(chains.replace(observe_lifetime=True))
    workload.to_csv(tmp_path / "plain.csv", chains.catalogue)
    plain = chains.replace(workload_path=str(tmp_path / "plain.csv"))
    assert plain.file_mean_lifetime is None and not blind_bound_applies(plain)
    with pytest.raises(ScenarioError, match="law of the lifetimes"):
        blind_bound(plain, workload)


def test_a_run_remembers_the_law(chains, tmp_path):
    (record,) = run_method(chains, PlannerMethod(GreedyPlanner(), name="greedy"), [0])
    write_run(tmp_path / "run", record, compute_metrics(record))
    assert recompute_bound(tmp_path / "run", "blind") == aar_bounds(chains, 0)["blind"]
    path = tmp_path / "run" / "scenario.json"
    path.write_text(path.read_text().replace('"file_mean_lifetime": 500', '"file_mean_lifetime": -1'))
    with pytest.raises(ScenarioError, match="file_mean_lifetime is -1; a positive number was expected"):
        recompute_bound(tmp_path / "run", "blind")


def test_the_law_of_cn_upb_is_known_too():
    """Their stays are floor(X) + 1 slots, X exponential: P(longer than k) = exp(-k / mean), k = 0, 1, ..."""
    path = Path(__file__).parents[2] / "docs" / "benchmark" / "cnupb_1050.json"
    for seed in range(3):
        mean = mean_stay(path, seed)
        stays = np.array([asked.lifetime for asked in read_nfvdeep(path, seed).requests])
        for k in (int(mean / 4), int(mean), int(2 * mean)):
            chance = math.exp(-k / mean)
            assert abs(np.mean(stays > k) - chance) < 4 * math.sqrt(chance * (1 - chance) / len(stays))
