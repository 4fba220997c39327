"""Real topologies: those that ship here, and files with every flaw the collection has."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario.topology_zoo import TOPOLOGIES, great_circle_km, read_topology, shipped_topologies

SIZES = {  # nodes, links with parallel ones merged
    "abilene": (11, 14),
    "attmpls": (25, 56),
    "colt": (153, 177),
    "geant2001": (27, 38),
    "geant2009": (34, 52),
    "iris": (51, 64),
    "janetbackbone": (29, 45),
    "nsfnet": (13, 15),
    "sprint": (11, 18),
    "surfnet": (50, 68),
    "uninett2010": (74, 101),
    "uscarrier": (158, 189),
}


def gml(nodes: str, edges: str, header: str = "") -> str:
    return f'Creator "a test"\ngraph [\n  {header}\n{nodes}\n{edges}\n]\n'


def node(number: int, label: str, latitude: float | None = None, longitude: float | None = None) -> str:
    place = "" if latitude is None else f"    Latitude {latitude}\n    Longitude {longitude}\n"
    return f'  node [\n    id {number}\n    label "{label}"\n{place}  ]'


def edge(source: int, target: int, speed: str = "", key: int | None = None) -> str:
    lines = [f"    source {source}", f"    target {target}"]
    lines += [f"    LinkSpeedRaw {speed}"] if speed else []
    lines += [f"    key {key}"] if key is not None else []
    return "  edge [\n" + "\n".join(lines) + "\n  ]"


def write(folder: Path, text: str, name: str = "net.gml") -> Path:
    (folder / name).write_text(text)
    return folder / name


LINE = [node(0, "A", 0, 0), node(1, "B", 0, 1), node(2, "C", 0, 2)]


# ---------------------------------------------------------------- what ships


def test_what_ships():
    assert shipped_topologies() == sorted(SIZES)
    attribution = (TOPOLOGIES / "README.md").read_text()
    assert "Attribution 4.0" in attribution
    assert "10.1109/JSAC.2011.111002" in attribution


@pytest.mark.parametrize("name", sorted(SIZES))
@pytest.mark.filterwarnings("ignore::nfv_torchrl.errors.ScenarioWarning")
def test_shipped_topology(name):
    substrate = read_topology(name, 0)
    assert (substrate.num_nodes, substrate.num_links) == SIZES[name]
    assert substrate.name.lower() == name
    assert substrate.max_vms == 6
    # No great circle between neighbours of these networks is longer than 10,000 km.
    assert substrate.link_delay.min() >= 0.01
    assert substrate.link_delay.max() < 50
    assert substrate.coordinates is not None


def test_abilene_by_hand():
    """New York to Chicago: 1,145 km by great circle between the file's coordinates, so 5.7 ms at 200 km/ms."""
    substrate = read_topology("Abilene", 0)
    new_york, chicago = substrate.labels.index("New York"), substrate.labels.index("Chicago")
    link = substrate.links.tolist().index(sorted([new_york, chicago]))
    assert substrate.link_delay[link] == pytest.approx(1145 / 200, rel=0.005)
    slower = read_topology("abilene", 0, fibre_km_per_ms=100, detour=1.5)
    np.testing.assert_allclose(slower.link_delay, 3 * substrate.link_delay)
    np.testing.assert_array_equal(slower.link_capacity, substrate.link_capacity)


def test_speeds_of_a_file_are_kept():
    """GEANT 2009 has 10 Gbit/s between the Netherlands and Belgium and nothing below 45 Mbit/s."""
    substrate = read_topology("geant2009", 0)
    assert substrate.link_capacity.min() == 45.0
    assert substrate.link_capacity[substrate.links.tolist().index([0, 1])] == 10_000.0
    np.testing.assert_array_equal(substrate.link_capacity, read_topology("geant2009", 1).link_capacity)


def test_missing_speeds_are_drawn():
    with pytest.warns(ScenarioWarning, match=r"no capacity of link '32' - '34', .*; drawn with the scenario seed"):
        one, other = (read_topology("uninett2010", seed) for seed in (0, 1))
    assert 1 <= np.sum(one.link_capacity != other.link_capacity) <= 3


