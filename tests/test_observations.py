"""The parts of the observation on the toy network, worked out on paper, and against slower ways to find the same."""

import heapq
import math
import random
from dataclasses import replace

import numpy as np
import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from reference import ReferenceSimulator, cheapest_walk
from strategies import Instance, catalogues, instances, random_action, substrates
from toy import DUO, SOLO, action

from nfv_torchrl.observations import CandidateObservation, GraphObservation, RequestObservation
from nfv_torchrl.observations.candidates import FEATURES, REQUEST
from nfv_torchrl.observations.costs_to_go import finish_costs, reference_costs
from nfv_torchrl.scenario.services import ServiceCatalogue
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.simulator import Rules, Simulator, build_tables

RULES = Rules(colocation=False, feasible_mask=False, admission_control=False, max_steps=100)
SLOW = toy.toy_catalogue(duo_delay=1e5, solo_delay=1e5)


def simulate(*requests, **changes) -> Simulator:
    simulator = Simulator(toy.toy_scenario(**changes), 1)
    simulator.start(0, toy.workload_of(*requests) if requests else toy.toy_workload())
    return simulator


def play(simulator: Simulator, actions: list[int]) -> None:
    for index in actions:
        simulator.step(np.array([index]))


# ------------------------------------------------------------------------------------------------------- request


def request_of(simulator: Simulator) -> dict:
    return {name: value.tolist() for name, value in RequestObservation().read(simulator)["request"].items()}


def test_request():
    simulator = simulate()
    play(simulator, [action(1, 0, True)])
    assert request_of(simulator) == {
        "service": [DUO],
        "ingress": [0],
        "egress": [3],
        "node": [1],
        "function": [1],
        "rate": [1.0],
        "tolerable_delay": [1050.0],
        "remaining_delay": [1050.0 - 360.0],
    }
    play(simulator, [toy.REJECT, toy.REJECT])
    assert [request_of(simulator)[name] for name in ("service", "ingress", "egress")] == [[SOLO], [3], [0]]
    play(simulator, [toy.REJECT] * 3)
    assert all(value == [0] for value in request_of(simulator).values())


def test_lifetime_is_shown_only_when_asked_for():
    assert "lifetime" not in request_of(simulate())
    assert request_of(simulate(observe_lifetime=True))["lifetime"] == [2.0]


# --------------------------------------------------------------------------------------------------------- graph


