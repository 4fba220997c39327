"""The field's benchmark, for real at tiny size: its table, picture and manifest."""

from __future__ import annotations

import csv
import json

import pytest
from inprocess import call

pytest.importorskip("topohub", reason="the networks of set=traffic are TopoHub's")


def test_it_compares_pairs_and_freezes(tmp_path, capsys):
    output, manifest = tmp_path / "out", tmp_path / "traffic.json"
    published = "published=[{place: abilene, load: 2, method: theirs, aar: 0.5, source: 'a paper'}]"
    call(
        "field", "set=traffic", "only=[abilene]", "seeds=2", "method=[greedy,myopic_optimal]", "parallel.jobs=1",
        "places.abilene.loads=[2]", "overrides=['scenario.horizon=20','scenario.arrival_rate=4']", published,
        f"output={output}", f"freeze={manifest}",
    )  # fmt: skip
    with (output / "field.csv").open() as file:
        rows = {(row["method"], row["metric"], row["reference"]): row for row in csv.DictReader(file)}
    aar = {name: float(rows[name, "aar", ""]["mean"]) for name in ("greedy", "myopic_optimal", "bound: hindsight")}
    assert (
        0 < aar["greedy"] <= aar["bound: hindsight"] + 1e-9 and aar["myopic_optimal"] <= aar["bound: hindsight"] + 1e-9
    )
    difference = rows["greedy", "aar_difference", "myopic_optimal"]
    assert float(difference["mean"]) == pytest.approx(aar["greedy"] - aar["myopic_optimal"])
    assert rows["theirs", "aar", ""]["source"] == "a paper" and rows["theirs", "aar", ""]["ci_low"] == ""
    assert "theirs" in capsys.readouterr().out and (output / "field.png").stat().st_size > 0

    runs = json.loads(manifest.read_text())["runs"]
    assert list(runs) == ["abilene-2-seed_0", "abilene-2-seed_1"]
    assert [run["scenario"]["seed"] for run in runs.values()] == [0, 1]
    assert runs["abilene-2-seed_1"]["rows"]["greedy"]["aar"] <= 1
    mean = sum(run["rows"]["greedy"]["aar"] for run in runs.values()) / 2
    assert mean == pytest.approx(aar["greedy"])


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
