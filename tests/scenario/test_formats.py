"""One small file of each format: every number in it is used, or named in a warning."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario import Scenario, Substrate, read_topology
from nfv_torchrl.scenario.demand_files import read_demand_series, read_demands
from nfv_torchrl.scenario.formats import topohub
from nfv_torchrl.scenario.formats.demands import write_demands
from nfv_torchrl.scenario.formats.dialects import translate
from nfv_torchrl.scenario.formats.repetita import parse_demands
from nfv_torchrl.scenario.formats.sndlib import parse_native, parse_sndlib_xml
from nfv_torchrl.scenario.graph_files import read_graph_file

FILES = Path(__file__).parent / "formats"


def read(name: str, **arguments) -> tuple[Substrate, str]:
    """The network of a file and all that was said about it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        substrate = read_topology(FILES / name, 0, **arguments)
    return substrate, "\n".join(str(warning.message) for warning in caught)


# File; link capacities; link delays, None: drawn; capacities of the VMs; what is named as unused.
KNOWN = [
    ("topohub.json", None, [3.45, 3.1, 3.0], None, ["ecmp_fwd (links), ecmp_bwd (links)", "its 3 demands"]),
    ("topohub.gml", None, [3.45, 3.1, 3.0], None, ["ecmp_fwd (links)"]),
    ("sndlib.txt", [2500, 622, None], None, None, ["pre_installed_cost", "module_cost", "its 2 demands"]),
    ("sndlib.xml", [2500, 622, None], None, None, ["setup_cost", "module_capacity", "its 2 demands"]),
    ("sndlib.gml", None, None, None, ["graphics (links)", "LabelGraphics (nodes)", "no arc has one back"]),
    ("repetita.graph", [9953.28, 155], [3.45, 1.2], None, ["weight (links)", "bw is taken for kbit/s"]),
    ("virne.gml", [54, 86], None, [78, 87, 67], ["max_bw (links), pos (nodes), max_cpu (nodes)", "one VM a node"]),
    ("realvnf.graphml", [1024, 512], [15, 3], [10, 30, 20], ["LinkBkwdCap (links)", "one VM a node"]),
    ("d3.json", None, None, None, ["value (links), group (nodes)"]),
    ("xlron.json", None, [5, 1.5], None, ["distance as delay in km"]),
    ("yed.graphml", [2500], None, None, ["nodegraphics (nodes)"]),
    ("gephi.graphml", None, None, None, ["weight (links), r (nodes)"]),
    ("igraph.graphml", None, [4.5], None, []),
]  # fmt: skip


@pytest.mark.parametrize(("name", "capacity", "delay", "vms", "said"), KNOWN, ids=[row[0] for row in KNOWN])
def test_every_number_is_used_or_named(name, capacity, delay, vms, said):
    substrate, message = read(name)
    for expected, values in ((capacity, substrate.link_capacity), (delay, substrate.link_delay)):
        for link, number in enumerate(expected or ()):
            assert number is None or values[link] == pytest.approx(number, rel=1e-12)
    if vms is not None:
        assert substrate.vm_count.tolist() == [1, 1, 1]
        assert substrate.vm_capacity[:, 0].tolist() == vms
    for part in said:
        assert part in message


