"""The substrate: its checks, and files that give back what was written to the bit."""

from __future__ import annotations

import dataclasses
import json

import networkx as nx
import numpy as np
import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from strategies import substrates

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.units import quantise, to_ledger


def assert_same(one: Substrate, other: Substrate) -> None:
    for field in dataclasses.fields(Substrate):
        expected, actual = getattr(one, field.name), getattr(other, field.name)
        if isinstance(expected, np.ndarray):
            assert actual.dtype == expected.dtype
            np.testing.assert_array_equal(actual, expected, err_msg=field.name)
        else:
            assert actual == expected, field.name


def test_sizes_of_the_toy():
    substrate = toy.toy_substrate()
    assert (substrate.num_nodes, substrate.num_links, substrate.max_vms) == (4, 5, 2)
    assert substrate.total_vm_capacity == 40 + 40 + 100 + 50 + 20 + 80


def test_arrays_are_read_only_and_not_the_callers():
    capacity = np.full(5, 10.0)
    substrate = dataclasses.replace(toy.toy_substrate(), link_capacity=capacity)
    capacity[0] = 99.0
    assert substrate.link_capacity[0] == 10.0
    with pytest.raises(ValueError, match="read-only"):
        substrate.link_capacity[0] = 5.0


@given(st.floats(0, 1e9))
def test_quantise_is_idempotent_and_agrees_with_the_ledger(amount):
    once = quantise(amount)
    assert quantise(once) == once
    assert to_ledger(once) == to_ledger(amount)
    assert abs(once - amount) <= 0.5e-6 + 1e-15 * amount


# ---------------------------------------------------------------- files


@given(substrate=substrates())
def test_json_round_trip(substrate, tmp_path_factory):
    path = tmp_path_factory.mktemp("json") / "substrate.json"
    substrate.to_json(path)
    assert_same(substrate, Substrate.from_json(path))


@given(nodes=st.integers(2, 12), seed=st.integers(0, 2**40), degree=st.floats(0.1, 12))
def test_random_substrates_round_trip_to_the_bit(nodes, seed, degree, tmp_path_factory):
    folder = tmp_path_factory.mktemp("json")
    substrate = draw_random_substrate(nodes, seed, mean_degree=degree)
    substrate.to_json(folder / "once.json")
    again = Substrate.from_json(folder / "once.json")
    assert_same(substrate, again)
    again.to_json(folder / "twice.json")
    assert (folder / "once.json").read_bytes() == (folder / "twice.json").read_bytes()


def test_coordinates_labels_and_unused_vm_slots_survive(tmp_path):
    places = np.array([[48.1, 11.6], [52.5, 13.4], [50.9, 6.9], [-33.9, 151.2]])
    toy_one = toy.toy_substrate()
    wide = np.pad(toy_one.vm_capacity, ((0, 0), (0, 4)))
    substrate = dataclasses.replace(
        toy_one,
        labels=("München", "Berlin", "Köln", "Sydney"),
        coordinates=places,
        vm_capacity=wide,
        vm_unit_cost=np.pad(toy_one.vm_unit_cost, ((0, 0), (0, 4))),
    )
    substrate.to_json(tmp_path / "s.json")
    assert_same(substrate, Substrate.from_json(tmp_path / "s.json"))


NAMES = dataclasses.replace(
    toy.toy_substrate(), ids=("1", "2", "x", "4"), labels=("Oslo", "Bergen ", "4", "St. John's, NL")
)


@pytest.mark.parametrize(
    ("name", "node"),
    [("1", 0), ("2", 1), ("x", 2), ("Oslo", 0), (" Bergen", 1), ("St. John's, NL", 3)],
)
def test_a_node_is_called_by_id_or_label(name, node, tmp_path):
    assert NAMES.node_index(name) == node
    NAMES.to_json(tmp_path / "names.json")
    again = Substrate.from_json(tmp_path / "names.json")
    assert_same(NAMES, again)
    assert again.node_index(name) == node


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("0", r"unknown node '0'; use an id of the substrate's file \(1, 2, x, 4\) or a label"),
        ("oslo", r"unknown node 'oslo'; .* did you mean 'Oslo'\?"),
        ("4", r"node '4': is the id of node \"St. John's, NL\" and the label of the node with id 'x'"),
    ],
)
def test_a_name_of_no_or_two_nodes_is_refused(name, message):
    with pytest.raises(ScenarioError, match=message):
        NAMES.node_index(name)