def test_seed_draws_the_vms():
    one, same, other = (read_topology("nsfnet", seed, vms=(1, 3)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.vm_capacity, same.vm_capacity)
    assert not np.array_equal(one.vm_capacity, other.vm_capacity)
    assert one.max_vms == 3


# ---------------------------------------------------------------- numbers


def test_great_circle_by_hand():
    """A degree of longitude is 111.19 km on the equator, half that at 60 degrees; a quarter of the globe 10,008 km."""
    assert great_circle_km(np.array([0.0, 0.0]), np.array([0.0, 1.0])) == pytest.approx(111.19, abs=0.01)
    assert great_circle_km(np.array([60.0, 179.5]), np.array([60.0, -179.5])) == pytest.approx(55.6, abs=0.01)
    assert great_circle_km(np.array([0.0, 0.0]), np.array([90.0, 0.0])) == pytest.approx(10007.5, abs=0.1)


def test_delays_of_a_line(tmp_path):
    path = write(tmp_path, gml("\n".join(LINE), edge(0, 1) + "\n" + edge(1, 2)))
    np.testing.assert_allclose(read_topology(path, 0).link_delay, 111.195 / 200, rtol=1e-4)


def test_nodes_at_one_place_get_the_least_delay(tmp_path):
    nodes = [node(0, "A", 10, 10), node(1, "B", 10, 10)]
    path = write(tmp_path, gml("\n".join(nodes), edge(0, 1)))
    assert read_topology(path, 0).link_delay.tolist() == [0.01]


@pytest.mark.parametrize("header", ["", "multigraph 1", "multigraph 0"])
def test_parallel_links_merge(tmp_path, header):
    edges = [edge(0, 1, "1000000", key=0), edge(1, 0, "2500000.0", key=0), edge(1, 2, "4.0e6")]
    substrate = read_topology(write(tmp_path, gml("\n".join(LINE), "\n".join(edges), header)), 0)
    assert substrate.links.tolist() == [[0, 1], [1, 2]]
    assert substrate.link_capacity.tolist() == [3.5, 4.0]


@pytest.mark.parametrize("speed", ["-5", "0", '"nan"', "1.0e40"])
def test_a_speed_out_of_range_is_refused(tmp_path, speed):
    path = write(tmp_path, gml("\n".join(LINE), edge(0, 1, speed) + "\n" + edge(1, 2, "7")))
    with pytest.raises(ScenarioError, match=r"net.gml: link 0 - 1: LinkSpeedRaw is .*; it must be at least 1e-06"):
        read_topology(path, 0)


def test_a_speed_that_is_no_number_is_drawn_and_named(tmp_path):
    path = write(tmp_path, gml("\n".join(LINE), edge(0, 1, '"fast"') + "\n" + edge(1, 2, "7")))
    with pytest.warns(ScenarioWarning, match=r"no capacity of link 0 - 1 \(LinkSpeedRaw of link 0 - 1 is 'fast'"):
        capacity = read_topology(path, 0).link_capacity
    assert 1600 <= capacity[0] <= 6400
    assert capacity[1] == 7e-6


def test_loops_go_with_a_warning(tmp_path):
    path = write(tmp_path, gml("\n".join(LINE), "\n".join([edge(0, 1), edge(1, 1), edge(1, 2)])))
    with pytest.warns(UserWarning, match=r"net.gml: dropped links from a node to itself, at nodes \[1\]"):
        assert read_topology(path, 0).num_links == 2


def test_equal_and_missing_labels_become_distinct(tmp_path):
    nodes = [node(0, "Oslo", 1, 1), node(5, "Oslo", 1, 2), node(7, "Oslo (2)", 1, 3), "  node [\n    id 9\n  ]"]
    edges = [edge(0, 5), edge(5, 7), edge(7, 9)]
    with pytest.warns(UserWarning, match=r"no coordinates of nodes 3 \(9\)"):
        substrate = read_topology(write(tmp_path, gml("\n".join(nodes), "\n".join(edges))), 0)
    assert substrate.labels == ("Oslo", "Oslo (2)", "Oslo (2) (2)", "9")


def test_missing_coordinates_come_from_neighbours(tmp_path):
    """B lies between A and C, across the date line; D hangs on B, so it gets B's place in the second round."""
    nodes = [node(0, "A", 0, 178), node(1, "B"), node(2, "C", 0, -178), node(3, "D")]
    edges = [edge(0, 1), edge(1, 2), edge(1, 3)]
    with pytest.warns(UserWarning, match=r"nodes 1 \(B\), 3 \(D\); set to the mean of their neighbours'"):
        substrate = read_topology(write(tmp_path, gml("\n".join(nodes), "\n".join(edges))), 0)
    np.testing.assert_allclose(np.abs(substrate.coordinates[[1, 3]]), [[0, 180], [0, 180]], atol=1e-9)
    np.testing.assert_allclose(substrate.link_delay, [2 * 111.195 / 200, 2 * 111.195 / 200, 0.01], rtol=1e-4)


def test_without_any_coordinates_delays_are_drawn(tmp_path):
    nodes = [node(number, "x") for number in range(3)]
    path = write(tmp_path, gml("\n".join(nodes), edge(0, 1) + "\n" + edge(1, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        substrate = read_topology(path, 0, link_delay=(40, 50))
    assert substrate.coordinates is None
    assert np.all((substrate.link_delay >= 40) & (substrate.link_delay <= 50))


def test_text_that_is_not_ascii(tmp_path):
    nodes = [node(0, "Zürich", 1, 1), node(1, "Łódź", 1, 2)]
    assert read_topology(write(tmp_path, gml("\n".join(nodes), edge(0, 1))), 0).labels == ("Zürich", "Łódź")


# ---------------------------------------------------------------- refusals

TWO_PARTS = gml(
    "\n".join([*LINE, node(3, "D", 1, 1), node(4, "E", 2, 1)]), "\n".join([edge(0, 1), edge(1, 2), edge(3, 4)])
)


def test_disconnected_files(tmp_path):
    path = write(tmp_path, TWO_PARTS)
    with pytest.raises(ScenarioError, match=r"net.gml: is not connected \(2 parts, the largest of 3 of 5 nodes\)"):
        read_topology(path, 0)
    substrate = read_topology(path, 0, largest_component=True)
    assert substrate.labels == ("A", "B", "C")
    assert substrate.links.tolist() == [[0, 1], [1, 2]]


def test_of_parts_of_equal_size_the_first_is_kept(tmp_path):
    nodes = [node(number, letter, number, 0) for number, letter in enumerate("ABCD")]
    path = write(tmp_path, gml("\n".join(nodes), edge(1, 3) + "\n" + edge(0, 2)))
    assert read_topology(path, 0, largest_component=True).labels == ("A", "C")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("net.graphml", "<graphml><graph>", "net.graphml: is not valid GraphML"),
        ("net.graphml", "", "net.graphml: is not valid GraphML"),
        ("net.graphml", "<html></html>", "net.graphml: is not valid GraphML"),
        ("net.gml", "hello world", "net.gml: is not valid GML"),
        ("net.gml", "", "net.gml: is not valid GML"),
        ("net.gml", gml(LINE[0], edge(0, 7)), "net.gml: is not valid GML"),
        ("net.gml", gml("\n".join([LINE[0], LINE[0]]), ""), "net.gml: is not valid GML"),
        ("net.txt", "hello", "net.txt: is not valid SNDlib"),
        ("net.xml", "<network/>", "net.xml: is not valid SNDlib XML"),
        ("net.graph", "NODES 1", "net.graph: is not valid Repetita"),
        ("net.gml", gml(LINE[0], ""), r"net.gml: has 1 node\(s\)"),
        ("net.gml", gml("", ""), r"net.gml: has 0 node\(s\)"),
        ("net.gml", gml("\n".join(LINE), ""), "net.gml: is not connected"),
    ],
)
def test_refuses_a_wrong_file(tmp_path, name, text, message):
    with pytest.raises(ScenarioError, match=message):
        read_topology(write(tmp_path, text, name), 0)


def test_refuses_a_file_without_links(tmp_path):
    with pytest.raises(ScenarioError, match="has no links"):
        read_topology(write(tmp_path, gml("\n".join(LINE), "")), 0, largest_component=True)


def test_refuses_what_is_not_there(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere.graphml: no such file"):
        read_topology(tmp_path / "nowhere.graphml", 0)
    with pytest.raises(ScenarioError, match=r"'atlantis' is neither a file .* those are abilene, attmpls"):
        read_topology("atlantis", 0)


@pytest.mark.parametrize("arguments", [{"fibre_km_per_ms": 0}, {"detour": -1}, {"detour": float("nan")}])
def test_refuses_a_wrong_speed(arguments):
    with pytest.raises(ScenarioError, match=next(iter(arguments))):
        read_topology("abilene", 0, **arguments)
