"""The figures recipe, run for real at tiny size: what it writes, what it does not do twice, how it goes on."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from inprocess import call
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY_SCENARIO, TINY_TRAINING, command

from nfv_torchrl.errors import AuditError, ScenarioError
from nfv_torchrl.evaluation.audit import AuditReport
from nfv_torchrl.evaluation.statistics import mean_interval
from nfv_torchrl.experiments import work
from nfv_torchrl.experiments.catalogue import FIGURES, chosen
from nfv_torchrl.experiments.cells import CellStore, make_cell, with_needs
from nfv_torchrl.experiments.decision_time import Size, dqn_steps, greedy_steps, tabu_steps
from nfv_torchrl.experiments.rows import gap_rows

NFVDEEP = [
    *("env=nfvdeep", "collector.num_envs=4", "collector.steps=8"),
    *("collector.total_frames=320", "eval.seeds=[1000]"),
]
LOOKAHEAD = ["preset=lookahead", "held_out=none", *TINY_TRAINING]
TINY = [
    *TINY_SCENARIO,
    "~trained.plans",
    f"trained.lookahead.overrides={LOOKAHEAD}",
    "budget.seeds=2",
    "budget.nodes=[5]",
    "budget.nodes_at={arrival_rate: 4, mean_lifetime: 40}",
    "budget.mean_lifetimes=[20,40]",
    "budget.timing={seeds: 2, horizon: 20}",
    f"trained.nfvdeep.overrides={NFVDEEP}",
]
FOUR = ("aar_over_iterations", "aar_vs_nodes", "presence_probability", "decision_time_vs_nodes")


def figures(folder: Path, *overrides: str, dqn: Sequence[str] = TINY_TRAINING) -> None:
    """Run the recipe without workers, which would import everything once more each; test_parallel.py has them."""
    call("figures", *arguments(folder, *overrides, dqn=dqn), "parallel.jobs=1")


def arguments(folder: Path, *overrides: str, dqn: Sequence[str] = TINY_TRAINING) -> list[str]:
    return [f"output={folder}", *TINY, f"trained.dqn_ar.overrides={['preset=mlp', *dqn]}", *overrides]


def table(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def files(folder: Path) -> dict[str, float]:
    return {path.name: path.stat().st_mtime for path in (folder / "cells").iterdir()}


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """Four figures of one tiny network."""
    folder = tmp_path_factory.mktemp("figures") / "out"
    figures(folder, f"figure=[{','.join(FOUR)}]")
    return folder


def test_every_figure_comes_as_picture_table_and_for_tensorboard(output):
    for name in FOUR:
        for suffix in (".png", ".pdf", ".csv"):
            assert (output / name).with_suffix(suffix).stat().st_size > 0
    assert sorted(path.name for path in output.parent.iterdir()) == ["out"]  # no litter
    events = EventAccumulator(str(output))
    events.Reload()
    assert set(events.Tags()["images"]) == set(FOUR)
    assert not list((output / "runs").glob("*/checkpoint_*"))  # trained to the end, so no longer needed


def test_the_table_says_what_the_cells_say(output):
    rows = table(output / "aar_vs_nodes.csv")
    methods = {row["series"] for row in rows if row["panel"] == "colocation off"}
    assert methods == {
        "DQN-AR", "DQN-AR with look-ahead", "NFVdeep", "tabu", "greedy", "myopic_optimal", "priced", "priced_admit",
        "bound: hindsight", "bound: blind",
    }  # fmt: skip
    assert {row["panel"] for row in rows} == {"colocation off", "colocation on"}
    for row in rows:
        cell = json.loads((output / "cells" / f"{row['cell']}.json").read_text())
        assert float(row["rho"]) == pytest.approx(cell["result"]["rho"], abs=1e-4) and row["lifetimes"] == "hidden"
        if row["series"].startswith("bound: "):
            values = list(cell["result"]["bounds"][row["series"].removeprefix("bound: ")].values())
        else:
            values = [run["aar"] for run in cell["result"]["metrics"].values()]
        expected = mean_interval(values)
        assert float(row["mean"]) == expected.mean and float(row["ci_low"]) == expected.low and int(row["n"]) == 2


def test_paired_comparisons_are_on_the_same_requests(output):
    rows = table(output / "aar_vs_nodes_paired.csv")
    wanted = {"series": "DQN-AR", "reference": "greedy", "metric": "paired_cost"}
    (row,) = [row for row in rows if wanted.items() <= row.items()]
    cells = {
        row["series"]: row["cell"] for row in table(output / "aar_vs_nodes.csv") if row["panel"] == "colocation off"
    }
    mine, other = (np.load(output / "cells" / f"{cells[name]}.npz") for name in ("DQN-AR", "greedy"))
    ratios = []
    for seed in ("0", "1"):
        both = np.isfinite(mine[seed]) & np.isfinite(other[seed])
        ratios.append(mine[seed][both].sum(dtype=float) / other[seed][both].sum(dtype=float))
    assert float(row["mean"]) == pytest.approx(np.mean(ratios))


def test_curves_have_frames_and_horizons(output):
    rows = table(output / "aar_over_iterations.csv")
    greedily = [row for row in rows if row["panel"].startswith("acting greedily")]
    assert [int(row["x"]) for row in greedily] == [0, 320, 640, 960]  # the untrained policy first
    assert all((float(row["horizons"]) > 0) == (row["x"] != "0") and 0 <= float(row["mean"]) <= 1 for row in rows)


def test_users_leave_as_theory_says(output):
    rows = table(output / "presence_probability.csv")
    panel = [row for row in rows if row["panel"] == "μ = 40 s" and row["x"] == "180"]
    theory, seen = (float(row["mean"]) for row in panel)
    assert theory == pytest.approx(math.exp(-180 / 40)) and seen == pytest.approx(theory, abs=0.05)


def test_nothing_is_computed_twice(output, capsys):
    before = files(output)
    figures(output, f"figure=[{','.join(FOUR)}]")
    assert ", 0 training runs to do" in capsys.readouterr().out
    assert files(output) == before


def test_what_is_lost_is_computed_again_and_is_the_same(output):
    before, shown = files(output), (output / "aar_vs_nodes.csv").read_bytes()
    (lost,) = [path for path in (output / "cells").glob("greedy_*.json") if "coloc" not in path.name]
    lost.unlink()
    figures(output, "figure=aar_vs_nodes")
    changed = {name for name, at in files(output).items() if before[name] != at}
    assert changed == {lost.name, lost.with_suffix(".npz").name}
    assert (output / "aar_vs_nodes.csv").read_bytes() == shown


def test_an_interrupted_training_goes_on(tmp_path):
    folder, long = tmp_path / "out", [text.replace("frames=960", "frames=2560") for text in TINY_TRAINING]
    asked = arguments(folder, "figure=aar_over_iterations", dqn=long)
    process = subprocess.Popen(
        command("figures.py", *asked),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        cwd=tmp_path,
    )
    deadline = time.monotonic() + 120
    while not list(folder.glob("runs/*/checkpoint_*.pt")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does
    process.communicate(timeout=120)
    (log,) = folder.glob("runs/*.log")
    assert process.returncode != 0 and "Stopped and saved" in log.read_text()
    figures(folder, "figure=aar_over_iterations", dqn=long)
    assert "Resumed from" in log.read_text()
    frames = [int(row["x"]) for row in table(folder / "aar_over_iterations.csv") if row["panel"].startswith("acting")]
    assert frames == list(range(0, 2561, 320))


def test_a_failing_cell_leaves_the_others(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        figures(tmp_path / "out", "figure=[aar_over_iterations,presence_probability]", dqn=["collector.num_envs=-1"])
    printed = capsys.readouterr().out
    assert ended.value.code == 1 and "aar_over_iterations: not drawn" in printed
    assert "training ended with code" in printed
    assert (tmp_path / "out" / "presence_probability.png").exists()
    assert not (tmp_path / "out" / "aar_over_iterations.png").exists()


def test_findings_of_the_audit_fail_the_cell(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "audit_run", lambda folder: AuditReport(folder, ["a link is overfull"]))
    world = {"substrate": {"nodes": 5}, "horizon": 20, "arrival_rate": 2}
    greedy = {
        "_target_": "nfv_torchrl.methods.PlannerMethod",
        "name": "greedy",
        "planner": {"_target_": "nfv_torchrl.planners.GreedyPlanner"},
    }
    cell = make_cell("evaluation", "greedy", {"scenario": world, "seeds": [0], "method": greedy, "training": None})
    store = CellStore(tmp_path)
    with pytest.raises(AuditError, match="a link is overfull"):
        work.work(cell, store)
    assert not store.has(cell)


def test_cells_are_known_by_their_content():
    first = make_cell("evaluation", "a", {"x": 1, "y": [2]})
    assert first.key == make_cell("evaluation", "a", {"x": 1, "y": [2]}).key
    # The order of services decides which endpoints and requests are drawn, so it is part of what a cell is.
    services = [{"services": {"web": 1, "voip": 2}}, {"services": {"voip": 2, "web": 1}}]
    there, back = (make_cell("evaluation", "a", spec) for spec in services)
    assert there.key != back.key and list(there.spec["services"]) == ["web", "voip"]
    assert len({first.key, make_cell("bound", "a", first.spec).key, make_cell("evaluation", "a", {"x": 2}).key}) == 3
    second = make_cell("evaluation", "b", {"x": 3}, needs=[first])
    assert with_needs([second, first, second]) == [first, second]


def test_share_of_the_gap_closed(tmp_path):
    store, world = CellStore(tmp_path), {"substrate": {"nodes": 5}, "colocation": True, "observe_lifetime": False}
    world |= {"arrival_rate": 2, "mean_lifetime": 5}
    methods = {name: (make_cell("evaluation", name, {}),) for name in ("myopic_optimal", "priced")}
    for name, aars in {"myopic_optimal": (0.5, 0.6), "priced": (0.6, 0.8)}.items():
        store.write(methods[name][0], {"metrics": {str(seed): {"aar": aar} for seed, aar in enumerate(aars)}})
    limit = make_cell("bound", "bound", {})
    store.write(limit, {"rho": 1.0, "bounds": {"hindsight": {"0": 0.9, "1": 0.9}, "blind": {"0": 0.5, "1": 0.6}}})
    rows = gap_rows(store, methods, limit, 5, world)
    assert [(row["series"], row["reference"]) for row in rows] == [
        ("myopic_optimal", "bound: hindsight"),
        ("priced", "bound: hindsight"),  # no way to go to the blind bound
    ]
    assert [row["mean"] for row in rows] == pytest.approx([0, 0.3 / 0.7])


def test_formulas_by_hand():
    size = Size.of({"substrate": {"nodes": 10}})
    assert size == Size(nodes=10, vms=6, links=20, services=30, functions=5)
    assert dqn_steps(size) == 256 * (20 + 60 + 5 + 2 * 256 + 120)
    assert tabu_steps(size) == 30 * 5
    assert greedy_steps(size) == pytest.approx(20 + 10 * math.log(10) + 5 * 30)


def test_names_of_figures():
    assert list(chosen("all")) == list(FIGURES) and list(chosen("aar_vs_nodes")) == ["aar_vs_nodes"]
    with pytest.raises(ScenarioError, match=r"aar_vs_time.*aar_vs_nodes"):
        chosen(["aar_vs_time"])