@pytest.mark.parametrize("name", [row[0] for row in KNOWN])
def test_a_paper_scenario_stands_on_it(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        config = {"substrate": {"path": str(FILES / name)}, "endpoints": "uniform", "horizon": 5, "mean_lifetime": 10}
        scenario = Scenario.from_config(config)
        assert len(scenario.workload(0)) > 0


def test_names_and_places():
    for name in ("topohub.json", "topohub.gml"):
        substrate, _ = read(name)
        assert (substrate.labels, substrate.ids) == (("Rome", "Bern", "Graz"), ("0", "1", "2"))
        assert substrate.coordinates.tolist() == [[41.9, 12.5], [46.95, 7.45], [47.07, 15.44]]
    for name in ("sndlib.txt", "sndlib.xml"):
        substrate, _ = read(name)
        assert substrate.ids == ("Rome", "Bern", "Graz")
        # Rome - Bern: a great circle of 689.7 km.
        assert substrate.link_delay[0] == pytest.approx(689.7 / 200, abs=1e-3)
    assert read("repetita.graph")[0].labels == ("0_Rome", "1_Bern", "2_Nowhere")
    assert read("xlron.json")[0].ids == ("(0, 0)", "(0, 1)", "(1, 0)")
    assert read("d3.json")[0].labels == ("Rome", "Bern", "Graz")
    assert read("igraph.graphml")[0].coordinates[0].tolist() == [41.9, 12.5]


def test_a_great_circle_takes_the_detour_and_a_fibre_does_not():
    assert read("topohub.json", detour=2.0)[0].link_delay.tolist() == pytest.approx([6.9, 6.2, 6.0])
    assert read("xlron.json", detour=2.0)[0].link_delay.tolist() == [5.0, 1.5]


def test_a_mapping_of_the_users_goes_before_the_project_s():
    mapping = {"capacity": {"name": "max_bw", "unit": "Gbit/s"}}
    substrate, message = read("virne.gml", attributes=mapping)
    assert substrate.link_capacity.tolist() == [54_000.0, 86_000.0]
    assert substrate.vm_capacity[:, 0].tolist() == [78.0, 87.0, 67.0]
    assert "bw (links)" in message and "bw as capacity" not in message


def test_places_of_a_random_graph_are_no_degrees(tmp_path):
    """TopoHub's random graphs lie in a plane: ``dist`` is the straight line, here of 5 km."""
    text = (FILES / "topohub.json").read_text()
    for old, new in (("[12.5, 41.9]", "[3, 4]"), ("[7.45, 46.95]", "[0, 0]"), ("[15.44, 47.07]", "[6, 8]")):
        text = text.replace(old, new)
    (tmp_path / "plane.json").write_text(re.sub(r'"dist": \d+\.0', '"dist": 5.0', text))
    with pytest.warns(ScenarioWarning, match=r"not used: .*pos \(nodes\)"):
        assert read_topology(tmp_path / "plane.json", 0).coordinates is None


@pytest.mark.parametrize(("old", "x"), [('coordinatesType="geographical"', "pixel"), ("<x>12.50</x>", "1250")])
def test_pixels_are_no_degrees(old, x, tmp_path):
    text = (FILES / "sndlib.xml").read_text()
    new = f'coordinatesType="{x}"' if "Type" in old else f"<x>{x}</x>"
    (tmp_path / "net.xml").write_text(text.replace(old, new))
    with pytest.warns(ScenarioWarning, match=r"x and y are no degrees.*x \(nodes\), y \(nodes\)"):
        assert read_topology(tmp_path / "net.xml", 0).coordinates is None


# ---------------------------------------------------------------- demands


def test_demands_of_sndlib():
    native = parse_native((FILES / "sndlib.txt").read_bytes(), "net").demands
    assert (native.names, native.unit, native.time) == (("Rome", "Bern", "Graz"), "Mbit/s", "20040301-0010")
    assert native.pairs.tolist() == [[0, 1], [2, 0]]
    assert native.values.tolist() == [0.375, 20.0]  # two routing units of 10
    xml = parse_sndlib_xml((FILES / "sndlib.xml").read_bytes(), "net").demands
    assert (xml.unit, xml.time) == ("kbit/s", "20040301-0015")
    assert xml.in_mbit().tolist() == native.in_mbit().tolist()


def test_demands_of_repetita_and_topohub():
    demands = parse_demands((FILES / "repetita.demands").read_bytes(), "net")
    assert demands.matrix().tolist() == [[0, 300_632, 0], [0, 0, 0], [158_179, 0, 0]]
    assert demands.in_mbit().tolist() == pytest.approx([300.632, 158.179])
    demands = translate(read_graph_file(FILES / "topohub.json")).demands
    assert demands.matrix().tolist() == [[0, 34, 6.5], [0, 0, 0], [0, 2, 0]]
    with pytest.raises(ScenarioError, match=r"its demands have no unit; Mbit/s can be had of bit/s, "):
        demands.in_mbit()


def test_demands_as_csv(tmp_path):
    write_demands(tmp_path / "d.csv", [read_demands(FILES / "sndlib.txt")])
    lines = (tmp_path / "d.csv").read_text().splitlines()
    assert lines[0] == "source,target,demand,unit,time"
    assert lines[2] == "Graz,Rome,20.0,Mbit/s,20040301-0010"


def test_a_series_of_demands_is_in_order_of_time(tmp_path):
    text = (FILES / "sndlib.txt").read_text()
    for name, time in (("a.txt", "20040301-0015"), ("b.txt", "20040301-0005")):
        (tmp_path / name).write_text(text.replace("20040301-0010", time))
    assert [matrix.time for matrix in read_demand_series(tmp_path)] == ["20040301-0005", "20040301-0015"]
    (tmp_path / "c.txt").write_text(text.replace("MBITPERSEC", "GBITPERSEC"))
    with pytest.raises(ScenarioError, match=r"c.txt: has other nodes or another unit than .*a.txt"):
        read_demand_series(tmp_path)


def test_files_without_demands_are_gaps_of_a_series(tmp_path):
    text = (FILES / "sndlib.txt").read_text()
    gap = re.sub(r"(?s)(\nDEMANDS \(\n).*?\n\)", r"\1)", text)
    (tmp_path / "a.txt").write_text(gap)
    with pytest.raises(ScenarioError, match="none of its 1 files holds demands"):
        read_demand_series(tmp_path)
    (tmp_path / "b.txt").write_text(text)
    with pytest.warns(ScenarioWarning, match=r"1 of 2 files hold no demands and are left out, such as a.txt"):
        (matrix,) = read_demand_series(tmp_path)
    assert matrix.source.endswith("b.txt") and len(matrix)


# ---------------------------------------------------------------- refusals

DAMAGED = [
    ("sndlib.txt", "?SNDlib native", "?other", "the first line does not begin"),
    ("sndlib.txt", "Bern ( 7.45 46.95 )", "Bern ( 7.45 east )", r"line 13: .* is no entry of NODES"),
    ("sndlib.txt", "( Rome Graz ) 0.00", "( Rome Graz ) many", r"line 19: .* is no entry of LINKS"),
    ("sndlib.txt", "( Graz Rome ) 2 10.0", "( Graz Oslo ) 2 10.0", "a demand names node 'Oslo', which is not among"),
    ("sndlib.txt", "( Graz Rome ) 2 10.0", "( Graz Rome ) 2 -1.0", "the demand from 'Graz' to 'Rome' is -2.0; use"),
    ("sndlib.txt", "    P2 ( L2 L3 )\n  )\n)", "", "the section ADMISSIBLE_PATHS does not end"),
    ("sndlib.xml", "<target>Graz</target>", "", r"line 13: a <link> without a source or a target"),
    ("sndlib.xml", "375.0", "much", "demandValue is 'much' where a number was expected"),
    ("sndlib.xml", "<network xmlns", '<!DOCTYPE n [<!ENTITY e "x">]><network xmlns', "entity 'e', which is"),
    ("sndlib.xml", 'id="Graz"', "", r"line 8: a <node> without 'id'"),
    ("repetita.graph", "EDGES 4", "EDGES 5", "it ends before its EDGES do"),
    ("repetita.graph", "EDGES 4", "EDGES 3", "line 12: .* where the end was expected"),
    ("repetita.graph", "155000 1200", "155000", "line 11: .* where 6 fields"),
    ("repetita.graph", "9953280 3450", "fast 3450", "line 9: 'fast' where a number was expected"),
    ("repetita.graph", "edge_3 2 1", "edge_3 2 7", "a link names node '7', which is not among"),
    ("topohub.json", '"2": {"1": 2}', '"2": {"9": 2}', "a demand names node '9'"),
    ("realvnf.graphml", '<data key="d1">10</data>', '<data key="d1">-1</data>', "node '0': NodeCap is '-1'; it must"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "message"), DAMAGED)
def test_refuses_by_name(name, old, new, message, tmp_path):
    text = (FILES / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(ScenarioError, match=message):
        read_topology(tmp_path / name, 0)


@pytest.mark.parametrize("name", ["sndlib.txt", "sndlib.xml", "repetita.graph"])
def test_a_damaged_file_is_read_or_refused(name, tmp_path):
    """Bytes changed at random, 150 times: never another error than that of a file that is refused."""
    rng, content = np.random.default_rng(0), bytearray((FILES / name).read_bytes())
    for number in range(150):
        damaged = bytearray(content)
        for place in rng.integers(len(damaged), size=1 + number % 4):
            damaged[place] = rng.integers(32, 127)
        (tmp_path / name).write_bytes(damaged[: rng.integers(len(damaged))] if number % 5 == 0 else damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)
            try:
                read_topology(tmp_path / name, 0, directed="merge", largest_component=True)
            except ScenarioError as error:
                assert str(error)


# ---------------------------------------------------------------- TopoHub's package


def test_networks_of_topohubs_package():
    pytest.importorskip("topohub")
    with pytest.warns(ScenarioWarning, match=r"^topohub:sndlib/germany50: its 662 demands are used by arrivals"):
        substrate = read_topology("topohub:sndlib/germany50", 0)
    assert (substrate.num_nodes, substrate.num_links, substrate.labels[0]) == (50, 88, "Aachen")
    assert substrate.link_delay[0] == pytest.approx(61.63 / 200)


@pytest.mark.parametrize("key", ["sndlib/nowhere", "../data/sndlib/abilene", "abilene", ""])
def test_unknown_keys_of_topohub(key):
    pytest.importorskip("topohub")
    with pytest.raises(
        ScenarioError, match=r"TopoHub has no network .* of the groups backbone, caida, gabriel, sndlib"
    ):
        read_topology(f"topohub:{key}", 0)


def test_topohub_is_optional(monkeypatch):
    def missing(_: str) -> None:
        raise ModuleNotFoundError

    monkeypatch.setattr(topohub.resources, "files", missing)
    with pytest.raises(ScenarioError, match=r"needs the package topohub; install it with pip install topohub"):
        read_topology("topohub:sndlib/germany50", 0)
