"""The bounds by hand, against every subset of requests, and against methods that really ran."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from exhaustive import Case, plan_of
from hypothesis import given
from hypothesis import strategies as st

from nfv_torchrl.bounds.bound import blind_bound, hindsight_bound, hindsight_least_cost, lifetime_luck
from nfv_torchrl.bounds.occupancy import Columns, certificate, maximise_value
from nfv_torchrl.bounds.relaxations import candidate_cuts, least_cost, least_delay
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline, sample_timeline
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator.tables import Rules, build_tables

SMALL, LARGE = 0, 1


def two_nodes(vm: float = 10.0, link: float = 100.0, horizon: int = 10, **changes) -> Scenario:
    """0 -- 1 with one VM of ``vm`` Mcycles/s at node 1; "small" takes 2 Mcycles/s at 1 Mbit/s, "large" 5 at 1."""
    substrate = Substrate(
        name="two",
        labels=("0", "1"),
        vm_count=np.array([1, 1]),
        vm_capacity=np.array([[1e-6], [vm]]),  # nothing fits on node 0
        vm_unit_cost=np.array([[1.0], [3.0]]),
        links=np.array([[0, 1]]),
        link_capacity=np.array([link]),
        link_delay=np.array([1.0]),
        link_unit_cost=np.array([7.0]),
    )
    types = (ServiceType("small", ("S",), 1.0, 5000.0), ServiceType("large", ("L",), 1.0, 5000.0))
    settings = {"endpoints": "uniform", "mean_lifetime": 3.0, "arrival_rate": 1.0, **changes}
    return Scenario("two", 0, substrate, ServiceCatalogue(types, {"S": 2.0, "L": 5.0}), horizon, **settings)


def requests(*rows: tuple[int, int, float]) -> Workload:
    """(slot, service, lifetime) of requests from node 0 to node 1."""
    slot, service, lifetime = zip(*rows, strict=True) if rows else ((), (), ())
    ends = np.zeros(len(rows), np.int64)
    return Workload(np.array(slot, np.int64), np.array(service, np.int64), ends, ends + 1, np.array(lifetime, float))


def most_by_trying(scenario: Scenario, workload: Workload, lifetimes=None) -> int:
    """The largest subset of requests that fits on the VM of node 1 and on the link in every slot."""
    load, rate = scenario.catalogue.load.sum(axis=1), scenario.catalogue.rate
    until = workload.departure
    room, link = scenario.substrate.vm_capacity[1, 0], scenario.substrate.link_capacity[0]
    for size in range(len(workload), 0, -1):
        for chosen in itertools.combinations(range(len(workload)), size):
            picked = np.array(chosen)
            fits = True
            for t in workload.slot[picked]:
                here = picked[(workload.slot[picked] <= t) & (until[picked] > t)]
                kinds = workload.service[here]
                fits &= load[kinds].sum() <= room + 1e-9 and rate[kinds].sum() <= link + 1e-9
            if fits:
                return size
    return 0


def first_come(scenario: Scenario, workload: Workload, lifetime: np.ndarray, refused: tuple[int, ...] = ()):
    """Accepted (bool [R]) by whoever takes what fits, except the types in ``refused`` while over half is in use."""
    load, room = scenario.catalogue.load.sum(axis=1), float(scenario.substrate.vm_capacity[1, 0])
    until = workload.slot + np.maximum(np.ceil(lifetime), 1)
    running: list[tuple[float, float]] = []
    accepted = []
    for t, kind, leaves in zip(workload.slot.tolist(), workload.service.tolist(), until.tolist(), strict=True):
        running = [(end, amount) for end, amount in running if end > t]
        used = sum(amount for _, amount in running)
        accepted.append(used + load[kind] <= room + 1e-9 and not (kind in refused and used > room / 2))
        if accepted[-1]:
            running.append((leaves, load[kind]))
    return np.array(accepted, bool)


def test_hindsight_by_hand():
    """Room for 10. Slot 0: two large for 4 slots and 1 slot fill it; in slot 1 one has left and two small fit."""
    scenario = two_nodes()
    workload = requests((0, LARGE, 3.2), (0, LARGE, 1.0), (0, LARGE, 9.0), (1, SMALL, 5.0), (1, SMALL, 5.0))
    # Keeping the third large instead of the first changes nothing; all three never fit.
    bound = hindsight_bound(scenario, workload)
    assert bound.accepted == 4
    assert bound.aar == pytest.approx(0.8)
    assert (bound.kind, bound.arrived, bound.cuts) == ("hindsight", 5, 0)
    assert most_by_trying(scenario, workload) == 4


def test_a_fraction_of_a_request_is_rounded_down():
    """Room for 9 and two large of 5: the programme takes 1.8 of them."""
    bound = hindsight_bound(two_nodes(vm=9.0), requests((0, LARGE, 4.0), (2, LARGE, 4.0)))
    assert bound.accepted == 1


def test_a_narrow_link_is_found_to_be_scarce():
    """The link has room for two of the three at a time."""
    bound = hindsight_bound(two_nodes(vm=100.0, link=2.5), requests(*[(0, SMALL, 2.0)] * 3, (5, SMALL, 1.0)))
    assert bound.accepted == 3
    assert bound.cuts == 1


def test_blind_by_hand():
    """Room for one. Of two requests in slots 0 and 1 the second fits with 1 - P(the first is still there)."""
    scenario = two_nodes(vm=5.0, mean_lifetime=4.0)
    bound = blind_bound(scenario, requests((0, LARGE, 1.0), (1, LARGE, 1.0)))
    assert bound.accepted == pytest.approx(2.0 - math.exp(-1 / 4.0))
    # A request that comes two slots later meets it with exp(-2 / mu): departure is arrival + ceil(lifetime).
    bound = blind_bound(scenario, requests((0, LARGE, 1.0), (2, LARGE, 1.0)))
    assert bound.accepted == pytest.approx(2.0 - math.exp(-2 / 4.0))
    assert bound.aar == pytest.approx(bound.accepted / 2)


def test_presence_is_the_probability_that_the_blind_bound_assumes():
    """P(departure > arrival + k) = exp(-k / mu) for k = 0, 1, ..., rounding up to whole slots included."""
    rng = np.random.default_rng(0)
    lifetime = rng.exponential(2.5, 200_000)
    stay = requests((0, SMALL, 1.0)).slot[0] + np.maximum(np.ceil(lifetime), 1)
    for k in range(6):
        assert np.mean(stay > k) == pytest.approx(math.exp(-k / 2.5), abs=0.005)


def test_blind_does_not_read_lifetimes_and_hindsight_does():
    scenario = two_nodes(vm=5.0)
    short = requests(*[(t, LARGE, 1.0) for t in range(8)])
    long = requests(*[(t, LARGE, 9.0) for t in range(8)])
    assert blind_bound(scenario, short).accepted == blind_bound(scenario, long).accepted
    assert hindsight_bound(scenario, short).accepted == 8
    assert hindsight_bound(scenario, long).accepted == 1


def test_warmup_and_the_horizon_are_kept_to():
    workload = requests((0, LARGE, 9.0), (1, LARGE, 9.0), (6, LARGE, 9.0), (7, LARGE, 9.0), (8, LARGE, 9.0))
    bound = hindsight_bound(two_nodes(warmup=5), workload)
    assert (bound.accepted, bound.arrived) == (2, 3)
    assert blind_bound(two_nodes(warmup=5), workload).arrived == 3


def test_nothing_arrives_and_nothing_fits():
    empty = hindsight_bound(two_nodes(), requests())
    assert empty.accepted == 0
    assert math.isnan(empty.aar)
    hopeless = two_nodes(vm=4.0)  # large needs 5
    assert hindsight_bound(hopeless, requests((0, LARGE, 1.0), (3, SMALL, 1.0))).accepted == 1
    assert blind_bound(hopeless, requests((0, LARGE, 1.0))).aar == 0


workloads = st.lists(
    st.tuples(st.integers(0, 7), st.sampled_from([SMALL, LARGE]), st.floats(0.1, 9.0)), min_size=1, max_size=9
).map(lambda rows: requests(*sorted(rows)))


@given(workloads, st.floats(2.0, 25.0), st.floats(1.0, 6.0))
def test_no_subset_of_requests_beats_hindsight(workload, vm, link):
    scenario = two_nodes(vm=vm, link=link)
    bound, best = hindsight_bound(scenario, workload), most_by_trying(scenario, workload)
    assert best <= bound.accepted <= len(workload)
    if link >= 6:
        assert first_come(scenario, workload, workload.lifetime).sum() <= best


@given(workloads, st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_any_prices_prove_a_bound(workload, seed, scale):
    """Weak duality: whatever the prices, the certificate is at least the optimum."""
    rng = np.random.default_rng(seed)
    size, slots = len(workload), 10
    demand = np.where(workload.service == LARGE, 5.0, 2.0)[None]
    laws = int(rng.integers(1, 4))
    law = rng.integers(laws, size=size)
    columns = Columns(
        workload.slot, np.minimum(workload.departure, slots), np.ones(size), demand, rng.uniform(0.5, 2.0, size), law
    )
    capacity, keep = rng.uniform(1.0, 12.0, (1, slots)), rng.random((laws, slots))
    if rng.random() < 0.5:
        keep = np.ones((1, slots))
        columns = columns._replace(law=np.zeros(size, np.int64))
    else:
        columns = columns._replace(until=np.full(size, slots))
    optimum = maximise_value(columns, capacity, keep)
    assert optimum.bound == pytest.approx(float(columns.value @ optimum.accepted), abs=1e-6)
    assert certificate(columns, capacity, keep, scale * rng.random((1, slots))) >= optimum.bound - 1e-6


@pytest.mark.parametrize("refused", [(), (LARGE,), (SMALL,)])
def test_the_mean_of_blind_methods_stays_below_the_blind_bound(refused):
    """Monte Carlo over lifetimes, arrivals fixed; no method here looks at them before they end."""
    rng = np.random.default_rng(5)
    slot = np.sort(rng.integers(0, 40, 150))
    service = rng.integers(0, 2, 150)
    workload = requests(*[(int(t), int(k), 1.0) for t, k in zip(slot, service, strict=True)])
    scenario = two_nodes(vm=60.0, link=1000.0, horizon=40, mean_lifetime=12.0)
    bound = blind_bound(scenario, workload).accepted
    got, luck = [], []
    for _ in range(600):
        lived = replace(workload, lifetime=rng.exponential(12.0, 150))
        accepted = first_come(scenario, lived, lived.lifetime, refused)
        got.append(accepted.sum())
        luck.append(lifetime_luck(scenario, lived, accepted))
        assert got[-1] - luck[-1] <= bound + 1e-6, "without its luck no run is above the bound"
    mean, error = np.mean(got), np.std(got) / math.sqrt(len(got))
    assert mean <= bound + 3 * error
    assert abs(np.mean(luck)) <= 4 * np.std(luck) / math.sqrt(len(luck)), "luck is nobody's on average"
    if refused == (LARGE,):
        assert mean >= 0.85 * bound, "the bound is near what a sensible rule reaches"


def test_one_run_may_end_above_the_blind_bound():
    """It bounds expectations: with luck everyone leaves at once."""
    workload = requests(*[(t, LARGE, 0.5) for t in range(10)])
    scenario = two_nodes(vm=5.0, mean_lifetime=50.0)
    accepted = first_come(scenario, workload, workload.lifetime)
    bound = blind_bound(scenario, workload).accepted
    assert accepted.sum() > bound
    assert accepted.sum() - lifetime_luck(scenario, workload, accepted) <= bound + 1e-9


def test_an_interrupted_request_frees_its_resources():
    """The VM fails in slot 2 and is back in slot 3: the first request is interrupted, so a second can be accepted."""
    scenario = two_nodes(vm=5.0, failures=FailureModel(p_fail_vm=0.1, p_repair=0.5))
    workload = requests((0, LARGE, 9.0), (2, LARGE, 9.0), (4, LARGE, 9.0), (5, LARGE, 9.0))
    timeline = FailureTimeline(np.array([2, 3]), np.array([1, 1]), np.array([False, True]))
    assert hindsight_bound(scenario, workload, timeline).accepted == 2
    assert blind_bound(scenario, workload, timeline).accepted == pytest.approx(2.0 + 1.0 - math.exp(-1 / 3.0))
    with pytest.raises(ScenarioError, match="failure timeline"):
        hindsight_bound(scenario, workload)


def play(scenario: Scenario, workload: Workload, timeline: FailureTimeline) -> np.ndarray:
    """Requests, bool [R], that the exact search accepts one by one; plain books, failures included."""
    substrate = scenario.substrate
    tables = build_tables([substrate], scenario.catalogue)
    rules = Rules(scenario.colocation, False, False, scenario.max_steps)
    capacity = np.r_[tables.vm_capacity[0, :, :, 0].ravel(), tables.link_capacity[0]]
    shape, vms = tables.vm_capacity[0, :, :, 0].shape, tables.vm_capacity[0, :, :, 0].size
    offered, up = capacity.copy(), np.ones(capacity.size, bool)
    ends = {(u, v): link for link, (u, v) in enumerate(substrate.links.tolist())}
    planner = MyopicPlanner()
    running: list[tuple[int, np.ndarray]] = []
    accepted, event = np.zeros(len(workload), bool), 0
    for r, t in enumerate(workload.slot.tolist()):
        while event < len(timeline) and timeline.slot[event] <= t:
            up[timeline.resource[event]] = timeline.up[event]
            running = [(end, use) for end, use in running if end > timeline.slot[event] and not use[~up].any()]
            event += 1
        running = [(end, use) for end, use in running if end > t]
        offered = np.where(up, capacity - sum((use for _, use in running), np.zeros_like(capacity)), 0)
        request = int(workload.service[r]), int(workload.ingress[r]), int(workload.egress[r])
        plan = plan_of(planner, Case(tables, rules, offered[:vms].reshape(shape), offered[vms:], *request))
        use, node, placed = np.zeros_like(capacity), request[1], 0
        for action in plan:
            there, vm, place = action // (2 * shape[1]), action // 2 % shape[1], action % 2
            if there != node:
                use[vms + ends[min(node, there), max(node, there)]] += tables.rate_units[request[0], 0]
            if place:
                use[there * shape[1] + vm] += tables.load_units[request[0], placed, 0]
                placed += 1
            node = there
        if plan:
            running.append((int(workload.departure[r]), use))
            accepted[r] = True
    return accepted


@pytest.mark.parametrize("colocation", [False, True])
@pytest.mark.parametrize("fail", [0.0, 0.001])
@pytest.mark.parametrize("link_capacity", [(1600.0, 6400.0), (40.0, 160.0)])
def test_the_exact_search_stays_below_both_bounds(colocation, fail, link_capacity):
    scenario = paper_scenario(
        6,
        3,
        horizon=150,
        arrival_rate=6.0,
        mean_lifetime=100.0,
        colocation=colocation,
        substrate={"target_rho": 2.0, "link_capacity": link_capacity, "vm_capacity": (800.0, 1200.0)},
        services={name: {"chain": chain, "rate": 4.0, "tolerable_delay": 4000.0} for name, chain in CHAINS.items()},
        failures={"p_fail_vm": fail, "p_fail_link": fail, "p_repair": 0.2},
    )
    got, hindsight, blind = [], [], []
    for seed in range(3):
        workload, timeline = scenario.workload(seed), scenario.failure_timeline(seed)
        accepted = play(scenario, workload, timeline)
        got.append(accepted.sum())
        hindsight.append(hindsight_bound(scenario, workload, timeline).accepted)
        blind.append(blind_bound(scenario, workload, timeline).accepted)
        assert got[-1] - lifetime_luck(scenario, workload, accepted, timeline) <= blind[-1] + 1e-6
    assert np.all(np.array(got) <= hindsight)
    assert np.mean(got) <= np.mean(blind)
    if fail == 0.0:
        assert np.mean(hindsight) < 0.99 * np.mean([len(scenario.workload(seed)) for seed in range(3)])


CHAINS = {"light": ["NAT", "FW"], "heavy": ["TM", "IDPS"]}


def test_least_delay_and_cost_are_below_the_exact_searchs():
    for seed, colocation in itertools.product(range(4), (False, True)):
        scenario = paper_scenario(7, seed, colocation=colocation)
        tables = build_tables([scenario.substrate], scenario.catalogue)
        rules = Rules(colocation, False, False, 100)
        planner = MyopicPlanner()
        vms, links = tables.vm_capacity[0, :, :, 0], tables.link_capacity[0]
        for service in range(3):
            cost, delay = least_cost(scenario, service), least_delay(scenario, service)
            for ingress, egress in itertools.permutations(range(7), 2):
                plan = plan_of(planner, Case(tables, rules, vms, links, service, ingress, egress))
                if plan:
                    assert delay[ingress, egress] <= scenario.catalogue.tolerable_delay[service] + 1e-9
                    exact = _cost(scenario, service, ingress, plan)
                    assert cost[ingress, egress] <= exact + 1e-9
                    if service == 0:  # web has time to spare, so only the relaxed rules differ
                        assert cost[ingress, egress] >= 0.8 * exact


def _cost(scenario: Scenario, service: int, node: int, plan: list[int]) -> float:
    substrate, slots, placed, cost = scenario.substrate, scenario.substrate.vm_capacity.shape[1], 0, 0.0
    price = {(u, v): w for (u, v), w in zip(substrate.links.tolist(), substrate.link_unit_cost, strict=True)}
    for action in plan:
        there, vm = action // (2 * slots), action // 2 % slots
        cost += price[min(node, there), max(node, there)] * scenario.catalogue.rate[service] if there != node else 0.0
        if action % 2:
            cost += substrate.vm_unit_cost[there, vm] * scenario.catalogue.load[service, placed]
            placed += 1
        node = there
    return cost


def test_least_cost_at_a_number_by_hand():
    """Small costs 2 * $3 + $7 = 13, large 5 * $3 + $7 = 22; room for 10, so two large or many small."""
    scenario = two_nodes()
    workload = requests(*[(0, LARGE, 5.0)] * 2, *[(0, SMALL, 5.0)] * 3)
    assert hindsight_least_cost(scenario, workload, 3) == pytest.approx(39.0)
    # Four: three small leave room for 4 of the 5 that a large takes, so at most 3.8 are accepted.
    assert hindsight_bound(scenario, workload).accepted == 3
    assert hindsight_least_cost(scenario, workload, 3.5) == pytest.approx(39.0 + 0.5 * 22.0)
    with pytest.raises(ScenarioError, match="cannot be accepted"):
        hindsight_least_cost(scenario, workload, 6)


def test_a_file_has_no_known_law_of_lifetimes(tmp_path):
    scenario = two_nodes()
    path = tmp_path / "trace.csv"
    requests((0, LARGE, 2.0), (1, LARGE, 2.0)).to_csv(path, scenario.catalogue)
    traced = scenario.replace(workload_path=str(path))
    with pytest.raises(ScenarioError, match="mean_lifetime"):
        blind_bound(traced, traced.workload(0))
    assert blind_bound(traced, traced.workload(0), mean_lifetime=3.0).accepted == 2
    assert hindsight_bound(traced, traced.workload(0)).accepted == 2


@pytest.mark.parametrize("nodes", [6, 14])
def test_candidate_cuts(nodes):
    substrate = draw_random_substrate(nodes, 1, mean_degree=2.2)
    cuts = candidate_cuts(substrate)
    assert cuts.any(axis=1).all()
    assert not cuts.all(axis=1).any()
    sides = {tuple(cut) for cut in cuts.tolist()} | {tuple(cut) for cut in (~cuts).tolist()}
    assert all(tuple(node) in sides for node in np.eye(nodes, dtype=bool).tolist())
    if nodes == 6:
        assert len(cuts) == 2**5 - 1


def test_the_timeline_lowers_what_is_there():
    """While a node's VM is down, half of the room is gone."""
    scenario = two_nodes(vm=10.0, failures=FailureModel(p_fail_vm=0.1, p_repair=0.1))
    timeline = FailureTimeline(np.array([1, 4]), np.array([1, 1]), np.array([False, True]))
    workload = requests((1, LARGE, 1.0), (2, SMALL, 1.0), (4, SMALL, 1.0))
    assert hindsight_bound(scenario, workload, timeline).accepted == 1
    assert len(sample_timeline(scenario.failures, scenario.substrate, 10, np.random.default_rng(0))) > 0


def test_the_blind_bound_knows_the_lifetimes_of_services():
    # Of means that are all the same it is what it was; a service that stays shorter leaves room, one that stays longer
    # takes it; and what the scenario says of services with a mean of their own does not matter.
    workload = requests(*[(slot, kind, 1.0) for slot in range(6) for kind in (LARGE, SMALL)])
    plain = two_nodes(mean_lifetime=3.0)
    first, second = plain.catalogue.types

    def bound(mean: float, *own: float | None) -> float:
        types = tuple(replace(kind, mean_lifetime=life) for kind, life in zip((first, second), own, strict=True))
        catalogue = replace(plain.catalogue, types=types)
        return blind_bound(two_nodes(mean_lifetime=mean).replace(catalogue=catalogue), workload).accepted

    usual = bound(3.0, None, None)
    assert bound(99.0, 3.0, 3.0) == pytest.approx(usual)
    shorter, longer = bound(3.0, 1.0, None), bound(3.0, 9.0, None)
    assert longer < usual < shorter
    assert bound(99.0, 1.0, 3.0) == pytest.approx(shorter)
