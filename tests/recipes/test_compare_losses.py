"""Comparing losses: numbers from made-up runs by hand, and once for real at tiny size."""

from __future__ import annotations

import csv
import math

import pytest
from hydra import compose, initialize_config_dir
from inprocess import call, recipe
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING

AAR = {
    "dqn": [0.70, 0.80, 0.75],
    "n_step": [0.72, 0.83, 0.79],
    "random_feasible": [0.60],
    "greedy": [0.65],
    "myopic_optimal": [0.78],
}


# Pictures that are not looked at here would take a second each.
FEW = ["~figures.replay", "~figures.distributional", "~figures.policy_gradient"]


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def pretend(cells, store, workers):
    """Results as they would be: two workloads 0.02 apart around the AAR of each training seed; n_step lacks a seed."""
    for cell in cells:
        for need in (*cell.needs, cell):
            name, _, seed = need.label.removeprefix("test-").partition("-")
            if (name, seed) == ("n_step", "1"):
                continue
            aar = AAR[name][int(seed or 0)]
            if need.kind == "training":
                points = [{"frames": f, "aar": aar - 100 / f} for f in (1000, 2000)]
                store.write(need, {"eval": points, "processor_seconds": 100.0 + int(seed)})
            else:
                runs = {s: {"aar": aar + d, "cost_per_accepted": 500.0} for s, d in (("0", -0.01), ("1", 0.01))}
                store.write(need, {"metrics": runs})
    return {}


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """A comparison of made-up runs."""
    folder = tmp_path_factory.mktemp("losses")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recipe("compare_losses"), "compute_shown", pretend)
        call("compare_losses", "only=[dqn,n_step]", "seeds=3", "workloads=2", f"output={folder}", *FEW)
    return folder


def test_the_table_pairs_training_seeds(output):
    rows = {(row["method"], row["metric"], row["reference"]): row for row in rows_of(output / "losses.csv")}
    assert float(rows["dqn", "aar", ""]["mean"]) == pytest.approx(0.75)
    # Of seeds 0 and 2, which both have: differences 0.02, 0.04, t quantile for one degree 12.7062.
    paired = rows["n_step", "aar_difference", "dqn"]
    assert float(paired["mean"]) == pytest.approx(0.03) and int(paired["n"]) == 2
    assert float(paired["ci_high"]) == pytest.approx(0.03 + 12.7062 * math.sqrt(0.0002) / math.sqrt(2), abs=1e-6)
    assert float(rows["n_step", "aar_difference", "random_feasible"]["mean"]) == pytest.approx(0.155)
    assert float(rows["myopic_optimal", "aar_difference", "random_feasible"]["mean"]) == pytest.approx(0.18)
    assert ("dqn", "aar_difference", "dqn") not in rows
    # Of 0.69, 0.71, 0.74, 0.76, 0.79, 0.81 one is left out at either end.
    assert float(rows["dqn", "aar_iqm", ""]["mean"]) == pytest.approx(0.75)
    assert float(rows["dqn", "training_seconds", ""]["mean"]) == 101
    text = (output / "losses.md").read_text()
    assert "| n_step | 0.7550 ± " in text and "| greedy | 0.6500 | 0.6500 | – | +0.0500 | 500.0 | – |" in text
    assert "rho = " in text and "Not there yet: n_step: training seed 1." in text


@pytest.mark.parametrize("picture", ["learning_curves", "profiles"])
def test_rules_are_lines_in_every_picture(output, picture):
    for figure, losses in (("value_based", {"dqn", "n_step"}), ("memory", {"dqn"})):
        rows = rows_of(output / f"{picture}_{figure}.csv")
        assert {row["series"] for row in rows} == {*losses, "random_feasible", "greedy", "myopic_optimal"}
        assert {"png", "pdf"} <= {path.suffix[1:] for path in output.glob(f"{picture}_{figure}.*")}


def test_curves_and_profiles_by_hand(output):
    points = {(row["series"], float(row["x"])): row for row in rows_of(output / "learning_curves_value_based.csv")}
    assert float(points["dqn", 2000]["mean"]) == pytest.approx(0.75 - 0.05)
    assert float(points["random_feasible", 1000]["mean"]) == pytest.approx(0.6)
    profile = [row for row in rows_of(output / "profiles_value_based.csv") if row["series"] == "dqn"]
    shares = [(float(row["x"]), float(row["mean"])) for row in profile]
    aars = (0.69, 0.71, 0.74, 0.76, 0.79, 0.81)
    assert all(share == pytest.approx(sum(aar > tau for aar in aars) / 6) for tau, share in shares if tau not in aars)


def test_a_look_at_what_is_there(output, capsys):
    before = (output / "losses.md").read_bytes()
    call("compare_losses", "only=[dqn,n_step]", "seeds=3", "workloads=2", "compute=false", f"output={output}", *FEW)
    assert (output / "losses.md").read_bytes() == before and "n_step" in capsys.readouterr().out


def test_cells_stay_what_they_were():
    """A comparison that takes days is not computed anew because of an edit: no override may be added or moved."""
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose("compare_losses"), resolve=True)
    found = {name: recipe("compare_losses").training_cell(config, name, 3).spec["overrides"] for name in ("dqn", "ppo")}
    mine = ["seed=3", "eval.seeds=[1000,1001]", "logger.figures=false", "logger.references=false"]
    target = "target.value_network_update_interval=100"
    first = [
        "collector.total_frames=200000",
        target,
        "eval.interval=16",
        "preset=mlp",
        "loss=dqn",
        "exploration.over=100000",
    ]
    assert found["dqn"] == [*first, *mine]
    assert found["ppo"] == ["collector.total_frames=200000", "eval.interval=16", "pg_loss=ppo", *mine]


def test_an_unknown_loss_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit):
        call("compare_losses", "only=[dqm]", f"output={tmp_path}")
    assert "dqm" in capsys.readouterr().err


def test_for_real_and_not_twice(tmp_path):
    tiny = [text for text in TINY_TRAINING if not text.startswith(("eval.", "logger.figures"))]
    quoted = ",".join(f"'{text}'" for text in [*tiny, "collector.total_frames=96", "eval.interval=2"])
    arguments = [
        "only=[dqn,untrained]",
        "seeds=1",
        "workloads=2",
        "eval_seeds=[1000]",
        "parallel.jobs=1",
        f"output={tmp_path}",
        "~figures.memory",
        *FEW,
    ]
    call("compare_losses", *arguments, f"settings.dqn=[{quoted}]", *TINY_SCENARIO)
    assert "| dqn | " in (tmp_path / "losses.md").read_text()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}
    call("compare_losses", *arguments, f"settings.dqn=[{quoted}]", *TINY_SCENARIO)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}
