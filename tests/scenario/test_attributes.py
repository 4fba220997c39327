"""What a network file's attributes mean: names, units, VMs; and that no number is replaced without a word."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
import toy
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from test_substrate import assert_same

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario import Scenario, Substrate, read_topology
from nfv_torchrl.scenario.quantities import SPEEDS, TIMES, Unit, Unreadable, parse_value


def network(folder: Path, *links: dict, nodes: tuple[dict, ...] = ({}, {}, {}), **rest) -> Path:
    """A line of nodes a, b, c: a JSON file whose links and nodes have these attributes."""
    ends = [("a", "b"), ("b", "c")]
    data = {
        "nodes": [{"id": name, **node} for name, node in zip("abc", nodes, strict=True)],
        "links": [{"source": u, "target": v, **link} for (u, v), link in zip(ends, links, strict=True)],
        **rest,
    }
    (folder / "net.json").write_text(json.dumps(data))
    return folder / "net.json"


def silent(path: Path, **arguments) -> Substrate:
    """The network of a file that gives no reason to warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_topology(path, 0, **arguments)


def all_warnings(path: Path, **arguments) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_topology(path, 0, **arguments)
    assert all(issubclass(warning.category, ScenarioWarning) for warning in caught)
    return [str(warning.message) for warning in caught]


FULL = {"capacity": 100, "delay": 2, "unit_cost": 3}

# ---------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("text", "mbit"),
    [
        ("10 Gbps", 10_000), ("155 Mbps", 155), ("2.5Gbit/s", 2500), ("64 kb/s", 0.064), ("1e3 bit/s", 1e-3),
        ("1 Tbit/s", 1e6), ("10G", 10_000), (" 45 ", 45), (7, 7), ("400 K", 0.4),
    ],
)  # fmt: skip
def test_text_with_a_unit(text, mbit):
    assert parse_value(text, Unit(), SPEEDS) == pytest.approx(mbit, rel=1e-15)


@pytest.mark.parametrize("text", ["< 2.5 Gbps", "10 GB/s", "10-20 Mbps", "fast", "10,000", "1 ms", [1], {}, True])
def test_text_whose_number_or_unit_is_not_clear(text):
    with pytest.raises(Unreadable):
        parse_value(text, Unit(), SPEEDS)


@pytest.mark.parametrize(("text", "ms"), [("5 ms", 5), ("20 us", 0.02), ("20 µs", 0.02), ("0.1 s", 100)])
def test_delays_with_a_unit(text, ms):
    assert parse_value(text, Unit(), TIMES) == pytest.approx(ms, rel=1e-15)


# ---------------------------------------------------------------- names


def gml(folder: Path, graph: nx.Graph) -> Path:
    nx.write_gml(graph, folder / "net.gml")
    return folder / "net.gml"


def graphml(folder: Path, graph: nx.Graph) -> Path:
    graph = graph.copy()
    for node in graph:
        graph.nodes[node]["vms"] = json.dumps(graph.nodes[node]["vms"])
    nx.write_graphml(graph, folder / "net.graphml")
    return folder / "net.graphml"


def node_link(folder: Path, graph: nx.Graph) -> Path:
    (folder / "net.json").write_text(json.dumps(nx.node_link_data(graph, edges="edges")))
    return folder / "net.json"


@pytest.mark.parametrize("write", [gml, graphml, node_link])
def test_own_names_are_read_from_every_format(write, tmp_path):
    """What networkx writes of a substrate gives it back, nothing drawn."""
    graph = toy.toy_substrate().to_networkx()
    substrate = silent(write(tmp_path, graph))
    assert substrate.name in ("net", "toy")
    for field in ("vm_count", "vm_capacity", "vm_unit_cost", "links", "link_capacity", "link_delay", "link_unit_cost"):
        np.testing.assert_array_equal(getattr(substrate, field), getattr(toy.toy_substrate(), field), err_msg=field)


