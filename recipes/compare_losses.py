"""Compare losses: the same scenario, frames and seeds for all of them, then a table and learning curves.

    python recipes/compare_losses.py                               # everything in config/compare_losses.yaml
    python recipes/compare_losses.py only=[dqn,n_step] seeds=5 frames=600_000 explored=200_000
    python recipes/compare_losses.py scenario=heavy output=runs/losses_heavy

Every training is a run of its recipe in a process of its own, ``parallel.jobs`` of them at once. What has been computed
before is not computed again, an interrupted run goes on from its checkpoint, and a loss of your own is one more entry
of ``losses`` (``+losses.mine.overrides=[loss=mine]``).

Writes to ``output``: ``losses.md``, ``losses.csv``, ``learning_curves_*.png/pdf/csv``, and the runs themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import csv_text
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.losses import FLOOR, draw_curves, loss_table, table_rows
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import CompareLossesSettings, read_settings
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_folder


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
    failures = compute_shown(cells, store, instantiate(cfg.parallel))

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


if __name__ == "__main__":
    main()
