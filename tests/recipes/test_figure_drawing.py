"""Every figure drawn from made-up cells, so without computing any: what titles, tables and panels say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tiny import ROOT

from nfv_torchrl.experiments.catalogue import FIGURES
from nfv_torchrl.experiments.cells import CellStore, with_needs
from nfv_torchrl.experiments.study import Study

PAPER = {
    "aar_over_iterations", "anuc_over_iterations", "anuc_vs_requests", "aar_vs_cost_weight", "anuc_vs_cost_weight",
    "presence_probability", "aar_vs_lifetime", "aar_vs_nodes", "anuc_vs_nodes", "decision_time_vs_nodes",
}  # fmt: skip
AAR = {"dqn_ar": 0.85, "myopic_optimal": 0.8, "greedy": 0.6}
BLIND, HINDSIGHT = 0.9, 0.95


def study(*overrides: str) -> Study:
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose("figures", list(overrides)), resolve=True)
    return Study(config, ROOT / "recipes")


def fill(figure: str, made: Study, store: CellStore) -> None:
    """Give every cell of a figure a made-up result: AAR of ``AAR`` and a little of the seed's."""
    for cell in with_needs(FIGURES[figure].cells(made)):
        seeds = [str(seed) for seed in cell.spec.get("seeds", [])]
        if cell.kind == "evaluation":
            aar = AAR.get(cell.spec["method"].get("name", next(iter(cell.spec["method"]))), 0.7)
            keys = {"anuc": 1e6, "mean_hops": 3.0, "paper_reward": 4.0, "frames": 50_000}
            runs = {seed: {"aar": aar + int(seed) / 1000, **keys} for seed in seeds}
            store.write(cell, {"rho": 1.0, "metrics": runs})
            np.savez_compressed(store.path(cell).with_suffix(".npz"), **dict.fromkeys(seeds, np.full(3, 100 * aar)))
        elif cell.kind == "bound":
            values = {"hindsight": HINDSIGHT, "blind": BLIND}
            store.write(cell, {"rho": 1.0, "bounds": {k: dict.fromkeys(seeds, v) for k, v in values.items()}})
        elif cell.kind == "presence":
            store.write(cell, {"shares": {seed: [0.5] * len(cell.spec["slots"]) for seed in seeds}})
        elif cell.kind == "timing":
            store.write(cell, {"rho": 1.0, "seconds_per_request": dict.fromkeys(seeds, 1e-4)})
        else:
            points = [{"frames": frames, "aar": 0.5, "anuc": 1e6} for frames in (1000, 2000)]
            store.write(cell, {"run": "run", "policy": "best.pt", "eval": points, "train": points})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """All figures of the quick budget, by name."""
    made, store = study(), CellStore(tmp_path_factory.mktemp("drawn"), ROOT / "recipes")
    figures = {}
    for name, figure in FIGURES.items():
        fill(name, made, store)
        figures[name] = figure.draw(made, store)
    return figures


def words(figure) -> str:
    """Title, caption and tick labels."""
    ticks = (label.get_text() for axes in figure.axes for label in axes.get_xticklabels())
    return (
        " ".join([figure.get_suptitle(), *(text.get_text() for text in figure.texts), *ticks])
        .replace("\n", " ")
        .replace("\u00a0", " ")
    )


def test_the_papers_figures_are_there(drawn):
    assert set(drawn) >= PAPER


@pytest.mark.parametrize("name", FIGURES)
def test_every_caption_says_what_it_took(drawn, name, tmp_path):
    shown = words(drawn[name].figure)
    over = "1 training seed " if "over_iterations" in name else "3 workload seeds "
    assert f"Budget quick: {over}" in shown and "lifetimes hidden" in shown
    assert ("agents have hardly learnt" in shown) == (name != "presence_probability")
    assert "udget" not in drawn[name].figure.get_suptitle()  # no log in a title
    for axes in drawn[name].figure.axes:
        assert axes.lines or axes.patches or axes.texts, "an empty panel"
    legend = " ".join(text.get_text() for axes in drawn[name].figure.legends for text in axes.get_texts())
    assert name == "presence_probability" or r"$\rho$" in shown + legend  # nothing is placed there
    drawn[name].save(tmp_path / name)
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf", ".csv"}


@pytest.mark.parametrize("name", ["aar_vs_nodes", "aar_vs_lifetime", "aar_vs_requests"])
def test_the_share_of_the_gap_is_drawn_below(drawn, name):
    axes = drawn[name].figure.axes
    assert len(axes) == 4 and "blind bound closed" in axes[2].get_ylabel()
    shares = {line.get_label(): line.get_ydata()[0] for line in axes[2].lines if not line.get_label().startswith("_")}
    assert shares["myopic_optimal"] == 0
    assert shares["DQN-AR"] == pytest.approx((0.851 - 0.801) / (BLIND - 0.801))
    assert axes[2].get_xlim() == axes[0].get_xlim()


