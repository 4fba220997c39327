"""The field's benchmark, for real at tiny size: its table, picture and manifest."""

from __future__ import annotations

import csv
import json

import pytest
from inprocess import call
from tiny import ROOT

from nfv_torchrl.evaluation.pivot import result_row
from nfv_torchrl.evaluation.statistics import Interval
from nfv_torchrl.experiments.field import field_table, limited
from nfv_torchrl.experiments.rows import lowest, together
from nfv_torchrl.experiments.transfer import POLICY
from nfv_torchrl.scenario.scenario import Scenario

POLICIES = ROOT / "docs" / "results" / "policies"

pytest.importorskip("topohub", reason="the networks of set=traffic are TopoHub's")


def test_it_compares_pairs_and_freezes(tmp_path, capsys):
    output, manifest = tmp_path / "out", tmp_path / "traffic.json"
    published = "published=[{place: abilene, load: 2, method: theirs, aar: 0.5, source: 'a paper'}]"
    policies = f"checkpoints=[{POLICIES / 'general.pt'},{POLICIES / 'heavy.pt'}]"
    small = "overrides=['scenario.horizon=20','scenario.arrival_rate=4']"
    call(
        "field", "set=traffic", "only=[abilene]", "seeds=2", "method=[greedy,myopic_optimal,checkpoint]", policies,
        "parallel.jobs=1", "places.abilene.loads=[2]", small, published, f"output={output}", f"freeze={manifest}",
    )  # fmt: skip
    with (output / "field.csv").open() as file:
        rows = {(row["method"], row["metric"], row["reference"]): row for row in csv.DictReader(file)}
    aar = {name: float(rows[name, "aar", ""]["mean"]) for name in ("greedy", "myopic_optimal", "bound: hindsight")}
    assert (
        0 < aar["greedy"] <= aar["bound: hindsight"] + 1e-9 and aar["myopic_optimal"] <= aar["bound: hindsight"] + 1e-9
    )
    difference = rows["greedy", "aar_difference", "myopic_optimal"]
    assert float(difference["mean"]) == pytest.approx(aar["greedy"] - aar["myopic_optimal"])
    least, both = (float(rows[POLICY, f"aar_difference{part}", "myopic_optimal"]["mean"]) for part in ("_lowest", ""))
    assert least <= both == pytest.approx(float(rows[POLICY, "aar", ""]["mean"]) - aar["myopic_optimal"])
    assert rows["theirs", "aar", ""]["source"] == "a paper" and rows["theirs", "aar", ""]["ci_low"] == ""
    printed = capsys.readouterr().out
    assert "theirs" in printed and "lowest training seed" in printed and f"{least:+.4f}" in printed
    assert (output / "field.png").stat().st_size > 0

    runs = json.loads(manifest.read_text())["runs"]
    assert list(runs) == ["abilene-2-seed_0", "abilene-2-seed_1"]
    assert [run["scenario"]["seed"] for run in runs.values()] == [0, 1]
    assert runs["abilene-2-seed_1"]["rows"]["greedy"]["aar"] <= 1
    mean = sum(run["rows"]["greedy"]["aar"] for run in runs.values()) / 2
    assert mean == pytest.approx(aar["greedy"])


def test_the_lowest_of_several_training_seeds():
    samples = [[0.1, 0.3], [0.0, 0.1], [0.2, 0.2]]
    assert lowest(samples).mean == pytest.approx(0.05) and together(samples).mean == pytest.approx(0.15)


MATRIX = """<?xml version="1.0"?>
<network xmlns="http://sndlib.zib.de/network" version="1.0">
 <meta><time>20040301-{time}</time><unit>MBITPERSEC</unit></meta>
 <networkStructure><nodes>{nodes}</nodes></networkStructure>
 <demands>
  <demand id="d"><source>{source}</source><target>{target}</target><demandValue>{value}</demandValue></demand>
 </demands>
</network>
"""


def matrices(folder, *demands):
    """A folder of SNDlib's demand matrices, five minutes apart, with one demand each."""
    folder.mkdir(parents=True)
    places = ["ATLAng", "CHINng", "NYCMng"]
    nodes = "".join(
        f'<node id="{name}"><coordinates><x>0</x><y>{place}</y></coordinates></node>'
        for place, name in enumerate(places)
    )
    for number, (source, target, value) in enumerate(demands):
        text = MATRIX.format(time=f"00{5 * number:02}", nodes=nodes, source=source, target=target, value=value)
        (folder / f"demandMatrix-{number}.xml").write_text(text)


