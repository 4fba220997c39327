"""No two different requests look alike, in none of the observations."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
import toy
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import Instance, general_instances
from tensordict import TensorDict

from nfv_torchrl.observations import CandidateObservation, GraphObservation, RequestObservation
from nfv_torchrl.observations.base import read_observation
from nfv_torchrl.plans.menus import Menus
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator

KEYS = {"request": RequestObservation, "graph": GraphObservation, "candidates": CandidateObservation}


def look(scenario: Scenario, workload: Workload, rows: list[int], one_hot: bool = False) -> Simulator:
    """Environments on the empty network that are at one each of the requests ``rows``."""
    simulator = Simulator(scenario, len(rows), one_hot=one_hot)
    for b, row in enumerate(rows):
        part = slice(row, row + 1)
        columns = ("slot", "service", "ingress", "egress", "lifetime", "profile")
        simulator.start(b, replace(workload, **{name: getattr(workload, name)[part] for name in columns}, time=None))
    return simulator


def alike(seen: TensorDict, key: str) -> list[tuple[int, int]]:
    """Pairs of environments with the same numbers under ``key``."""
    values = seen[key]
    flat = [values] if isinstance(values, torch.Tensor) else list(values.values(True, True))
    flat = [value.reshape(len(value), -1) for value in flat]
    return [(a, b) for a, b in combinations(range(seen.batch_size[0]), 2) if all(torch.equal(x[a], x[b]) for x in flat)]


def what(workload: Workload, row: int) -> tuple[int, ...]:
    """What tells a request from others, but for its lifetime, which is hidden."""
    return tuple(int(getattr(workload, name)[row]) for name in ("service", "profile", "ingress", "egress"))


def different(workload: Workload) -> list[int]:
    """One request of each kind."""
    return sorted({what(workload, row): row for row in range(len(workload))}.values())


@given(general_instances(max_requests=8))
def test_flat_request_and_graph(instance: Instance):
    scenario, workload, _ = instance
    rows = different(workload)
    assume(len(rows) > 1)
    for one_hot in (False, True):
        simulator = look(scenario, workload, rows, one_hot)
        seen = read_observation(simulator, [RequestObservation(), GraphObservation()])
        for key in ("observation", "request", "graph"):
            assert alike(seen, key) == [], (key, one_hot)


@st.composite
def drawn_scenarios(draw) -> Scenario:
    """Random networks whose numbers have all their digits, and services that draw what they ask for, or do not."""
    services = {
        "a": {"chain": ["NAT", "FW"], "rate": [0.5, 3], "tolerable_delay": [60, 400]},
        "b": {"chain": ["NAT", "FW"], "rate": 2, "tolerable_delay": [60, 400]},
        "c": {"chain": ["TM"], "rate": [0.5, 3], "tolerable_delay": 300},
    }
    if draw(st.booleans()):
        services = {name: {**kind, "rate": 1.5, "tolerable_delay": 200} for name, kind in services.items()}
    changes = {"endpoints": draw(st.sampled_from(["catalogue", "uniform"])), "mask": "adjacency"}
    changes |= {"pairs_per_service": 3, "horizon": 3, "arrival_rate": 4, "colocation": draw(st.booleans())}
    return paper_scenario(draw(st.integers(3, 7)), seed=draw(st.integers(0, 99)), services=services, **changes)


@settings(max_examples=15)
@given(drawn_scenarios(), st.integers(0, 1000))
def test_all_of_them_where_rates_and_delays_are_drawn(scenario: Scenario, seed: int):
    workload = scenario.workload(seed)
    rows = different(workload)
    assume(len(rows) > 1)
    for one_hot in (False, True):
        simulator = look(scenario, workload, rows, one_hot)
        seen = read_observation(simulator, [part() for part in KEYS.values()])
        for key in ("observation", *KEYS):
            assert alike(seen, key) == [], (key, one_hot)
    menus = Menus()
    menus.prepare(simulator.world)
    menus.make(simulator.world, np.arange(len(rows)))
    assert alike(TensorDict({"menu": torch.from_numpy(menus.flat)}, [len(rows)]), "menu") == []


def test_lifetimes_that_are_seen():
    shown = toy.toy_scenario(observe_lifetime=True)
    workload = toy.workload_of((0, toy.DUO, 0, 3, 1.0), (0, toy.DUO, 0, 3, 1.01), (0, toy.DUO, 0, 3, 500.0))
    seen = read_observation(look(shown, workload, [0, 1, 2]), [RequestObservation(), CandidateObservation()])
    assert alike(seen, "request") == alike(seen, "candidates") == []


def test_the_ends_by_hand():
    # Duos from 0 to 3 and from 0 to 2 were one observation: node 0, no VM, nothing placed. Now 0, 1 and 0, 2/3 follow.
    uniform = toy.toy_scenario(endpoints="uniform", endpoint_pairs=None)
    workload = toy.workload_of((0, toy.DUO, 0, 3, 1.0), (0, toy.DUO, 0, 2, 1.0))
    flat = look(uniform, workload, [0, 1]).world.seen.flat
    assert flat.shape[1] == 8 + 5 + 5 + 2
    assert flat[:, -2:].tolist() == [[0, 1], [0, pytest.approx(2 / 3)]]
    # The service of the catalogue tells both ends, and one-hot features the egress: there all is as it was.
    assert look(toy.toy_scenario(), workload, [0]).world.seen.flat.shape[1] == 8 + 5 + 5
    assert look(uniform, workload, [0], one_hot=True).world.seen.flat.shape[1] == 8 + 5 + 5 + 2 + 4 + 4 + 3


def test_a_file_with_pairs_of_its_own(tmp_path):
    path = tmp_path / "requests.csv"
    settings = {"horizon": 3, "workload": {"path": str(path)}}
    pairs = paper_scenario(5, horizon=3).endpoint_pairs
    for ends, open_pairs in [(pairs[0, 0], False), ((0, 0), True)]:
        path.write_text(f"slot,service,ingress_index,egress_index,lifetime\n0,web,{ends[0]},{ends[1]},5\n")
        assert paper_scenario(5, **settings).open_pairs is open_pairs