def test_graph():
    simulator = simulate()
    play(simulator, [action(1, 0, True)])
    graph = {name: value[0].numpy() for name, value in GraphObservation().read(simulator)["graph"].items()}
    assert {name: value.shape for name, value in graph.items()} == {
        "vms": (4, 2, 4),
        "links": (5, 4),
        "link_ends": (5, 2),
        "nodes": (4, 3),
        "request": (4,),
    }
    # Six VMs of 330 Mcycles/s together, at $16 together: means 55 and 8/3. 1.0: 10 of 40 used, $1.
    assert graph["vms"][1, 0].tolist() == pytest.approx([1, 0.25, 40 / 55, 3 / 8])
    assert graph["vms"][3, 1].tolist() == pytest.approx([1, 0, 80 / 55, 12 / 8])
    assert graph["vms"][0, 1].tolist() == [0, 0, 0, 0]
    # Links at $10 together, mean 2. l0: 1 of 10 used, 110 of 1050 ms.
    assert graph["links"][0].tolist() == pytest.approx([1, 0.1, 110 / 1050, 1])
    assert graph["links"][3].tolist() == pytest.approx([1, 0, 300 / 1050, 2])
    assert graph["link_ends"].tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    # Now at 1, from 0, to 3.
    assert graph["nodes"].T.tolist() == [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    # A duo, one of two functions placed, after 110 + 250 ms.
    assert graph["request"].tolist() == pytest.approx([1, 0, 0.5, 360 / 1050])


def test_graph_of_a_smaller_network_is_padded():
    small = Substrate(
        name="pair",
        labels=("0", "1"),
        vm_count=np.array([1, 1]),
        vm_capacity=np.array([[100.0], [300.0]]),
        vm_unit_cost=np.array([[2.0], [6.0]]),
        links=np.array([[0, 1]]),
        link_capacity=np.array([10.0]),
        link_delay=np.array([5.0]),
        link_unit_cost=np.array([3.0]),
    )
    pairs = np.array([[[0, 1]], [[1, 0]]])
    simulator = Simulator([toy.toy_scenario(), toy.toy_scenario(substrate=small, endpoint_pairs=pairs)], 2)
    simulator.start(0, toy.toy_workload())
    simulator.start(1, toy.workload_of((0, SOLO, 1, 0, 1.0)))
    graph = {name: value[1].numpy() for name, value in GraphObservation().read(simulator)["graph"].items()}
    assert graph["vms"][:, :, 0].tolist() == [[1, 0], [1, 0], [0, 0], [0, 0]]
    assert graph["vms"][:2, 0, 2:].tolist() == [[0.5, 0.5], [1.5, 1.5]]
    assert graph["links"][:, 0].tolist() == [1, 0, 0, 0, 0]
    # Solo: 5 + 1000 * 2 / 10 of 1000 ms.
    assert graph["links"][0].tolist() == pytest.approx([1, 0, 0.205, 1])
    assert graph["nodes"].T.tolist() == [[0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0]]


# ---------------------------------------------------------------------------------------------------- candidates


def rows_of(simulator: Simulator, b: int = 0, request: bool | None = None) -> dict[int, dict[str, float]]:
    """Rows in use by action; checks that they are the mask's actions, each once, and that padding is empty."""
    part = CandidateObservation(request=request)
    candidates = part.read(simulator)["candidates"][b]
    used, reject = candidates["mask"].numpy(), simulator.num_actions - 1
    actions = candidates["action"].numpy()
    assert sorted(actions[used].tolist()) == np.flatnonzero(simulator.world.seen.mask[b]).tolist()
    assert (actions[~used] == reject).all()
    assert not candidates["features"][~candidates["mask"]].any()
    block = REQUEST._fields if part.shape(simulator)[1] > len(FEATURES) + simulator.tables.services else ()
    names = [*FEATURES, *block, *(f"service {kind}" for kind in range(simulator.tables.services))]
    rows = candidates["features"][candidates["mask"]].tolist()
    return {a: dict(zip(names, row, strict=True)) for a, row in zip(actions[used].tolist(), rows, strict=True)}


def duo_reference() -> float:
    """Mean over all pairs of the least cost of a duo on the empty toy network, delay aside."""
    return float(np.mean(list(least_costs(toy.toy_substrate(), SLOW, DUO, False)[0].values())))


def test_candidate_of_the_first_step():
    simulator = simulate()
    row, mean = rows_of(simulator)[action(1, 0, True)], duo_reference()
    # A at 1.0 for $10 and $2. B then costs least at 3.0: $20 and two hops, $1 and $2. Loads are 10 and 20 Mcycles/s.
    assert row == pytest.approx(
        {
            "reject": 0,
            "place": 1,
            "stay": 0,
            "arrives": 0,
            "passes": 1,
            "step_cost": 12 / mean,
            "cost_to_go": 23 / mean,
            "vm_use": 10 / 40,
            "vm_demand": 10 / 40,
            "node_use": 10 / 140,
            "link_use": 1 / 10,
            "link_demand": 1 / 10,
            "elapsed": 360 / 1050,
            "delay_to_go": 185 / 1050,
            "slack": (1050 - 360 - 185) / 1050,
            "functions_left": 1 / 2,
            "load_left": 20 / 30,
            "network_vm_use": 0,
            "network_link_use": 0,
            "service 0": 1,
            "service 1": 0,
        },
        abs=1e-6,
    )


def test_candidates_of_a_later_step():
    simulator = simulate()
    play(simulator, [action(1, 0, True)])
    rows, mean = rows_of(simulator), duo_reference()
    forward = rows[action(3)]
    # Straight to the egress, nothing placed: B there costs least at 3.0. 300 ms and $4 over l3, 1 of its 4 Mbit/s.
    assert {name: forward[name] for name in ("place", "arrives", "functions_left", "vm_demand")} == {
        "place": 0,
        "arrives": 1,
        "functions_left": 0.5,
        "vm_demand": 0,
    }
    named = ("step_cost", "cost_to_go", "elapsed", "delay_to_go", "link_use", "network_vm_use", "network_link_use")
    assert [forward[name] for name in named] == pytest.approx(
        [4 / mean, 20 / mean, 660 / 1050, 0, 0.25, 10 / 330, 1 / 49]
    )
    # B at 3.0 takes 1000 ms more: it does not pass, and the row says so.
    assert [rows[action(3, vm, True)]["passes"] for vm in (0, 1)] == [0, 1]
    assert rows[action(3, 1, True)]["cost_to_go"] == 0
    assert rows[action(3, 0, True)]["slack"] < 0


def test_candidate_that_stays():
    simulator = simulate(colocation=True)
    row = rows_of(simulator)[action(0, 0, True)]
    # A at 0.0 without a hop: $30, 250 ms. B then costs least at 3.0: $20 and two hops by 2, $1 and $2.
    named = ("stay", "link_use", "link_demand", "vm_use", "elapsed")
    assert [row[name] for name in named] == pytest.approx([1, 0, 0, 0.25, 250 / 1050])
    assert row["cost_to_go"] / row["step_cost"] == pytest.approx(23 / 30)


def test_reject_and_the_end_have_rows_of_their_own():
    simulator = simulate(admission_control=True)
    row = rows_of(simulator)[toy.REJECT]
    assert {name for name, value in row.items() if value} == {"reject", "service 0"}
    play(simulator, [toy.REJECT] * 5)
    (only,) = rows_of(simulator).values()
    assert {name for name, value in only.items() if value} == {"reject"}


def asked(simulator: Simulator, request: bool | None = None) -> dict[str, float]:
    """The columns on the request itself, which all rows share."""
    rows = rows_of(simulator, request=request).values()
    (told,) = {tuple((name, row[name]) for name in REQUEST._fields) for row in rows}
    return dict(told)


def test_rows_tell_what_a_request_asks_for_where_lifetimes_are_seen():
    """A duo takes 30 of 330 Mcycles/s and a solo 20, 25 on average, at 1 and 2 Mbit/s; lifetimes are 2 s on average."""
    simulator = simulate(observe_lifetime=True, admission_control=True)
    duo = {
        "lifetime": math.log(2),
        "load": math.log(30 / 25) / 2,
        "share": 30 / 330,
        "rate": math.log(1 / 1.5) / 2,
        "length": 1,
    }
    assert asked(simulator) == pytest.approx(duo)
    play(simulator, toy.DUO_0_TO_3[2])
    assert asked(simulator) == pytest.approx({**duo, "lifetime": math.log(1.75), "share": 30 / 300})
    play(simulator, [toy.REJECT])
    solo = {"lifetime": math.log(1.1), "load": math.log(20 / 25) / 2, "share": 20 / 300, "rate": math.log(2 / 1.5) / 2}
    assert asked(simulator) == pytest.approx({**solo, "length": 0.5})


def test_elsewhere_they_are_there_for_whoever_asks():
    simulator = simulate()
    assert not set(REQUEST._fields) & set(rows_of(simulator)[action(1)])
    assert asked(simulator, request=True)["lifetime"] == pytest.approx(math.log(2))
    assert not set(REQUEST._fields) & set(rows_of(simulate(observe_lifetime=True), request=False)[action(1)])


def least_costs(
    substrate: Substrate, catalogue: ServiceCatalogue, service: int, colocation: bool
) -> list[dict[tuple[int, int], float]]:
    """Least cost from (node, egress) for each number of functions placed, by Dijkstra backwards over whole states."""
    kind = catalogue.types[service]
    loads = [catalogue.vnfs[name] * kind.rate for name in kind.chain]
    cheapest = [float(substrate.vm_unit_cost[n, : substrate.vm_count[n]].min()) for n in range(substrate.num_nodes)]
    hops = {}
    for (u, v), cost in zip(substrate.links.tolist(), substrate.link_unit_cost.tolist(), strict=True):
        hops.setdefault(u, []).append((v, cost * kind.rate))
        hops.setdefault(v, []).append((u, cost * kind.rate))

    def moves(state, egress):
        node, done = state
        place = cheapest[node] * loads[done] if done < len(loads) else math.inf
        if node == egress or colocation:
            yield (node, done + 1), place
        if node != egress:
            for near, cost in hops[node]:
                yield (near, done), cost
                if done < len(loads):
                    yield (near, done + 1), cost + cheapest[near] * loads[done]

    def search(start, egress):
        seen, queue = set(), [(0.0, start)]
        while queue:
            cost, state = heapq.heappop(queue)
            if state == (egress, len(loads)):
                return cost
            if state not in seen:
                seen.add(state)
                for after, step in moves(state, egress):
                    if step < math.inf:
                        heapq.heappush(queue, (cost + step, after))
        raise AssertionError("the network is connected")

    nodes = range(substrate.num_nodes)
    return [
        {(a, b): search((a, done), b) for a in nodes for b in nodes if a != b or done} for done in range(len(loads) + 1)
    ]


@given(substrates(max_nodes=5), catalogues(max_types=2), st.booleans())
def test_costs_to_go(substrate, catalogue, colocation):
    tables = build_tables([substrate], catalogue)
    costs = finish_costs(tables, RULES._replace(colocation=colocation))
    references = reference_costs(tables, costs)
    for service, kind in enumerate(catalogue.types):
        expected = least_costs(substrate, catalogue, service, colocation)
        for done in range(len(kind.chain) + 1):
            for (node, egress), cost in expected[done].items():
                assert costs[0, service, done, node, egress] == pytest.approx(cost)
        assert references[0, service] == pytest.approx(np.mean(list(expected[0].values())))


@pytest.mark.parametrize("colocation", [False, True])
def test_costs_to_go_are_those_of_the_cheapest_walks(colocation):
    # Where no limit binds, the least cost of a request is that of the walk found by trying them all. Five steps do.
    substrate = replace(toy.toy_substrate(), vm_capacity=10 * toy.toy_substrate().vm_capacity)
    scenario = toy.toy_scenario(substrate=substrate, catalogue=SLOW, colocation=colocation, max_steps=5)
    costs = finish_costs(build_tables([substrate], SLOW), RULES._replace(colocation=colocation))
    for service, ingress, egress in [(DUO, 0, 3), (DUO, 1, 3), (DUO, 3, 1), (SOLO, 3, 0), (SOLO, 2, 0), (SOLO, 0, 1)]:
        reference = ReferenceSimulator(scenario, toy.workload_of((0, service, ingress, egress, 1.0)))
        assert costs[0, service, 0, ingress, egress] == pytest.approx(cheapest_walk(reference)[0])


@given(instances(), st.integers(0, 2**32))
def test_rows_say_what_happens_next(instance: Instance, seed: int):
    simulator, rng = Simulator(instance.scenario, 1), random.Random(seed)
    simulator.start(0, instance.workload, instance.timeline)
    while not simulator.world.env["done"][0]:
        rows = rows_of(simulator)
        chosen = random_action(simulator.world.seen.mask[0].tolist(), rng, invalid=0)
        e = simulator.world.env[0].copy()
        scale = CandidateScale(simulator, int(e["service"]))
        simulator.step(np.array([chosen]))
        outcome = {name: value[0] for name, value in simulator.outcome.items()}
        row = rows[chosen]
        assert row["passes"] == outcome["passed"]
        if outcome["passed"]:
            assert row["step_cost"] * scale.cost == pytest.approx(outcome["step_cost"], rel=1e-5)
            if outcome["accepted"]:
                assert row["elapsed"] * scale.delay == pytest.approx(outcome["request_delay"], rel=1e-5)
                assert (row["functions_left"], row["arrives"], row["cost_to_go"]) == (0, 1, 0)
            else:
                now = simulator.world.env[0]
                assert row["elapsed"] * scale.delay == pytest.approx(now["elapsed"], rel=1e-5)
                assert row["arrives"] == (now["node"] == now["egress"])
                node, vm = now["node"], now["last_vm"]
                # What the row foretold is what the flat observation shows afterwards, rounded down to a thousandth.
                shown = simulator.world.seen.flat[0].reshape(-1)[node * simulator.tables.vm_capacity.shape[2] + vm]
                assert shown - 1e-6 <= row["vm_use"] < shown + 0.001 + 1e-6


class CandidateScale:
    """What the relative features of a service are relative to."""

    def __init__(self, simulator: Simulator, service: int) -> None:
        costs = finish_costs(simulator.tables, simulator.world.rules)
        self.cost = reference_costs(simulator.tables, costs)[0, service]
        self.delay = simulator.tables.tolerable_delay[service]
