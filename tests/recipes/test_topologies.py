"""Many networks, run for real at tiny size."""

from __future__ import annotations

import csv

import pytest
from inprocess import call

TINY = ["scenario.horizon=40", "scenario.mean_lifetime=30", "scenario.arrival_rate=5", "seeds=2"]


def test_a_row_for_each_network_and_load(tmp_path, capsys):
    call("topologies", *TINY, "networks=[abilene,nsfnet]", "rho=[0.5,40]", f"output={tmp_path}")
    assert "nothing found" in capsys.readouterr().out
    with (tmp_path / "topologies.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["network"] for row in rows] == [f"{n}, rho {r}" for n in ("abilene", "nsfnet") for r in ("0.5", "40")]
    assert [row["N"] for row in rows] == ["11", "11", "13", "13"]
    assert [row["rho"].split()[0] for row in rows] == ["0.50", "40.00"] * 2
    light, heavy = (float(rows[k]["AAR greedy"].split()[0]) for k in (0, 1))
    assert heavy < light <= 1
    assert (tmp_path / "topologies.md").read_text().count("\n| abilene") == 2


def test_an_unknown_network_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit):
        call("topologies", *TINY, "networks=[abilen]", f"output={tmp_path}")
    assert "networks: there is no 'abilen'" in capsys.readouterr().err
