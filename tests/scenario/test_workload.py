"""Workloads: the samplers' statistics, what depends on what, and CSV files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from toy import workload_of

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.scenario.topology_zoo import read_topology
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator


def assert_same(one: Workload, other: Workload) -> None:
    for field in dataclasses.fields(Workload):
        expected, actual = getattr(one, field.name), getattr(other, field.name)
        if expected is None:
            assert actual is None
            continue
        assert actual.dtype == expected.dtype
        np.testing.assert_array_equal(actual, expected, err_msg=field.name)


def test_departures_by_hand():
    """At least one slot, then whole slots: 0.2 s leave after one, 1.0 s after one, 1.01 s after two."""
    workload = workload_of((0, 0, 0, 3, 0.2), (4, 0, 0, 3, 1.0), (4, 0, 0, 3, 1.01), (5, 0, 0, 3, 1e300))
    assert workload.departure[:3].tolist() == [1, 5, 6]
    assert workload.departure[3] > 10**9


# ---------------------------------------------------------------- sampling


@pytest.mark.parametrize("endpoints", ["catalogue", "uniform"])
def test_statistics(endpoints):
    """20 horizons of 1,000 slots: 200,000 requests, so means lie within a percent of what they should be."""
    scenario = paper_scenario(endpoints=endpoints)
    draws = [scenario.workload(seed) for seed in range(20)]
    counts = np.concatenate([np.bincount(draw.slot, minlength=1000) for draw in draws])
    assert counts.mean() == pytest.approx(10, rel=0.01)
    assert np.bincount(counts, minlength=21) / len(counts) == pytest.approx(np.full(21, 1 / 21), rel=0.15)
    lifetimes = np.concatenate([draw.lifetime for draw in draws])
    assert lifetimes.mean() == pytest.approx(600, rel=0.01)
    assert lifetimes.std() == pytest.approx(600, rel=0.02)
    assert np.exp(-lifetimes / 600).mean() == pytest.approx(0.5, rel=0.01)
    services = np.concatenate([draw.service for draw in draws])
    assert np.bincount(services) / len(services) == pytest.approx(np.full(3, 1 / 3), rel=0.02)
    for draw in draws:
        assert np.all(np.diff(draw.slot) >= 0)
        assert draw.slot.max() < 1000
        assert np.all(draw.ingress != draw.egress)
        assert draw.slot.dtype == draw.service.dtype == draw.ingress.dtype == draw.egress.dtype == np.int64


def test_catalogue_endpoints_are_the_services_pairs_evenly():
    scenario = paper_scenario()
    draw = scenario.workload(0)
    for service, pairs in enumerate(scenario.endpoint_pairs):
        mine = draw.service == service
        drawn = np.stack([draw.ingress[mine], draw.egress[mine]], axis=1)
        unique, counts = np.unique(drawn, axis=0, return_counts=True)
        assert sorted(map(tuple, unique.tolist())) == sorted(map(tuple, pairs.tolist()))
        assert counts / counts.sum() == pytest.approx(np.full(10, 0.1), rel=0.25)


def test_uniform_endpoints_are_all_pairs_evenly():
    scenario = paper_scenario(nodes=4, endpoints="uniform")
    draw = scenario.workload(0)
    codes, counts = np.unique(draw.ingress * 4 + draw.egress, return_counts=True)
    assert len(codes) == 12
    assert counts / counts.sum() == pytest.approx(np.full(12, 1 / 12), rel=0.15)


def test_weights():
    scenario = toy.toy_scenario(arrival_rate=500.0)
    types = tuple(
        dataclasses.replace(service, weight=weight)
        for service, weight in zip(scenario.catalogue.types, (3.0, 1.0), strict=True)
    )
    draw = scenario.replace(catalogue=dataclasses.replace(scenario.catalogue, types=types)).workload(1)
    assert np.bincount(draw.service)[0] / len(draw) == pytest.approx(0.75, abs=0.03)
    none = tuple(dataclasses.replace(service, weight=w) for service, w in zip(types, (1.0, 0.0), strict=True))
    draw = scenario.replace(catalogue=dataclasses.replace(scenario.catalogue, types=none)).workload(1)
    assert set(draw.service.tolist()) == {0}


def test_golden_requests_of_seed_0():
    """Another draw would change every published number."""
    workload = paper_scenario().workload(0)
    assert len(workload) == 9952
    first = list(zip(workload.slot[:4].tolist(), workload.service[:4].tolist(), strict=True))
    assert first == [(0, 2), (0, 2), (0, 1), (0, 1)]
    assert workload.ingress[:4].tolist() == [5, 9, 9, 4]
    assert workload.egress[:4].tolist() == [3, 1, 8, 1]
    np.testing.assert_allclose(
        workload.lifetime[:4], [1211.1629100301564, 1196.7363112075693, 714.9672857845193, 485.7860421344863]
    )


def test_seed_and_key_decide_and_nothing_else():
    scenario = paper_scenario(horizon=50)
    assert_same(scenario.workload(3), scenario.workload(3))
    assert_same(scenario.workload(3, 1, 2), paper_scenario(horizon=50, colocation=True).workload(3, 1, 2))
    lengths = {len(scenario.workload(*seed)) for seed in ((3,), (4,), (3, 0), (3, 1), (3, 1, 0))}
    assert len(lengths) > 1


def test_a_longer_horizon_continues_the_same_arrivals():
    short, long = (paper_scenario(horizon=horizon, endpoints="uniform").workload(7) for horizon in (100, 300))
    for field in dataclasses.fields(Workload):
        if getattr(short, field.name) is not None:
            np.testing.assert_array_equal(getattr(short, field.name), getattr(long, field.name)[: len(short)])


def test_one_setting_leaves_the_other_draws_alone():
    base = paper_scenario(horizon=100).workload(7)
    longer = paper_scenario(horizon=100, mean_lifetime=1200).workload(7)
    np.testing.assert_allclose(longer.lifetime, 2 * base.lifetime)
    np.testing.assert_array_equal(longer.ingress, base.ingress)
    elsewhere = paper_scenario(horizon=100, nodes=30, endpoints="uniform").workload(7)
    for field in ("slot", "service", "lifetime"):
        np.testing.assert_array_equal(getattr(elsewhere, field), getattr(base, field))


def test_a_horizon_of_one_slot_may_be_empty():
    scenario = paper_scenario(horizon=1, arrival_rate=0.5)
    sizes = {len(scenario.workload(seed)) for seed in range(20)}
    assert sizes == {0, 1}


# ---------------------------------------------------------------- files

lifetimes = st.floats(min_value=5e-324, max_value=1e300)


@st.composite
def toy_workloads(draw) -> Workload:
    requests = st.tuples(st.integers(0, 5), st.integers(0, 1), st.integers(0, 3), st.integers(1, 3), lifetimes)
    rows = sorted(draw(st.lists(requests, min_size=1, max_size=20)), key=lambda row: row[0])
    return workload_of(*((slot, kind, here, (here + step) % 4, life) for slot, kind, here, step, life in rows))


@given(workload=toy_workloads())
def test_csv_round_trip(workload, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "workload.csv"
    workload.to_csv(path, toy.toy_catalogue())
    assert_same(workload, Workload.from_csv(path, toy.toy_catalogue(), toy.toy_substrate(), 6))


def test_sampled_workload_survives_its_file(tmp_path):
    scenario = paper_scenario()
    scenario.workload(0).to_csv(tmp_path / "w.csv", scenario.catalogue)
    again = Workload.from_csv(tmp_path / "w.csv", scenario.catalogue, scenario.substrate, 1000)
    assert_same(scenario.workload(0), again)
    from_file = paper_scenario(workload={"path": tmp_path / "w.csv"})
    assert_same(from_file.workload(5), scenario.workload(0))


def test_the_file_by_hand(tmp_path):
    toy.toy_workload().to_csv(tmp_path / "w.csv", toy.toy_catalogue())
    lines = (tmp_path / "w.csv").read_text().splitlines()
    assert lines[:3] == ["slot,service,ingress_index,egress_index,lifetime", "0,duo,0,3,2.0", "0,duo,0,3,1.5"]


def test_spreadsheets_write_it_a_little_differently(tmp_path):
    text = '\ufeffslot, service,ingress,egress,lifetime\r\n0,"duo", 0,3,2\r\n\r\n3,solo,3,0,1e1\r\n'
    (tmp_path / "w.csv").write_bytes(text.encode())
    workload = Workload.from_csv(tmp_path / "w.csv", toy.toy_catalogue(), toy.toy_substrate(), 6)
    assert_same(workload, workload_of((0, 0, 0, 3, 2.0), (3, 1, 3, 0, 10.0)))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0,duo,0,3", "line 3: has 4 fields"),
        ("0,duo,0,3,1.0,9", "line 3: has 6 fields"),
        ("6,duo,0,3,1.0", r"line 3: slot 6 is outside 0 .. 5; .* horizon"),
        ("-1,duo,0,3,1.0", "line 3: slot -1 is outside"),
        ("1.5,duo,0,3,1.0", "line 3: slot is '1.5'; use an integer"),
        ("0,duo,0,3,1.0", "line 3: slot 0 follows 1; sort"),
        ("1,trio,0,3,1.0", r"line 3: unknown service 'trio'; .* \['duo', 'solo'\]"),
        ("1,duo,0,4,1.0", r"line 3: egress: unknown node '4'; the substrate's nodes are 0 .. 3"),
        ("1,duo,-1,3,1.0", "line 3: ingress: unknown node '-1'"),
        ("1,duo,x,3,1.0", "line 3: ingress: unknown node 'x'"),
        (f"1,duo,{'x' * 1000},3,1.0", "line 3: ingress: 'x{50,100}... is no node"),
        ("1,duo,,3,1.0", "line 3: ingress: unknown node ''"),
        ("1e3,duo,0,3,1.0", "line 3: slot is '1e3'; use an integer"),
        ("1_0,duo,0,3,1.0", "line 3: slot is '1_0'; use an integer"),
        ('"1,000",duo,0,3,1.0', "line 3: slot is '1,000'; use an integer"),
        ("\uff11,duo,0,3,1.0", "line 3: slot is '\uff11'; use an integer"),
        (f"{'9' * 5000},duo,0,3,1.0", "line 3: slot is '9{50,100}...; use an integer"),
        ("1;duo;0;3;1.0", "line 3: has 1 fields; .* separated by commas"),
        ('1,"duo,0,3,1.0', "line 3: is not CSV"),
        ('1,duo,0,3,"1,0"', "line 3: lifetime '1,0'"),
        ("1,duo,0,3,1e400", "line 3: lifetime '1e400'"),
        ("1,duo,0,3,1_0", "line 3: lifetime '1_0'"),
        ("1,duo,0,3,0", "line 3: lifetime '0'; use a positive number"),
        ("1,duo,0,3,-2", "line 3: lifetime '-2'"),
        ("1,duo,0,3,nan", "line 3: lifetime 'nan'"),
        ("1,duo,0,3,inf", "line 3: lifetime 'inf'"),
        ("1,duo,0,3,long", "line 3: lifetime 'long'"),
    ],
)
def test_refuses_a_line(tmp_path, line, message):
    (tmp_path / "w.csv").write_text(f"slot,service,ingress,egress,lifetime\n1,duo,0,3,1.0\n{line}\n")
    with pytest.raises(ScenarioError, match=f"w.csv, {message}"):
        Workload.from_csv(tmp_path / "w.csv", toy.toy_catalogue(), toy.toy_substrate(), 6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "w.csv, line 1: the header must be slot,service,ingress,egress,lifetime; 'slot' is missing"),
        ("0,duo,0,3,1.0\n", "w.csv, line 1: the header must be .*; '0' is there twice"),
        (
            "slot;service;ingress;egress;lifetime\n0;duo;0;3;1\n",
            "header .* separated by ';': export the file with commas",
        ),
        ("slot\tservice\tingress\tegress\tlifetime\n", "header .* separated by tabs"),
        ("slot,service,ingress,egress\n", "header .*; 'lifetime' is missing: add it"),
        ("slot,service,ingress,egress,lifetime,slot\n", "header .*; 'slot' is there twice: remove one"),
        ("slot,service,ingress,egress,lifetime,rate\n", "header .*; 'rate' is unknown: remove that column"),
        ("Slot,service,ingress,egress,lifetime\n", "header .*; 'Slot' is unknown: did you mean 'slot'"),
        ("slot,service,ingress_index,egress,lifetime\n", "header .*; 'egress_index' is missing|'ingress' is missing"),
        (
            "slot,service,ingress,egress,ingress_index,egress_index,lifetime\n",
            "header .*; nodes are named by .* not by both",
        ),
        ("slot,service,ingress,egress,lifetime\n", "w.csv: holds no requests"),
    ],
)
def test_refuses_a_file(tmp_path, text, message):
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(ScenarioError, match=message):
        Workload.from_csv(tmp_path / "w.csv", toy.toy_catalogue(), toy.toy_substrate(), 6)


# ---------------------------------------------------------------- names of nodes

ONE_BASED = """graph [
  node [ id 1 label "A" ]
  node [ id 2 label "B" ]
  node [ id 3 label "C" ]
  node [ id 4 label "3" ]
  edge [ source 1 target 2 ]
  edge [ source 2 target 3 ]
  edge [ source 3 target 4 ]
]"""


def read_on_one_based(folder, text: str) -> Workload:
    (folder / "net.gml").write_text(ONE_BASED)
    (folder / "w.csv").write_text(text)
    substrate = read_topology(folder / "net.gml", 0)
    return Workload.from_csv(folder / "w.csv", toy.toy_catalogue(), substrate, 6)


@pytest.mark.parametrize(("ends", "pair"), [("1,2", (0, 1)), ("A,B", (0, 1)), (" 4 , C", (3, 2)), ('"A",4', (0, 3))])
def test_nodes_are_named_as_their_file_does(tmp_path, ends, pair):
    """The file's ids start at 1: a request from 1 to 2 runs from A to B, never from B to C."""
    workload = read_on_one_based(tmp_path, f"slot,service,ingress,egress,lifetime\n0,duo,{ends},5\n")
    assert (workload.ingress[0], workload.egress[0]) == pair


