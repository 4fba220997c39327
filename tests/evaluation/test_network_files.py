"""``nfv-torchrl show``, ``convert`` and ``scan`` on small files of several formats."""

from __future__ import annotations

from pathlib import Path

import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.network_files import link_load, link_shares, main
from nfv_torchrl.scenario import Substrate
from nfv_torchrl.scenario.demand_files import read_demands
from nfv_torchrl.scenario.topology_zoo import read_network

FILES = Path(__file__).parents[1] / "scenario" / "formats"


def test_demands_load_the_links_of_their_fastest_paths(recwarn):
    """Rome - Bern takes 3.45 ms by their link and 6.1 ms over Graz, so each demand loads one link."""
    network = read_network(FILES / "topohub.json", 0)
    load, lost = link_load(network.substrate, network.numbers.file.demands)
    assert (load.tolist(), lost) == ([34.0, 6.5, 2.0], 0)
    share, what = link_shares(network)
    assert (share.tolist(), what) == (pytest.approx([1.0, 6.5 / 34, 2 / 34]), "demands, share of the busiest link")
    share, what = link_shares(read_network(FILES / "sndlib.txt", 0))  # 0.375 Mbit/s of 2500, two times 10 of 622
    assert (share[:2].tolist(), what) == (pytest.approx([0.375 / 2500, 20 / 622]), "demands over capacity")


def test_a_load_over_two_links_and_nodes_that_are_not_there(recwarn):
    """Repetita's demands 0 - 1 and 2 - 0 (by 1), in kbit/s; in a network without node 2 the latter is lost."""
    demands = read_demands(FILES / "repetita.demands")
    load, lost = link_load(read_network(FILES / "repetita.graph", 0).substrate, demands)
    assert (load.tolist(), lost) == ([300_632.0 + 158_179.0, 158_179.0], 0)
    load, lost = link_load(read_network(FILES / "gephi.graphml", 0).substrate, demands)
    assert (load.tolist(), lost) == ([0.0], 2)


def test_show(tmp_path, capsys):
    main(["show", str(FILES / "virne.gml"), "--output", str(tmp_path / "net.png")])
    text = capsys.readouterr().out
    assert "3 nodes, 2 links, 3 VMs" in text
    assert "vm_capacity   Mcycles/s              3 of 3 nodes in the file" in text
    assert "delay         ms                     0 of 2 links in the file" in text
    assert "max_bw (links), pos (nodes), max_cpu (nodes)" in text
    assert (tmp_path / "net.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit):
        main(["show", str(FILES / "virne.gml"), "--output", str(tmp_path / "net.png")])
    assert "net.png: exists already" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(path.name for path in FILES.iterdir() if path.suffix != ".demands"))
def test_what_is_converted_is_the_network_that_was_read(name, tmp_path, recwarn):
    main(["convert", str(FILES / name), str(tmp_path / "net.json"), "--seed", "3"])
    written, read = Substrate.from_json(tmp_path / "net.json"), read_network(FILES / name, 3).substrate
    for field in ("links", "link_capacity", "link_delay", "link_unit_cost", "vm_count", "vm_capacity", "vm_unit_cost"):
        assert getattr(written, field).tolist() == getattr(read, field).tolist()
    assert (written.ids, written.labels) == (read.ids, read.labels)
    again = read_network(tmp_path / "net.json", 99).substrate
    assert again.link_capacity.tolist() == read.link_capacity.tolist()
    assert (tmp_path / "net.demands.csv").exists() == (name in ("sndlib.txt", "sndlib.xml", "topohub.json"))


def test_demands_alone_and_options(tmp_path, capsys):
    main(["convert", str(FILES / "repetita.demands"), str(tmp_path / "d.csv")])
    assert (tmp_path / "d.csv").read_text().splitlines()[1:] == ["0,1,300632.0,kbit/s,", "2,0,158179.0,kbit/s,"]
    main(["show", str(FILES / "virne.gml"), "--attributes", "{capacity: {name: bw, unit: Gbit/s}}"])
    assert "54,000 to 86,000 Mbit/s" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["convert", str(FILES / "virne.gml"), str(tmp_path / "v.csv")])
    assert "virne.gml: holds no demands" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["convert", str(FILES / "virne.gml"), str(tmp_path / "v.gml")])
    assert "choose one of these endings" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["d.csv"]


def test_scan(tmp_path, capsys):
    main(["scan", str(FILES), "--limit", "3"])
    assert "3 files, 3 read, 0 refused" in capsys.readouterr().out
    (tmp_path / "bad.gml").write_text("graph")
    with pytest.raises(SystemExit) as stopped:
        main(["scan", str(tmp_path), str(FILES)])
    text = capsys.readouterr().out
    assert stopped.value.code == 1
    assert "refused: " in text and "bad.gml: is not valid GML" in text
    assert "1 files, 0 read, 1 refused" in text and "13 files, 13 read, 0 refused" in text


def test_scan_of_topohub():
    pytest.importorskip("topohub")
    main(["scan", "topohub:sndlib", "topohub:gabriel", "--limit", "2"])
    with pytest.raises(SystemExit):
        main(["scan", "topohub:nothing"])


def test_a_file_without_demands():
    with pytest.raises(ScenarioError, match=r"virne.gml: holds no demands"):
        read_demands(FILES / "virne.gml")
