"""Tuning of `priced`: every setting is listed, the gains are paired, the choices are the best of their kind."""

from __future__ import annotations

import csv

import pytest
from tiny import run

SMALL = [
    "scenario.substrate.nodes=5",
    "scenario.horizon=60",
    "loads=[{arrival_rate: 30, mean_lifetime: 60}]",
    "colocation=[true]",
    "scenario_seeds=[100,101]",
    "prices=[0,400]",
    "steepness=[3000]",
    "thresholds=[null,500]",
    "parallel.jobs=1",
]


def test_all_settings_best_first(tmp_path):
    done = run("tune_priced.py", *SMALL, f"output={tmp_path / 'tune.csv'}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "tune.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    gains = [float(row["aar_gain"]) for row in rows]
    assert gains == sorted(gains, reverse=True)
    (unpriced,) = [row for row in rows if float(row["price"]) == 0 and not row["threshold"]]
    assert float(unpriced["aar_gain"]) == pytest.approx(0, abs=1e-12)  # without a price it is myopic_optimal
    best = next(row for row in rows if not row["threshold"])
    assert f"best for priced: price={float(best['price']):g} steepness=3000" in done.stdout


def test_no_network_is_an_error(tmp_path):
    done = run("tune_priced.py", "scenario_seeds=[]", cwd=tmp_path)
    assert done.returncode == 2 and "scenario_seeds" in done.stderr
