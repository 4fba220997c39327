"""Comparing losses: numbers from made-up runs by hand, and once for real at tiny size."""

from __future__ import annotations

import csv
import math

import pytest
from inprocess import call, recipe
from tiny import TINY_SCENARIO, TINY_TRAINING

AAR = {
    "dqn": [0.70, 0.80, 0.75],
    "n_step": [0.72, 0.83, 0.79],
    "random_feasible": [0.60],
}


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def pretend(cells, store, *, workers, report):
    """Results as they would be: two workloads 0.02 apart around the AAR of each training seed."""
    for cell in cells:
        for need in (*cell.needs, cell):
            name, _, seed = need.label.removeprefix("test-").partition("-")
            aar = AAR[name][int(seed or 0)]
            if need.kind == "training":
                store.write(need, {"eval": [{"frames": f, "aar": aar - 100 / f} for f in (1000, 2000)]})
            else:
                runs = {s: {"aar": aar + d, "cost_per_accepted": 500.0} for s, d in (("0", -0.01), ("1", 0.01))}
                store.write(need, {"metrics": runs})
    return {}


def test_the_table_pairs_training_seeds(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recipe("compare_losses"), "compute", pretend)
    call("compare_losses", "only=[dqn,n_step]", "workloads=2", f"output={tmp_path}")
    rows = {(row["method"], row["metric"], row["reference"]): row for row in rows_of(tmp_path / "losses.csv")}
    assert float(rows["dqn", "aar", ""]["mean"]) == pytest.approx(0.75)
    # Differences 0.02, 0.03, 0.04: mean 0.03, standard deviation 0.01, t quantile for two degrees 4.3027.
    paired = rows["n_step", "aar_difference", "dqn"]
    assert float(paired["mean"]) == pytest.approx(0.03)
    assert float(paired["ci_high"]) == pytest.approx(0.03 + 4.302653 * 0.01 / math.sqrt(3))
    assert float(rows["n_step", "aar_difference", "random_feasible"]["mean"]) == pytest.approx(0.18)
    assert ("dqn", "aar_difference", "dqn") not in rows
    text = (tmp_path / "losses.md").read_text()
    assert "| n_step | 0.7800 ± " in text and "| +0.0300 ± 0.0248 |" in text and "rho = " in text
    curve = rows_of(tmp_path / "learning_curves_value_based.csv")
    points = {(row["series"], float(row["x"])): float(row["mean"]) for row in curve}
    assert points["dqn", 2000] == pytest.approx(0.75 - 0.05)
    assert points["random_feasible", 1000] == pytest.approx(0.6)
    assert {"png", "pdf"} <= {path.suffix[1:] for path in tmp_path.glob("learning_curves_value_based.*")}


def test_an_unknown_loss_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit):
        call("compare_losses", "only=[dqm]", f"output={tmp_path}")
    assert "dqm" in capsys.readouterr().err


def test_for_real_and_not_twice(tmp_path, monkeypatch, capsys):
    tiny = [text for text in TINY_TRAINING if not text.startswith(("eval.", "logger.figures"))]
    quoted = ",".join(f"'{text}'" for text in [*tiny, "collector.total_frames=96", "eval.interval=2"])
    arguments = ["only=[dqn]", "seeds=1", "workloads=2", "eval_seeds=[1000]", "parallel.jobs=1", f"output={tmp_path}"]
    call("compare_losses", *arguments, f"settings.dqn=[{quoted}]", *TINY_SCENARIO)
    assert "| dqn | " in (tmp_path / "losses.md").read_text()
    done = []
    monkeypatch.setattr(recipe("compare_losses"), "print_progress", lambda cell, at_work: done.append(cell))
    call("compare_losses", *arguments, f"settings.dqn=[{quoted}]", *TINY_SCENARIO)
    assert not done