def test_indices_say_so_in_the_header(tmp_path):
    workload = read_on_one_based(tmp_path, "slot,service,ingress_index,egress_index,lifetime\n0,duo,1,2,5\n")
    assert (workload.ingress[0], workload.egress[0]) == (1, 2)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ("0,1", "line 2: ingress: unknown node '0'; use an id of the substrate's file"),
        ("A,3", "line 2: egress: node '3': is the id of node 'C' and the label of the node with id '4'"),
        ("a,2", "line 2: ingress: unknown node 'a'"),
    ],
)
def test_refuses_nodes_that_the_file_does_not_name_or_names_twice(tmp_path, ends, message):
    with pytest.raises(ScenarioError, match=message):
        read_on_one_based(tmp_path, f"slot,service,ingress,egress,lifetime\n0,duo,{ends},5\n")


@pytest.mark.parametrize("index", ["-1", "4", "A", "1.0"])
def test_refuses_an_index_that_is_none(tmp_path, index):
    with pytest.raises(ScenarioError, match=f"line 2: egress: unknown node index '{index}'"):
        read_on_one_based(tmp_path, f"slot,service,ingress_index,egress_index,lifetime\n0,duo,0,{index},5\n")


def test_columns_in_another_order(tmp_path):
    workload = read_on_one_based(tmp_path, "egress,ingress,lifetime,slot,service\n2,1,5,0,solo\n")
    assert_same(workload, workload_of((0, 1, 0, 1, 5.0)))