def test_without_a_file_nodes_are_called_by_number():
    assert toy.toy_substrate().node_index(" 3") == 3
    with pytest.raises(ScenarioError, match=r"unknown node '4'; the substrate's nodes are 0 \.\. 3"):
        toy.toy_substrate().node_index("4")


def test_file_is_what_networkx_reads(tmp_path):
    toy.toy_substrate().to_json(tmp_path / "s.json")
    data = json.loads((tmp_path / "s.json").read_text())
    data["edges"] = data.pop("links")  # what newer networkx calls them by default
    (tmp_path / "edges.json").write_text(json.dumps(data))
    assert_same(toy.toy_substrate(), Substrate.from_json(tmp_path / "edges.json"))
    assert data["graph"]["name"] == "toy"
    assert data["nodes"][1]["vms"] == [{"capacity": 40.0, "unit_cost": 1.0}, {"capacity": 100.0, "unit_cost": 5.0}]
    assert data["edges"][3] == {"source": 1, "target": 3, "capacity": 4.0, "delay": 50.0, "unit_cost": 4.0}


def test_ids_of_a_foreign_graph_are_kept():
    graph = toy.toy_substrate().to_networkx()
    graph = nx.relabel_nodes(graph, {node: node + 1 for node in graph})
    assert Substrate.from_networkx(graph).ids == ("1", "2", "3", "4")


def test_foreign_graph_parallel_links_merge_and_loops_go():
    graph = nx.MultiGraph()
    for node in ("b", "a"):
        graph.add_node(node, vms=[{"capacity": 10, "unit_cost": 1}])
    graph.add_edge("a", "b", capacity=3, delay=7, unit_cost=2)
    graph.add_edge("b", "a", capacity=4, delay=5, unit_cost=9)
    graph.add_edge("a", "a", capacity=1, delay=1, unit_cost=1)
    with pytest.warns(UserWarning, match="to itself, at nodes"):
        substrate = Substrate.from_networkx(graph, "mine")
    assert (substrate.name, substrate.labels, substrate.max_vms) == ("mine", ("b", "a"), 1)
    assert substrate.links.tolist() == [[0, 1]]
    assert (substrate.link_capacity[0], substrate.link_delay[0], substrate.link_unit_cost[0]) == (7.0, 5.0, 2.0)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"link_capacity": np.array([10, 5, -20, 4, 10.0])}, r"link \[1, 2\]: link_capacity is -20.0 Mbit/s"),
        ({"link_capacity": np.array([10, 5, np.nan, 4, 10.0])}, r"link_capacity is nan"),
        ({"link_capacity": np.array([10, 5, 1e-9, 4, 10.0])}, r"link_capacity is 0.0"),
        ({"link_capacity": np.array([10, 5, 2e9, 4, 10.0])}, r"at most 1e\+09"),
        ({"link_delay": np.array([10, 5, -1, 4, 10.0])}, r"link_delay is -1.0 ms"),
        ({"link_unit_cost": np.array([10, 5, np.inf, 4, 10.0])}, r"link_unit_cost is inf"),
        ({"link_delay": np.ones(4)}, r"link_delay has shape \[4\]; \[5\] was expected"),
        ({"vm_capacity": np.array([[0, 0], [40, 100], [50, 0], [20, 80.0]])}, r"VM 0 of node 0: vm_capacity is 0.0"),
        ({"vm_capacity": np.array([[40, 7], [40, 100], [50, 0], [20, 80.0]])}, r"must be 0 where a node has no VM"),
        ({"vm_count": np.array([1, 3, 1, 2])}, r"node 1 has 3 VMs; 0 to 2"),
        ({"vm_count": np.array([1, 2, -1, 2])}, r"node 2 has -1 VMs"),
        ({"vm_count": np.zeros(4, int)}, r"has no VM on any node"),
        ({"resources": ("cpu", "memory")}, r"extra_capacity is for the 1 kinds of resources beside the first"),
        ({"back_capacity": np.ones(4)}, r"back_capacity has shape \[4\]"),
        ({"labels": ("a", "b", "b", "c")}, r"labels must differ"),
        ({"ids": ("1", "2", "1", "3")}, r"ids must be 4 different names"),
        ({"links": np.array([[0, 1], [0, 2], [1, 2], [3, 1], [2, 3]])}, r"u < v"),
        ({"links": np.array([[0, 1], [0, 2], [1, 2], [1, 3], [1, 3]])}, r"sorted and distinct"),
        ({"links": np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 4]])}, r"outside 0 .. 3"),
        ({"coordinates": np.full((4, 2), np.nan)}, r"coordinates must be finite"),
    ],
)
def test_refuses(changes, message):
    with pytest.raises(ScenarioError, match=message):
        dataclasses.replace(toy.toy_substrate(), **changes)


