"""Time to quality: processor seconds until an agent accepts nearly what the exact search of each request accepts.

    python recipes/time_to_quality.py                               # seven agents on `paper`, three training seeds each
    python recipes/time_to_quality.py only=[mlp,lookahead] seeds=5
    python recipes/time_to_quality.py "+methods.mine.overrides=['preset=mlp','network=dueling']" only=[mine]
    python recipes/time_to_quality.py compute=false                 # the table and picture of what is there so far

Quality is AAR on held-out workloads over that of ``myopic_optimal`` on the same requests, at every evaluation of a
training; no policy is chosen by it. Time is that of the clock in ``nfv_torchrl/training/clock.py``: collecting and
learning, without starting up, evaluations and compiling. Trainings run one by one, since they are measured. What has
been computed before is not computed again, and an interrupted training of a recipe goes on from its checkpoint.

Writes to ``output``: ``time_to_quality.md`` and ``.csv``, the picture ``curves`` (png, pdf, csv), cells and runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import csv_text, save_figure
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.time_to_quality import Timed, quality_figure, quality_rows, quality_table
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim, refuse_foreign
from nfv_torchrl.parallel import Joblib
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import TimeToQualitySettings, read_settings
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_folder

MASKABLE_PPO = "maskable_ppo"
"""Its entry, and the recipe that it names in place of one of this folder."""


@recipe("time_to_quality")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, TimeToQualitySettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    config["workloads"] = list_of_seeds("workloads", config["workloads"])
    scenario = Scenario.from_config(config["scenario"])
    store = CellStore(run_folder(config["output"], "output"), Path(__file__).parent)
    names = chosen(config)
    trained = {name: {seed: training_cell(config, name, seed) for seed in range(config["seeds"])} for name in names}
    timed = Timed(trained, exact_cell(config), store)
    failures = {}
    if config["compute"]:
        claim("output", store.folder, "cells")
        cells = [timed.exact, *(run for runs in trained.values() for run in runs.values())]
        failures = compute_shown(cells, store, Joblib(jobs=1))
    else:
        refuse_foreign("output", store.folder, "cells")

    curves = timed.curves()
    rows = quality_rows(curves, config["shares"])
    about = (
        f"rho = {scenario.offered_load():.2f}, scenario {scenario.name}, N = {scenario.substrate.num_nodes}, "
        f"{len(config['workloads'])} workload{'s' if len(config['workloads']) > 1 else ''}"
    )
    title = f"Processor time to a share of the AAR of myopic_optimal, medians over training seeds: {about}"
    table = quality_table(title, rows, config["shares"])
    lacks = timed.lacking()
    note = f"\n\nNot there yet: {'; '.join(lacks)}." if lacks else ""
    write_atomically(store.folder / "time_to_quality.csv", csv_text(rows))
    write_atomically(store.folder / "time_to_quality.md", f"{table.markdown()}{note}\n")
    print(f"\n{table.text()}{note}")
    if curves:
        caption = (
            "Means over training seeds, bars from the lowest to the highest. Compiling and evaluations are left out."
        )
        figure, drawn = quality_figure(curves, "Time to quality", caption, about)
        save_figure(figure, drawn, store.folder / "curves")
    print(f"\nTable, picture and runs: {store.folder}")
    if failures:
        raise ScenarioError("\n  ".join(["some runs failed:", *(f"{key}: {text}" for key, text in failures.items())]))


def chosen(config: Mapping[str, Any]) -> list[str]:
    """Names of the methods, checked.

    Raises:
        ScenarioError: an unknown one, one of an unknown recipe, or one that needs a library that is not installed.
    """
    names = config["only"] or list(config["methods"])
    if unknown := [name for name in names if name not in config["methods"]]:
        raise ScenarioError(f"only: there is no {unknown[0]!r}; methods: {', '.join(config['methods'])}")
    for name in names:
        kind = config["methods"][name].get("recipe", "dqn")
        if kind == MASKABLE_PPO:
            import nfv_torchrl.gym.sb3  # noqa: F401  says what is missing before anything is computed
        elif kind not in config["settings"]:
            known = ", ".join([*config["settings"], MASKABLE_PPO])
            raise ScenarioError(f"methods.{name}.recipe: there is no {kind!r}; recipes: {known}")
    return names


def training_cell(config: Mapping[str, Any], name: str, seed: int) -> Cell:
    """One training, which is measured and so runs alone."""
    entry, workloads = config["methods"][name], config["workloads"]
    kind = entry.get("recipe", "dqn")
    if kind == MASKABLE_PPO:
        settings = config[MASKABLE_PPO]
        spec = {"scenario": config["scenario"], "settings": settings, "seed": seed, "eval_seeds": workloads}
        return make_cell(MASKABLE_PPO, f"{name}-{seed}", spec, alone=True)
    overrides = [
        *config["settings"][kind],
        *entry["overrides"],
        *config["overrides"],
        f"seed={seed}",
        f"eval.seeds=[{','.join(map(str, workloads))}]",
    ]
    spec = {"recipe": f"{kind}.py", "scenario": config["scenario"], "overrides": overrides, "policy": "best.pt"}
    return make_cell("training", f"{name}-{seed}", spec, alone=True)


def exact_cell(config: Mapping[str, Any]) -> Cell:
    """The exact search of each request on the workloads of the evaluations."""
    planner = {"_target_": "nfv_torchrl.planners.MyopicPlanner"}
    method = {"_target_": "nfv_torchrl.methods.PlannerMethod", "name": "myopic_optimal", "planner": planner}
    spec = {"scenario": config["scenario"], "method": method, "training": None, "seeds": config["workloads"]}
    return make_cell("evaluation", "myopic_optimal", spec)


if __name__ == "__main__":
    main()
