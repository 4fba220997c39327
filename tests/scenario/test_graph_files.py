"""Network files of every format: the same graph from each, and every flaw refused in one line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import networkx as nx
import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario import graph_files
from nfv_torchrl.scenario.formats import graph as graphs
from nfv_torchrl.scenario.formats import xml
from nfv_torchrl.scenario.graph_files import GraphFile, read_graph_file

HEAD = '<graphml xmlns="http://graphml.graphdrawing.org/xmlns">'
KEYS = (
    '<key id="d0" for="node" attr.name="label" attr.type="string"/>'
    '<key id="d1" for="edge" attr.name="bw" attr.type="double"><default>7</default></key>'
    '<key id="d2" for="all" attr.name="note" attr.type="string"/>'
)
GRAPHML = (
    KEYS + '<graph edgedefault="undirected"><node id="a"><data key="d0">A</data></node><node id="b"/><node id="c"/>'
    '<edge source="a" target="b"/><edge source="b" target="c"><data key="d1">5</data></edge></graph></graphml>'
)


def read(folder: Path, content: str | bytes, name: str) -> GraphFile:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_graph_file(path)


def node_link(nodes: list, links: list, key: str = "links", **rest) -> str:
    return json.dumps({"nodes": nodes, key: links, **rest})


# ---------------------------------------------------------------- GraphML


@pytest.mark.parametrize("head", [HEAD, "<graphml>", '<?xml version="1.0"?>\n<!DOCTYPE graphml>\n<graphml>'])
def test_graphml_with_and_without_namespace(head, tmp_path):
    """The key's default holds where an edge says nothing; attributes of one kind do not reach the other."""
    file = read(tmp_path, head + GRAPHML, "n.graphml")
    assert file.ids == ["a", "b", "c"]
    assert file.nodes == [{"label": "A"}, {}, {}]
    assert file.ends == [(0, 1), (1, 2)]
    assert file.links == [{"bw": "7"}, {"bw": "5"}]
    assert not file.directed


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1", "utf-8-sig", "cp1252"])
def test_graphml_in_the_encoding_it_declares(encoding, tmp_path):
    declared = {"utf-8-sig": "utf-8"}.get(encoding, encoding)
    text = f'<?xml version="1.0" encoding="{declared}"?>' + HEAD + GRAPHML.replace(">A<", ">Zürich<")
    assert read(tmp_path, text.encode(encoding), "n.graphml").nodes[0] == {"label": "Zürich"}


def test_graphml_parallel_edges_with_one_id_stay_apart(tmp_path):
    edge = '<edge id="e" source="a" target="b"/>'
    file = read(tmp_path, f'{HEAD}<graph><node id="a"/><node id="b"/>{edge}{edge}</graph></graphml>', "n.graphml")
    assert file.ends == [(0, 1), (0, 1)]


def test_graphml_of_yed_has_its_labels_in_drawings(tmp_path):
    drawing = '<y:ShapeNode xmlns:y="http://www.yworks.com/xml/graphml"><y:Fill/><y:NodeLabel> 5\n<x/></y:NodeLabel>'
    inside = f'<node id="n0"><data key="d6">{drawing}</y:ShapeNode></data></node><node id="n1"/>'
    file = read(tmp_path, graph(inside, '<key id="d6" for="node" yfiles.type="nodegraphics"/>'), "n.graphml")
    assert file.nodes == [{"label": "5"}, {}]


def test_graphml_of_networkx_is_read(tmp_path):
    graph = nx.relabel_nodes(nx.cycle_graph(4), {node: f"n{node}" for node in range(4)})
    nx.set_edge_attributes(graph, 10.5, "capacity")
    nx.write_graphml(graph, tmp_path / "n.graphml")
    file = read_graph_file(tmp_path / "n.graphml")
    assert [sorted(pair) for pair in file.ends] == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert file.links == [{"capacity": "10.5"}] * 4


BOMB = '<!DOCTYPE g [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
EXTERNAL = '<!DOCTYPE g [<!ENTITY a SYSTEM "file:///etc/hostname">]>'


