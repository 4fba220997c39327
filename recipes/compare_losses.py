"""Compare losses: the same scenario, frames and seeds for all of them, then a table and learning curves.

    python recipes/compare_losses.py                               # everything in config/compare_losses.yaml
    python recipes/compare_losses.py only=[dqn,n_step] frames=600_000 explored=200_000
    python recipes/compare_losses.py scenario=heavy output=runs/losses_heavy
    python recipes/compare_losses.py compute=false                 # the table and pictures of what is there so far

Every training is a run of its recipe in a process of its own, ``parallel.jobs`` of them at once. What has been computed
before is not computed again, an interrupted run goes on from its checkpoint, and a loss of your own is one more entry
of ``losses`` (``+losses.mine.overrides=['loss=mine']``).

Writes to ``output``: ``losses.md``, ``losses.csv``, ``learning_curves_*`` and
``profiles_*`` (png, pdf, csv), and the runs themselves.
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
from nfv_torchrl.experiments.losses import FLOOR, Compared, draw_curves, draw_profiles, loss_table, table_rows
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim, refuse_foreign
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

    seeds, workloads = range(config["seeds"]), list(range(config["workloads"]))
    trained = {name: {seed: training_cell(config, name, seed) for seed in seeds} for name in losses}
    tested = {
        name: {seed: evaluation_cell(config, name, workloads, run) for seed, run in runs.items()}
        for name, runs in trained.items()
    }
    rules = [FLOOR, *config["method"]]
    compared = Compared(
        trained,
        tested,
        {name: evaluation_cell(config, name, workloads) for name in rules},
        {name: evaluation_cell(config, name, config["eval_seeds"]) for name in rules},
        store,
    )
    failures = {}
    if config["compute"]:
        claim("output", store.folder, "cells")
        cells = [*compared.rules.values(), *compared.held_out.values()]
        cells += [cell for runs in tested.values() for cell in runs.values()]
        failures = compute_shown(cells, store, instantiate(cfg.parallel))
    else:
        refuse_foreign("output", store.folder, "cells")

    rows = table_rows(compared, config["reference"])
    table = loss_table(rows, config, scenario)
    lacks = compared.lacking()
    note = f"\n\nNot there yet: {'; '.join(lacks)}." if lacks else ""
    write_atomically(store.folder / "losses.csv", csv_text(rows))
    write_atomically(store.folder / "losses.md", f"{table.markdown()}{note}\n")
    print(f"\n{table.text()}{note}")
    for figure, names in config["figures"].items():
        there = [name for name in names if name in losses]
        draw_curves(figure, there, compared, scenario)
        draw_profiles(figure, there, compared, scenario)
    print(f"\nTable, curves, profiles and runs: {store.folder}")
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
        "logger.references=false",  # they are rows and lines of this recipe
    ]
    spec = {"recipe": f"{recipe}.py", "scenario": config["scenario"], "overrides": overrides, "policy": "best.pt"}
    return make_cell("training", f"{name}-{seed}", spec)


def evaluation_cell(config: Mapping[str, Any], name: str, seeds: Sequence[int], run: Cell | None = None) -> Cell:
    """The policy of a training run, or a rule, on common workloads."""
    training = None
    if name == FLOOR:
        method = {"_target_": "nfv_torchrl.methods.RandomMethod", "name": name, "mask": "feasible"}
    elif run is None:
        method = config["method"][name]
    else:
        method = {"_target_": "nfv_torchrl.methods.load_policy", "_partial_": True, "name": name}
        training = run.spec
    spec = {"scenario": config["scenario"], "method": method, "training": training, "seeds": list(seeds)}
    return make_cell("evaluation", f"test-{run.label if run else name}", spec, [run] if run else [])


if __name__ == "__main__":
    main()
