"""Compare losses: the same scenario, frames and seeds for all of them, then a table and learning curves.

    python recipes/compare_losses.py                               # everything in config/compare_losses.yaml
    python recipes/compare_losses.py only=[dqn,n_step] seeds=5 frames=600_000 explored=200_000
    python recipes/compare_losses.py scenario=heavy output=runs/losses_heavy

Every training is a run of its recipe in a process of its own, ``jobs`` of them at once. What has been computed before
is not computed again, an interrupted run goes on from its checkpoint, and a loss of your own is one more entry of
``losses`` (``+losses.mine.overrides=[loss=mine]``).

Writes to ``output``: ``losses.md``, ``losses.csv``, ``learning_curves_*.png/pdf/csv``, and the runs themselves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import csv_text, line_figure, save_figure, tidy_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval, paired_difference
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.pool import compute
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import CompareLossesSettings, read_settings
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_folder

FLOOR = "random_feasible"
"""What every loss has to beat."""


@recipe("compare_losses")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, CompareLossesSettings)
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    config["eval_seeds"] = list_of_seeds("eval_seeds", config["eval_seeds"])
    losses = chosen_losses(config)
    scenario = Scenario.from_config(config["scenario"])
    store = CellStore(run_folder(config["output"], "output"), Path(__file__).parent)

    trained = {name: [training_cell(config, name, seed) for seed in range(config["seeds"])] for name in losses}
    workloads = list(range(config["workloads"]))
    tested = {name: [evaluation_cell(config, name, workloads, run) for run in runs] for name, runs in trained.items()}
    floor = {
        "workloads": evaluation_cell(config, FLOOR, workloads),
        "eval_seeds": evaluation_cell(config, FLOOR, config["eval_seeds"]),
    }
    cells = [*floor.values(), *(cell for runs in tested.values() for cell in runs)]
    claim("output", store.folder, "cells")
    failures = compute(cells, store, jobs=config["jobs"], report=print_progress)

    tested = {name: runs for name, runs in tested.items() if all(store.has(cell) for cell in runs)}
    rows = table_rows(tested, floor["workloads"], store, config["reference"])
    table = loss_table(rows, config, scenario)
    write_atomically(store.folder / "losses.csv", csv_text(rows))
    write_atomically(store.folder / "losses.md", table.markdown() + "\n")
    print(f"\n{table.text()}")
    for figure, names in config["figures"].items():
        draw_curves(figure, [name for name in names if name in tested], trained, floor["eval_seeds"], store, scenario)
    print(f"\nTable, curves and runs: {store.folder}")
    if failures:
        raise ScenarioError("\n  ".join(["some runs failed:", *(f"{key}: {text}" for key, text in failures.items())]))


def chosen_losses(config: Mapping[str, Any]) -> list[str]:
    """Names of the losses to compare."""
    names = config["only"] or list(config["losses"])
    unknown = [name for name in names if name not in config["losses"]]
    if unknown:
        raise ScenarioError(f"only: there is no {unknown[0]!r}; losses: {', '.join(config['losses'])}")
    for name, entry in config["losses"].items():
        if entry.get("recipe", "dqn") not in config["settings"]:
            raise ScenarioError(f"losses.{name}.recipe: {entry['recipe']} has no entry in settings")
    return names


def training_cell(config: Mapping[str, Any], name: str, seed: int) -> Cell:
    """One training run."""
    entry = config["losses"][name]
    recipe = entry.get("recipe", "dqn")
    seeds = ",".join(map(str, config["eval_seeds"]))
    overrides = [
        *config["settings"][recipe],
        *config["overrides"],
        *entry["overrides"],
        f"seed={seed}",
        f"eval.seeds=[{seeds}]",
        "logger.figures=false",
    ]
    spec = {"recipe": f"{recipe}.py", "scenario": config["scenario"], "overrides": overrides, "policy": "best.pt"}
    return make_cell("training", f"{name}-{seed}", spec)


def evaluation_cell(config: Mapping[str, Any], name: str, seeds: Sequence[int], run: Cell | None = None) -> Cell:
    """The policy of a training run, or the floor, on common workloads."""
    if run is None:
        method = {"_target_": "nfv_torchrl.methods.RandomMethod", "name": name, "mask": "feasible"}
        training = None
    else:
        method = {"_target_": "nfv_torchrl.methods.load_policy", "_partial_": True, "name": name}
        training = run.spec
    spec = {"scenario": config["scenario"], "method": method, "training": training, "seeds": list(seeds)}
    return make_cell("evaluation", f"test-{run.label if run else name}", spec, [run] if run else [])


def print_progress(cell: Cell, at_work: list[Cell]) -> None:
    """One line for each cell that has ended."""
    print(f"{cell.label} ended; at work: {', '.join(other.label for other in at_work) or 'nothing'}", flush=True)


def scores(runs: Sequence[Cell], store: CellStore, metric: str) -> list[float]:
    """A metric of each training seed, the mean over workloads."""
    found = []
    for cell in runs:
        values = [run[metric] for run in store.read(cell)["metrics"].values()]
        found.append(fmean(math.nan if value is None else value for value in values))
    return found


def table_rows(
    tested: Mapping[str, Sequence[Cell]], floor: Cell, store: CellStore, reference: str
) -> list[dict[str, Any]]:
    """One row for each loss and quantity: mean over training seeds and its interval."""
    if not store.has(floor):
        return []
    (lowest,) = scores([floor], store, "aar")
    rows = []

    def add(name: str, quantity: str, interval: Interval) -> None:
        ends = {"ci_low": interval.low, "ci_high": interval.high, "n": interval.n}
        rows.append({"loss": name, "quantity": quantity, "mean": interval.mean, **ends})

    add(FLOOR, "aar", mean_interval([lowest]))
    add(FLOOR, "cost_per_accepted", mean_interval(scores([floor], store, "cost_per_accepted")))
    for name, runs in tested.items():
        aar = scores(runs, store, "aar")
        add(name, "aar", mean_interval(aar))
        if name != reference and reference in tested:
            add(name, f"aar_minus_{reference}", paired_difference(aar, scores(tested[reference], store, "aar")))
        add(name, f"aar_minus_{FLOOR}", mean_interval([value - lowest for value in aar]))
        add(name, "cost_per_accepted", mean_interval(scores(runs, store, "cost_per_accepted")))
    return rows


def loss_table(rows: Sequence[Mapping[str, Any]], config: Mapping[str, Any], scenario: Scenario) -> Table:
    """The rows as one line for each loss."""
    reference = config["reference"]
    quantities = {
        "aar": ("AAR", "{:.4f}", "{:.4f}"),
        f"aar_minus_{reference}": (f"minus {reference}", "{:+.4f}", "{:.4f}"),
        f"aar_minus_{FLOOR}": (f"minus {FLOOR}", "{:+.4f}", "{:.4f}"),
        "cost_per_accepted": ("cost/accepted $", "{:.1f}", "{:.1f}"),
    }
    values = {(row["loss"], row["quantity"]): row for row in rows}

    def cell(name: str, quantity: str) -> str:
        row = values.get((name, quantity))
        if row is None:
            return "–"
        _, mean, half = quantities[quantity]
        width = max(row["mean"] - row["ci_low"], row["ci_high"] - row["mean"])
        return mean.format(row["mean"]) + ("" if math.isnan(width) else " ± " + half.format(width))

    title = (
        f"Losses: rho = {scenario.offered_load():.2f}, scenario {scenario.name}, N = {scenario.substrate.num_nodes}, "
        f"{config['frames']:,} frames, {config['seeds']} training seeds, {config['workloads']} workloads, "
        f"lifetimes {'seen' if scenario.observe_lifetime else 'hidden'}"
    )
    names = dict.fromkeys(row["loss"] for row in rows)
    lines = tuple((name, *(cell(name, quantity) for quantity in quantities)) for name in names)
    return Table(title, ("loss", *(head for head, _, _ in quantities.values())), lines)


def draw_curves(
    figure: str,
    names: Sequence[str],
    trained: Mapping[str, Sequence[Cell]],
    floor: Cell,
    store: CellStore,
    scenario: Scenario,
) -> None:
    """AAR on the held-out workloads over frames, mean and interval over training seeds."""
    rows = []
    for name in names:
        at: dict[int, list[float]] = {}
        for run in trained[name]:
            for point in store.read(run)["eval"]:
                at.setdefault(int(point["frames"]), []).append(point["aar"])
        rows += [tidy_row(name, frames, mean_interval(values)) for frames, values in sorted(at.items())]
    if not rows or not store.has(floor):
        return
    (lowest,) = scores([floor], store, "aar")
    ends = (min(row["x"] for row in rows), max(row["x"] for row in rows))
    rows += [tidy_row(FLOOR, x, mean_interval([lowest])) for x in ends]
    title = f"{scenario.name}, rho = {scenario.offered_load():.2f}"
    drawn = line_figure(rows, x_label="frames", y_label="AAR (held-out workloads)", title=title, dashed=[FLOOR])
    save_figure(drawn, rows, store.folder / f"learning_curves_{figure}")


if __name__ == "__main__":
    main()