def test_written_substrates_come_back_through_a_scenario(tmp_path):
    substrate = read_topology("nsfnet", 3)
    substrate.to_json(tmp_path / "s.json")
    assert_same(silent(tmp_path / "s.json"), substrate)
    assert_same(Scenario.from_config({"substrate": {"path": str(tmp_path / "s.json")}}).substrate, substrate)


def test_zoo_names_with_units_beside_them(tmp_path):
    links = ({"LinkSpeed": "2.5", "LinkSpeedUnits": "G"}, {"LinkSpeedRaw": 1e6, "LinkSpeed": 9, "LinkSpeedUnits": "T"})
    assert silent(network(tmp_path, *links)).link_capacity.tolist() == [2500.0, 1.0]


def test_a_speed_without_its_unit_is_not_guessed(tmp_path):
    (message,) = all_warnings(network(tmp_path, {"LinkSpeed": "10"}, {"LinkSpeedRaw": 5e6}))
    assert "no capacity of link 'a' - 'b' (LinkSpeed of link 'a' - 'b' is '10': no number with a clear unit)" in message


def test_text_read_as_a_number_is_named(tmp_path):
    (message,) = all_warnings(network(tmp_path, {"LinkSpeedRaw": "10 Gbps"}, {"LinkSpeedRaw": "1000000"}))
    assert "text with a unit read as a number: LinkSpeedRaw '10 Gbps' of link 'a' - 'b' as 10000" in message


def test_mapped_names_and_units(tmp_path):
    links = ({"bw": 2, "LinkDelay": 500, "price": "4"}, {"bw": 3, "LinkDelay": 250, "price": 5})
    nodes = ({"n": 2, "cpu": 100, "lat": 1, "lon": 2},) * 3
    attributes = {
        "capacity": {"name": "bw", "unit": "Gbit/s"},
        "delay": {"name": "LinkDelay", "unit": "us"},
        "unit_cost": "price",
        "latitude": "lat",
        "longitude": "lon",
        "vm_count": "n",
        "vm_capacity": "cpu",
    }
    substrate = silent(network(tmp_path, *links, nodes=nodes), attributes=attributes)
    assert substrate.link_capacity.tolist() == [2000.0, 3000.0]
    assert substrate.link_delay.tolist() == [0.5, 0.25]
    assert substrate.link_unit_cost.tolist() == [4.0, 5.0]
    assert substrate.coordinates.tolist() == [[1.0, 2.0]] * 3
    assert substrate.vm_capacity.tolist() == [[100.0, 100.0]] * 3
    assert np.all((substrate.vm_unit_cost >= 25) & (substrate.vm_unit_cost <= 75))


def test_a_length_becomes_a_delay(tmp_path):
    """120 km of fibre at 200 km/ms take 0.6 ms; the detour is for great circles."""
    path = network(tmp_path, {"distance": 120}, {"distance": 0})
    attributes = {"delay": {"name": "distance", "unit": "km"}}
    assert silent(path, attributes=attributes, detour=2.0).link_delay.tolist() == [0.6, 0.0]


def test_a_scenario_maps_names(tmp_path):
    path = network(tmp_path, {"bw": 7}, {"bw": 8})
    config = {"substrate": {"path": str(path), "attributes": {"capacity": "bw"}}, "pairs_per_service": 2}
    assert Scenario.from_config(config).substrate.link_capacity.tolist() == [7.0, 8.0]