def test_anuc_has_no_bound_and_no_gap(drawn):
    assert len(drawn["anuc_vs_nodes"].figure.axes) == 2


@pytest.mark.parametrize("metric", ["aar", "anuc"])
def test_cost_weights_are_compared_in_pairs(drawn, metric):
    paired = drawn[f"{metric}_vs_cost_weight"].paired
    costs = [row for row in paired if row["metric"] == "paired_cost" and row["reference"] == "greedy"]
    assert {(row["series"], row["x"]) for row in costs} == {
        (series, weight) for series in ("DQN-AR, default reward", "DQN-AR, paper's reward") for weight in (0.2, 1.0)
    }
    assert all(row["mean"] == pytest.approx(0.85 / 0.6) for row in costs)
    gaps = {row["series"] for row in paired if row["metric"] == "gap_closed"}
    assert ("DQN-AR, paper's reward" in gaps) == (metric == "aar")


def test_learning_curves_name_the_bound(drawn):
    rows = drawn["aar_over_iterations"].rows
    assert {row["bound_blind"] for row in rows} == {BLIND} and {row["bound_hindsight"] for row in rows} == {HINDSIGHT}
    assert "blind bound 0.90" in words(drawn["aar_over_iterations"].figure)
    assert "bound_blind" not in drawn["anuc_over_iterations"].rows[0]


def test_agents_only_at_some_points(tmp_path: Path):
    """`trained_points` leaves agents out of the other scenarios, and the caption says so."""
    made, store = study("budget.trained_points.nodes=[10,50]"), CellStore(tmp_path, ROOT / "recipes")
    fill("aar_vs_nodes", made, store)
    shown = FIGURES["aar_vs_nodes"].draw(made, store)
    assert {row["x"] for row in shown.rows if row["series"] == "NFVdeep"} == {10, 50}
    assert {row["x"] for row in shown.rows if row["series"] == "tabu"} == {10, 20, 50}
    assert "trains DQN-AR and NFVdeep only at N = 10, 50" in words(shown.figure)
    evaluations = [cell for cell in FIGURES["aar_vs_nodes"].cells(made) if cell.kind == "evaluation"]
    assert len(evaluations) == 3 * 7 * 2 + 4  # two agents are trained at two points, colocation off


def test_agents_trained_once_share_the_workloads(tmp_path: Path):
    """Of five workloads and two training seeds, the first weights answer 0, 2, 4 and the second 1, 3; everywhere."""
    made = study("budget.training_seeds=2", "budget.seeds=5", "budget.nodes=[10,20]")
    store = CellStore(tmp_path, ROOT / "recipes")
    fill("aar_vs_nodes", made, store)
    shown = FIGURES["aar_vs_nodes"].draw(made, store)
    runs = [made.evaluation("plans", made.world(nodes=nodes)) for nodes in (10, 20)]
    assert [[cell.spec["seeds"] for cell in each] for each in runs] == [[[0, 2, 4], [1, 3]]] * 2
    assert runs[0][0].needs == runs[1][0].needs and runs[0][0].needs != runs[0][1].needs
    assert runs[0][0].needs[0].spec["scenario"]["arrival_rate"] == 25  # its own scenario
    rows = [row for row in shown.rows if row["series"] == "DQN over plans"]
    assert {(row["n"], row["x"]) for row in rows} == {(5, 10), (5, 20)}
    assert all(row["mean"] == pytest.approx(0.7 + 0.002) for row in rows)  # of all five
    assert {row["reference"] for row in shown.paired if row["series"] == "DQN over plans"} >= {"DQN-AR", "greedy"}
    assert "trained once, on random networks (2 training seeds, which share the workloads)" in words(shown.figure)


def test_without_agents_the_caption_says_nothing_of_training(tmp_path: Path):
    """Planners alone: `trained_colocation=[]`; the bars of the walk's length then compare rules."""
    overrides = ["budget=full", "budget.trained_colocation=[]", "method=[random_feasible,greedy,myopic_optimal]"]
    made, store = study(*overrides), CellStore(tmp_path, ROOT / "recipes")
    fill("reward_and_walk_length", made, store)
    shown = FIGURES["reward_and_walk_length"].draw(made, store)
    assert [row["series"] for row in shown.rows[:3]] == ["random_feasible", "greedy", "myopic_optimal"]
    said = words(shown.figure)
    assert "Budget full: 10 workload seeds" in said and "T = 1000 s" in said and "rain" not in said