def test_refuses_a_disconnected_graph():
    kept = [0, 1, 2]  # node 3 loses its links
    with pytest.raises(ScenarioError, match=r"'toy': is not connected \(2 parts\)"):
        dataclasses.replace(
            toy.toy_substrate(),
            links=toy.toy_substrate().links[kept],
            link_capacity=np.ones(3),
            link_delay=np.ones(3),
            link_unit_cost=np.ones(3),
        )


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("nodes"), "needs the lists 'nodes' and 'links'"),
        (lambda d: d["nodes"][2].pop("vms"), "node 2: needs 'vms'"),
        (lambda d: d["nodes"][2].update(vms=3), "node 2: needs 'vms'"),
        (lambda d: d["links"][2].update(back_capacity=3), "some links have a 'back_capacity', others not"),
        (lambda d: d["nodes"][2]["vms"][0].pop("capacity"), "node 2, VM 0: 'capacity' is None"),
        (lambda d: d["nodes"][2]["vms"][0].update(capacity=-3), "node 2, VM 0: capacity is -3.0"),
        (lambda d: d["nodes"][2].update(id=1), "same 'id'"),
        (lambda d: d["nodes"][2].pop("id"), "each node needs an 'id'"),
        (lambda d: d["links"][0].update(capacity="fast"), "link 0 - 1: 'capacity' is 'fast'"),
        (lambda d: d["links"][0].update(delay=float("nan")), "link_delay is nan"),
        (lambda d: d["links"][0].update(target=17), "names node 17, which is not among 'nodes'"),
        (lambda d: d["graph"].update(max_vms=1), "'max_vms' is 1, but a node has 2 VMs"),
        (lambda d: d.update(directed=True), "is directed"),
        (lambda d: d.update(links=[]), "is not connected"),
    ],
)
def test_refuses_a_wrong_file(edit, message, tmp_path):
    toy.toy_substrate().to_json(tmp_path / "s.json")
    data = json.loads((tmp_path / "s.json").read_text())
    edit(data)
    (tmp_path / "s.json").write_text(json.dumps(data))
    with pytest.raises(ScenarioError, match=message):
        Substrate.from_json(tmp_path / "s.json")


def test_refuses_what_is_no_json(tmp_path):
    path = tmp_path / "s.json"
    with pytest.raises(ScenarioError, match=r"s.json: no such file"):
        Substrate.from_json(path)
    path.write_text('{"nodes": [')
    with pytest.raises(ScenarioError, match=r"s.json: is not valid JSON"):
        Substrate.from_json(path)
    path.write_text("[1, 2]")
    with pytest.raises(ScenarioError, match=r"s.json: holds a list"):
        Substrate.from_json(path)
    path.write_bytes(b"{\xff}")
    with pytest.raises(ScenarioError, match=r"s.json: is not UTF-8"):
        Substrate.from_json(path)
    with pytest.raises(ScenarioError, match="cannot be read, it is a folder"):
        Substrate.from_json(tmp_path)