names = st.text(st.characters(exclude_characters="/"), min_size=1, max_size=20).filter(
    lambda name: name.isprintable() and name == name.strip()
)


@given(workload=toy_workloads(), pair=st.lists(names, min_size=2, max_size=2, unique=True))
def test_round_trip_with_odd_names(workload, pair, tmp_path_factory):
    """Quotes, commas, semicolons, hashes, any script: what a service may be called comes back from the file."""
    types = [dataclasses.replace(kind, name=name) for kind, name in zip(toy.toy_catalogue().types, pair, strict=True)]
    try:
        catalogue = dataclasses.replace(toy.toy_catalogue(), types=tuple(types))
    except ScenarioError:
        return  # two names of one tag
    path = tmp_path_factory.mktemp("csv") / "workload.csv"
    workload.to_csv(path, catalogue)
    assert_same(workload, Workload.from_csv(path, catalogue, toy.toy_substrate(), 6))


# ---------------------------------------------------------------- from Python


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slot": [1, 0]}, "never decrease"),
        ({"slot": [-1, 0]}, "0 or more"),
        ({"slot": [0.5, 1.0]}, "slot is float64"),
        ({"service": [0]}, r"service is int64 \[1\]; use int64 \[R\]"),
        ({"ingress": [-2, 0]}, "indices from 0; a free end is -1"),
        ({"lifetime": [1.0, np.nan]}, "a lifetime is not a positive"),
        ({"lifetime": [1.0, 0.0]}, "a lifetime is not a positive"),
        ({"lifetime": ["1", "2"]}, "lifetime is <U1"),
    ],
)
def test_refuses_requests_from_python(changes, message):
    columns = {"slot": [0, 1], "service": [0, 1], "ingress": [0, 0], "egress": [3, 3], "lifetime": [1.0, 2.0]}
    with pytest.raises(ScenarioError, match=message):
        Workload(**{name: np.array(column) for name, column in {**columns, **changes}.items()})


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((0, 2, 0, 3, 1.0), "service 2 is outside 0 .. 1"),
        ((0, 0, 0, 4, 1.0), "node 4 is outside 0 .. 3"),
        ((6, 0, 0, 3, 1.0), "slot 6 is outside 0 .. 5"),
    ],
)
def test_a_simulator_refuses_requests_of_another_scenario(row, message):
    """Before the compiled kernels, which would index past their arrays."""
    simulator = Simulator(toy.toy_scenario(horizon=6), 1)
    with pytest.raises(ScenarioError, match=message):
        simulator.start(0, workload_of(row))


def test_refuses_a_missing_file():
    with pytest.raises(ScenarioError, match=r"nowhere.csv: no such file"):
        paper_scenario(workload={"path": "nowhere.csv"})