@pytest.mark.parametrize(("low", "shown"), [(1200.0, "1,200"), (1200.0 - 1e-10, "1,200"), (1100.0, "1,200 ± 100")])
def test_runs_that_were_timed_together_have_one_time_and_no_interval(low, shown):
    about = {"network": "geant", "load": 1.0}
    rows = [
        result_row(about, "greedy", "aar", Interval(1.0, 1.0, 1.0, 5)),
        result_row(about, "greedy", "decisions_per_second", Interval(1200.0, low, 2400.0 - low, 5)),
    ]
    ((_, acceptance, speed, *_),) = field_table("", rows, "greedy", "rho").rows
    assert (acceptance, speed) == ("1.0000 ± 0.0000", shown)


def test_measured_demands_from_a_folder(tmp_path, capsys):
    """Two matrices, each held for five slots: who talks to whom changes with them."""
    matrices(tmp_path / "abilene", ("ATLAng", "CHINng", 1.0), ("CHINng", "NYCMng", 3.0))
    output, manifest = tmp_path / "out", tmp_path / "week.json"
    call(
        "field", "set=week", f"data={tmp_path}", "only=[abilene]", "seeds=1", "method=[greedy]", "reference=greedy",
        "places.abilene.loads=[1]", "parallel.jobs=1", "bounds=false", f"output={output}", f"freeze={manifest}",
        "overrides=['scenario.horizon=10','scenario.arrivals.interval=5']",
    )  # fmt: skip
    (run,) = json.loads(manifest.read_text())["runs"].values()
    scenario = Scenario.from_config(run["scenario"])
    workload, names = scenario.workload(0), scenario.substrate.labels
    ends = set(zip((workload.slot // 5).tolist(), workload.ingress.tolist(), workload.egress.tolist(), strict=True))
    ends = {(half, names[ingress], names[egress]) for half, ingress, egress in ends}
    assert ends == {(0, "ATLAng", "CHINng"), (1, "CHINng", "NYCMng")}
    assert 2 < (workload.slot >= 5).sum() / (workload.slot < 5).sum() < 4.5
    assert "abilene, 1 rho: greedy" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "said"),
    [([], "data: is missing"), (["data=nowhere"], "places.abilene: arrivals.path: 'nowhere/abilene'")],
)
def test_demands_that_are_not_there_are_said_before_any_work(given, said, tmp_path, capsys):
    with pytest.raises(SystemExit):
        call("field", "set=week", *given, f"output={tmp_path / 'out'}")
    assert (error := capsys.readouterr().err).count(said) == 1 and error.count("error") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("named", [[], ["checkpoint=nowhere.pt"], ["checkpoints=[nowhere.pt,nor_there.pt]"]])
def test_a_policy_that_is_not_there_is_refused_before_anything_is_written(named, tmp_path, capsys):
    output = tmp_path / "out"
    with pytest.raises(SystemExit):
        call("field", "set=traffic", "only=[abilene]", "method=[greedy,checkpoint]", *named, f"output={output}")
    assert "is no file; name one" in capsys.readouterr().err
    assert not output.exists()


@pytest.mark.parametrize("named", ["checkpoint=mine.pt", "checkpoints=[mine.pt,other.pt]"])
@pytest.mark.parametrize("recipe", ["field", "transfer"])
def test_a_policy_that_no_method_reads_is_refused(recipe, named, tmp_path, capsys):
    extra = ["set=traffic"] if recipe == "field" else []
    with pytest.raises(SystemExit):
        call(recipe, *extra, "method=[greedy,myopic_optimal]", named, f"output={tmp_path / 'out'}")
    assert "mine.pt" in (said := capsys.readouterr().err) and "would not be read" in said
    assert not (tmp_path / "out").exists()


def test_the_limit_of_the_set_goes_to_exact_searches_that_have_none_of_their_own():
    free, own, other = ({"planner": planner} for planner in ({"labels": None}, {"labels": 7}, {"paths": 10}))
    assert limited(free, 50) == {"planner": {"labels": 50}} and limited(free, None) == free
    assert limited(own, 50) == own and limited(other, 50) == other
    assert limited({"path": "best.pt"}, 50) == {"path": "best.pt"}