def test_a_command_line_maps_names(tmp_path):
    path = network(tmp_path, {"bw": 7}, {"bw": 8})
    overrides = [
        f"scenario.substrate.path={path}",
        "scenario.substrate.attributes={capacity:{name:bw,unit:Gbit/s}}",
        "scenario.substrate.directed=merge",
        "scenario.pairs_per_service=2",
    ]
    with initialize_config_dir(str(Path(__file__).parents[2] / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose("evaluate", overrides), resolve=True)
    assert Scenario.from_config(config["scenario"]).substrate.link_capacity.tolist() == [7000.0, 8000.0]


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (
            {"capacity": "speed"},
            r"attributes.capacity: no link of .*net.json has an attribute 'speed'; they have bw, x",
        ),
        ({"latitude": "lat"}, r"attributes.latitude: no node of .*net.json has an attribute 'lat'; they have none"),
        ({"bandwidth": "bw"}, r"attributes.bandwidth: unknown quantity; use some of capacity, delay"),
        ({"capacity": {"name": "bw", "unit": "MB/s"}}, r"capacity.unit: 'MB/s' is unknown; use one of bit/s, kbit/s"),
        ({"capacity": {"name": "bw", "units": "s"}}, r"give the name of an attribute, or {name: NAME, unit: UNIT}"),
        ({"unit_cost": {"name": "bw", "unit": "$"}}, r"unit_cost.unit: '\$' is unknown; leave it out"),
        ({"capacity": 3}, r"attributes.capacity: 3; give the name"),
        ({"delay": "x"}, r"net.json: x of link 'a' - 'b' is 'far'; a number was expected"),
    ],
)
def test_refuses_a_mapping(attributes, message, tmp_path):
    path = network(tmp_path, {"bw": 1, "x": "far"}, {"bw": 1})
    with pytest.raises(ScenarioError, match=message):
        read_topology(path, 0, attributes=attributes)


def test_attributes_need_a_file():
    with pytest.raises(ScenarioError, match=r"substrate.attributes: names attributes of a file"):
        Scenario.from_config({"substrate": {"attributes": {"capacity": "bw"}}})


# ---------------------------------------------------------------- what is said


def test_numbers_that_are_not_used_are_named_once(tmp_path):
    links = ({"width": 10, "lag": "3", "kind": "fibre"}, {"width": 20})
    (message,) = all_warnings(network(tmp_path, *links, nodes=({"cores": 4}, {}, {"drawing": {"x": 1.5}})))
    used = "width (links), lag (links), cores (nodes), drawing (nodes)"
    assert f"numbers of the file that are not used: {used}" in message
    assert "instead: capacity, delay, unit_cost, vm_capacity, vm_unit_cost drawn with the scenario seed" in message
    assert "kind" not in message


def test_numbers_missing_on_some_links_are_named(tmp_path):
    path = network(tmp_path, FULL, {"unit_cost": 4}, nodes=({"latitude": 0, "longitude": 0},) * 3)
    messages = all_warnings(path)
    assert any("no capacity of link 'b' - 'c'; drawn with the scenario seed" in message for message in messages)
    assert any("no delay of link 'b' - 'c'; from the coordinates of its ends" in message for message in messages)
    assert len(messages) == 2
    with pytest.warns(ScenarioWarning):
        assert read_topology(path, 0).link_delay.tolist() == [2.0, 0.01]


def test_a_topology_without_numbers_is_drawn_without_a_word(tmp_path):
    silent(network(tmp_path, {}, {"note": "old"}))


@pytest.mark.parametrize("name", ["capacity", "delay", "unit_cost"])
@pytest.mark.parametrize("value", [-1, float("nan"), float("inf"), 10**400, "-inf", "NaN", 1e12])
def test_refuses_a_number_out_of_range(name, value, tmp_path):
    path = network(tmp_path, FULL, {**FULL, name: value})
    with pytest.raises(ScenarioError, match=rf"net.json: link 'b' - 'c': {name} is .* correct the file"):
        read_topology(path, 0)


@pytest.mark.parametrize("name", ["capacity", "unit_cost"])
def test_zero_is_no_capacity_and_no_price(name, tmp_path):
    with pytest.raises(ScenarioError, match=rf"link 'a' - 'b': {name} is 0"):
        read_topology(network(tmp_path, {**FULL, name: 0}, FULL), 0)