def graph(inside: str, keys: str = "", attributes: str = "") -> str:
    return f"{HEAD}{keys}<graph {attributes}>{inside}</graph></graphml>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB + graph('<node id="&b;"/>'), r"line 1: entity 'a', which is never expanded"),
        (EXTERNAL + graph('<node id="a"/><x>&a;</x>'), r"entity 'a'"),
        ('<!DOCTYPE graphml SYSTEM "graphml.dtd">' + graph("<x>&a;</x>"), r"entity 'a'"),
        (graph('<node id="a"/><edge source="a" target="x"/>'), r"names node 'x', which is not among 'nodes'"),
        (graph('<node id="a"/>\n<node id="a"/>'), r"two nodes have the same 'id' 'a'"),
        (graph("\n<node/>"), r"line 2: a <node> without 'id'"),
        (graph('<node id="a"/>\n<edge source="a"/>'), r"line 2: a <edge> without 'target'"),
        (graph('<node id="a"><graph><node id="b"/></graph></node>'), r"line 1: a <graph> inside a graph"),
        (graph('<hyperedge><endpoint node="a"/></hyperedge>'), r"a <hyperedge> inside"),
        (graph('<node id="a"><data key="k">1</data></node>'), r"key 'k' is not declared"),
        (graph('<node id="a"/><edge source="a" target="a" directed="true"/><edge source="a" target="a"/>'), "directed"),
        (f"{HEAD}</graphml>", r"holds 0 graphs"),
        (f"{HEAD}<graph/><graph/></graphml>", r"holds 2 graphs"),
        ('<graphml xmlns="http://example.org/other"><graph/></graphml>', r"<http://example.org/other graphml> where"),
        ("<a>" * 60, r"elements 51 deep"),
        ('<?xml version="1.0" encoding="klingon"?><graphml/>', r"is not valid GraphML"),
        ("\x00\x01\x02", r"is not valid GraphML"),
        (graph("<node id='\ud800'/>").encode("utf-8", "surrogatepass"), r"is not valid GraphML"),
    ],
)
def test_refuses_graphml(text, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        read(tmp_path, text, "n.graphml")


# ---------------------------------------------------------------- GML

GML = 'graph [ node [ id 1 label "Zürich" ] node [ id 2 ] edge [ source 1 target 2 bw 5 ] ]'


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_gml_in_every_encoding(encoding, tmp_path):
    file = read(tmp_path, GML.encode(encoding), "n.gml")
    assert (file.ids, file.nodes, file.links) == ([1, 2], [{"label": "Zürich"}, {}], [{"bw": 5}])


@pytest.mark.parametrize("header", ["", "multigraph 0", "multigraph\n1"])
def test_gml_keys_in_a_line_do_not_hide_parallel_links(header, tmp_path):
    """Keys and brackets in strings and comments are text."""
    text = (
        f'# a "comment [\nCreator "graph [ key 3"\ngraph [ {header} node [ id 1 label "key 5 [" ]\n node [ id 2 ]\n'
        'edge [ source 1 target 2 key 0 bw 5 ] edge [ source 2 target 1 key 0 ]\nedge [ source 1 target 2 key "x" ] ]'
    )
    file = read(tmp_path, text, "n.gml")
    assert file.nodes[0] == {"label": "key 5 ["}
    assert [sorted(pair) for pair in file.ends] == [[0, 1]] * 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("graph [ node [ id 1 ] edge [ source 1 target 3 ] ]", r"edge #0 has undefined target 3"),
        ("graph [ node [ id 1 ] node [ id 1 ] ]", r"node id 1 is duplicated"),
        ("graph [ node [ label 1 ] ]", r"no 'id'"),
        ("a [ " * 60, r"brackets 51 deep"),
        ("graph [\n\n node [ id ? ] ]", r"\(3, "),
        (b"graph [ \xff\x00\x07 ]", r"neither UTF-8 nor Latin-1"),
        (b"\xff\xfe\x00", r"neither UTF-8 nor Latin-1"),
        ("x" * 100_000 + " ?", r"is not valid GML .{1,300}$"),
    ],
)
def test_refuses_gml(text, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        read(tmp_path, text, "n.gml")


# ---------------------------------------------------------------- JSON


@pytest.mark.parametrize("key", ["links", "edges"])
def test_node_link_as_networkx_reads_it(key, tmp_path):
    """Lists are tuples; ids that are 0 .. N-1 are the nodes' numbers in any order."""
    text = node_link([{"id": [0, "x"]}, {"id": 1.5}], [{"source": [0, "x"], "target": 1.5, "key": 0, "w": 1}], key)
    file = read(tmp_path, text, "n.json")
    assert (file.ids, file.ends, file.links) == ([(0, "x"), 1.5], [(0, 1)], [{"w": 1}])
    assert set(file.to_networkx().nodes) == set(nx.node_link_graph(json.loads(text), edges=key).nodes)
    turned = read(tmp_path, node_link([{"id": 1, "label": "B"}, {"id": 0}], [{"source": 1, "target": 0}]), "n.json")
    assert (turned.ids, turned.nodes, turned.ends) == ([0, 1], [{}, {"label": "B"}], [(1, 0)])


def test_hostile_names_of_attributes_are_names(tmp_path):
    names = {"incoming_graph_data": 1, "node_for_adding": 1, "u_for_edge": 1, "self": 1}
    text = node_link([{"id": 0, **names}, {"id": 1}], [{"source": 0, "target": 1, **names}], graph=names)
    file = read(tmp_path, text, "n.json")
    assert file.to_networkx().graph == file.attributes == names


def test_parallel_links_need_a_multigraph(tmp_path):
    nodes, links = [{"id": "a"}, {"id": "b"}], [{"source": "a", "target": "b"}, {"source": "b", "target": "a"}]
    assert len(read(tmp_path, node_link(nodes, links, multigraph=True), "n.json").ends) == 2
    assert len(read(tmp_path, node_link(nodes, links, multigraph=False, directed=True), "n.json").ends) == 2
    with pytest.raises(ScenarioError, match=r"link 'b' - 'a' is there twice though 'multigraph' is false"):
        read(tmp_path, node_link(nodes, links, multigraph=False), "n.json")


@pytest.mark.parametrize(
    ("nodes", "links", "rest", "message"),
    [
        ([{"id": None}], [], {}, r"nodes\[0\]: 'id' is None; use text, a number"),
        ([{"id": True}], [], {}, r"'id' is True"),
        ([{"id": {}}], [], {}, r"'id' is {}"),
        ([{"id": [None]}], [], {}, r"'id' is \[None\]"),
        ([{"id": float("nan")}], [], {}, r"'id' is nan"),
        ([{}], [], {}, r"nodes\[0\]: 'id' is missing"),
        ([3], [], {}, r"nodes\[0\] is 3; an object"),
        ([{"id": 1}, {"id": 1.0}], [], {}, r"two nodes have the same 'id' 1"),
        ([{"id": 1}, {"id": "1"}], [], {}, r"two nodes have the 'id' '1', one as text"),
        ([{"id": 1}], [{"source": 1}], {}, r"links\[0\]: 'target' is missing"),
        ([{"id": 1}], [{"source": 1, "target": "1"}], {}, r"a link names node '1', which is not among"),
        ([{"id": 1}], [], {"edges": []}, r"both 'links' and 'edges'"),
        ([{"id": 1}], [], {"directed": "no"}, r"'directed' is 'no'; use true or false"),
        ([{"id": 1}], [], {"graph": [1]}, r"'graph' is \[1\]"),
        (None, [], {}, r"needs the lists 'nodes' and 'links'"),
    ],
)
def test_refuses_json(nodes, links, rest, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        read(tmp_path, node_link(nodes, links, **rest), "n.json")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a": ' + "9" * 5000 + "}", "", "\x00", "{", '{"a": [{"b": 1, "b": 2}]}']
)
def test_refuses_what_is_no_json(text, tmp_path):
    with pytest.raises(ScenarioError, match=r"n.json: is not valid JSON"):
        read(tmp_path, text, "n.json")


# ---------------------------------------------------------------- limits


def test_limits(tmp_path, monkeypatch):
    monkeypatch.setattr(graphs, "MAX_NODES", 2)
    with pytest.raises(ScenarioError, match=r"has 3 nodes, and one table .* take 0.0 GB; .* at most 2 nodes"):
        read(tmp_path, HEAD + GRAPHML, "n.graphml")
    monkeypatch.setattr(graphs, "MAX_NODES", 3)
    monkeypatch.setattr(graphs, "MAX_LINKS", 1)
    with pytest.raises(ScenarioError, match=r"has 2 links; give a network of at most 1"):
        read(tmp_path, HEAD + GRAPHML, "n.graphml")
    monkeypatch.setattr(xml, "MAX_ENTRIES", 4)
    with pytest.raises(ScenarioError, match=r"has more than 4 elements"):
        read(tmp_path, HEAD + GRAPHML, "n.graphml")
    monkeypatch.setattr(graph_files, "MAX_ENTRIES", 2)
    with pytest.raises(ScenarioError, match=r"has more than 2 brackets"):
        read(tmp_path, GML, "n.gml")
    monkeypatch.setattr(graph_files, "MAX_NETWORK_BYTES", 10)
    with pytest.raises(ScenarioError, match=r"more than the 0 MB that are read"):
        read(tmp_path, GML, "n.gml")


@pytest.mark.parametrize("suffix", ["json", "gml", "graphml"])
def test_only_regular_files_are_read(suffix, tmp_path):
    path = tmp_path / f"n.{suffix}"
    os.mkfifo(path)
    with pytest.raises(ScenarioError, match="it is a pipe or device; give a regular file"):
        read_graph_file(path)
    path.unlink()
    path.symlink_to("/proc/self/status")
    with pytest.raises(ScenarioError, match="its size changes"):
        read_graph_file(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ScenarioError, match="it is a pipe or device; give a regular file"):
        read_graph_file(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(ScenarioError, match="it is a folder; give a regular file"):
        read_graph_file(path)