@pytest.mark.parametrize("place", [{"latitude": 91, "longitude": 0}, {"Latitude": 0, "Longitude": "-181"}])
def test_refuses_places_off_the_globe(place, tmp_path):
    with pytest.raises(ScenarioError, match=r"node 'a': (latitude|Longitude) is .* degrees"):
        read_topology(network(tmp_path, {}, {}, nodes=(place, {}, {})), 0)


# ---------------------------------------------------------------- VMs

ONE_VM = {"vms": [{"capacity": 5, "unit_cost": 6}]}


def test_vms_of_some_nodes_are_kept_and_others_drawn(tmp_path):
    path = network(tmp_path, FULL, FULL, nodes=(ONE_VM, {}, {"vm_count": 8, "vm_unit_cost": 2}))
    messages = all_warnings(path)
    assert any("no VMs of node 'b'" in message for message in messages)
    with pytest.warns(ScenarioWarning):
        substrate = read_topology(path, 0)
    assert (substrate.vm_count[[0, 2]].tolist(), substrate.max_vms) == ([1, 8], 8)
    assert (substrate.vm_capacity[0, 0], substrate.vm_unit_cost[0, 0]) == (5.0, 6.0)
    assert substrate.vm_unit_cost[2].tolist() == [2.0] * 8
    assert np.all(substrate.vm_capacity[2] >= 200)


def test_vms_are_drawn_as_for_other_formats(tmp_path):
    json_file = silent(network(tmp_path, {}, {}))
    (tmp_path / "net.gml").write_text(
        'graph [ node [ id 0 label "a" ] node [ id 1 label "b" ] node [ id 2 label "c" ]\n'
        "edge [ source 0 target 1 ] edge [ source 1 target 2 ] ]"
    )
    gml_file = silent(tmp_path / "net.gml")
    for field in ("labels", "vm_count", "vm_capacity", "link_capacity", "link_delay", "link_unit_cost"):
        np.testing.assert_array_equal(getattr(json_file, field), getattr(gml_file, field), err_msg=field)


@pytest.mark.parametrize(
    ("node", "rest", "message"),
    [
        ({"vms": "two"}, {}, r"node 'a': 'vms' is 'two'; use JSON such as"),
        ({"vms": 2}, {}, r"node 'a': needs 'vms'"),
        ({"vms": [{"capacity": 1}]}, {}, r"node 'a', VM 0: 'unit_cost' is None"),
        ({"vms": [{"capacity": 1, "unit_cost": -2}]}, {}, r"node 'a', VM 0: unit_cost is -2.0"),
        ({"vms": [{"capacity": 10**400, "unit_cost": 1}]}, {}, r"node 'a', VM 0: 'capacity' is 1000"),
        ({"vm_count": 1.5}, {}, r"node 'a': vm_count is 1.5; use an integer"),
        ({"vm_count": -1}, {}, r"node 'a': vm_count is -1; it must be at least 0"),
        ({"vm_count": 10**9}, {}, r"node 'a': vm_count is 1000000000; .* at most 1000"),
        (ONE_VM, {"graph": {"max_vms": 10**9}}, r"1000000000 VM slots a node"),
        (ONE_VM, {"graph": {"max_vms": 0}}, r"'max_vms' is 0"),
        (ONE_VM, {"graph": {"max_vms": "9"}}, r"'max_vms' is '9'"),
    ],
)
def test_refuses_vms(node, rest, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        read_topology(network(tmp_path, FULL, FULL, nodes=(node, ONE_VM, ONE_VM), **rest), 0)


# ---------------------------------------------------------------- directed files


def arcs(folder: Path, *rows: tuple[str, str, float, float]) -> Path:
    links = [{"source": u, "target": v, "capacity": x, "delay": kappa, "unit_cost": 1} for u, v, x, kappa in rows]
    data = {"directed": True, "multigraph": True, "nodes": [{"id": name} for name in "ab"], "links": links}
    (folder / "net.json").write_text(json.dumps(data))
    return folder / "net.json"


def test_arcs_that_agree_become_links(tmp_path):
    substrate = read_topology(arcs(tmp_path, ("a", "b", 5, 1), ("b", "a", 5, 1)), 0)
    assert (substrate.links.tolist(), substrate.link_capacity.tolist()) == ([[0, 1]], [5.0])
    rows = [("a", "b", 5, 1), ("b", "a", 7, 2), ("b", "a", 5, 1), ("a", "b", 7, 2)]
    substrate = read_topology(arcs(tmp_path, *rows), 0)
    assert (substrate.link_capacity.tolist(), substrate.link_delay.tolist()) == ([12.0], [1.0])


@pytest.mark.parametrize(
    ("rows", "flaw", "capacity", "delay"),
    [
        ([("a", "b", 5, 1), ("b", "a", 4, 3)], "its way back has other numbers", 4.0, 3.0),
        ([("a", "b", 5, 1), ("a", "b", 2, 2), ("b", "a", 6, 1)], "its way back has other numbers", 6.0, 1.0),
    ],
)
def test_arcs_that_do_not_agree(rows, flaw, capacity, delay, tmp_path):
    path = arcs(tmp_path, *rows)
    with pytest.raises(ScenarioError, match=rf"net.json: is directed, .* {flaw}; .* set substrate.directed=merge"):
        read_topology(path, 0)
    substrate = read_topology(path, 0, directed="merge")
    assert (substrate.link_capacity.tolist(), substrate.link_delay.tolist()) == ([capacity], [delay])


def test_an_arc_without_one_back_beside_others_that_have_one(tmp_path):
    path = arcs(tmp_path, ("a", "b", 5, 1), ("b", "a", 5, 1), ("b", "c", 7, 2))
    path.write_text(path.read_text().replace('{"id": "b"}', '{"id": "b"}, {"id": "c"}'))
    with pytest.raises(ScenarioError, match=r"link 'b' - 'c' there is no arc back; .* set substrate.directed=merge"):
        read_topology(path, 0)
    assert read_topology(path, 0, directed="merge").link_capacity.tolist() == [5.0, 7.0]


def test_a_file_of_arcs_in_one_direction_only_is_read_as_links(tmp_path):
    """As SNDlib's GML, yEd and Gephi write networks whose links serve both directions."""
    path = arcs(tmp_path, ("b", "a", 5, 1))
    assert any("no arc has one back" in message for message in all_warnings(path))
    with pytest.warns(ScenarioWarning, match="is directed, but no arc has one back"):
        assert read_topology(path, 0).link_capacity.tolist() == [5.0]


def test_directed_must_be_known():
    with pytest.raises(ScenarioError, match=r"substrate.directed: 'yes' is unknown; use one of pairs, merge"):
        read_topology("abilene", 0, directed="yes")


# ---------------------------------------------------------------- whatever else

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
NAMES = st.sampled_from(
    ["label", "latitude", "Longitude", "vms", "vm_count", "capacity", "delay", "LinkSpeedRaw", "LinkSpeed", "x"]
)


@given(
    nodes=st.lists(st.dictionaries(NAMES, JSON, max_size=3), min_size=3, max_size=3),
    links=st.lists(st.dictionaries(NAMES, JSON, max_size=3), min_size=2, max_size=2),
    rest=st.dictionaries(st.sampled_from(["graph", "directed", "multigraph"]), JSON | st.just({"max_vms": 7})),
)
def test_any_json_is_a_network_or_one_line(nodes, links, rest, tmp_path_factory):
    path = network(tmp_path_factory.getbasetemp(), *links, nodes=tuple(nodes), **rest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        try:
            assert read_topology(path, 0).num_nodes == 3
        except ScenarioError as error:
            assert re.fullmatch(r"[^\n]{1,600}", str(error))
