"""One policy on many networks: the same weights, unchanged, against planners on the same requests.

    python recipes/dqn.py network=candidate run_dir=runs/candidate
    python recipes/transfer.py checkpoint=runs/candidate/best.pt
    python recipes/transfer.py checkpoint=runs/candidate/best.pt only=[paper_50,geant2009] seeds=10
    python recipes/transfer.py checkpoint=runs/evolution/best.pt rho=[0.5,1,2] draws=true seeds=10

A policy fits a network that it was not trained on if its network serves any size, as ``network=candidate`` does. Every
method on every network is a cell of its own, audited, that is not computed again.

Writes to ``output``: ``transfer.md``, ``transfer.csv`` and ``cells``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from hydra import compose
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import csv_text
from nfv_torchrl.evaluation.pivot import Column, pivot, result_row
from nfv_torchrl.evaluation.statistics import mean_interval, paired_difference
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.rows import paired_cost, values
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import TransferSettings, read_settings
from nfv_torchrl.training.cli import recipe, recipe_configs
from nfv_torchrl.training.setup import run_folder

POLICY = "checkpoint"


@recipe("transfer")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, TransferSettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    if config["checkpoint"] is None or not Path(config["checkpoint"]).is_file():
        raise ScenarioError(f"checkpoint: {config['checkpoint']} is no file; name one, such as runs/candidate/best.pt")
    store = CellStore(run_folder(config["output"], "output"), Path(__file__).parent)
    worlds = {label: read_scenario(label, overrides) for label, overrides in rows_wanted(config).items()}
    cells = {name: evaluations(config, name, world) for name, world in worlds.items()}
    bounds = {name: bound(config, name, world) for name, world in worlds.items() if config["bounds"]}
    wanted = [*(cell for found in cells.values() for cell in found.values()), *bounds.values()]
    claim("output", store.folder, "cells")
    failures = compute_shown(wanted, store, instantiate(cfg.parallel))

    there = [name for name, found in cells.items() if all(map(store.has, found.values()))]
    rows = [row for name in there for row in network_rows(name, worlds[name], cells[name], bounds.get(name), store)]
    seen = {"seen" if world["observe_lifetime"] else "hidden" for world in worlds.values()}
    colocation = {"on" if world["colocation"] else "off" for world in worlds.values()}
    about = (
        f"{config['seeds']} {'scenario seeds with a workload seed each' if config['draws'] else 'workload seeds'}, "
        f"lifetimes {' or '.join(sorted(seen))}, colocation {' or '.join(sorted(colocation))}"
    )
    table = transfer_table(rows, list(config["method"]), about)
    write_atomically(store.folder / "transfer.csv", csv_text(rows))
    write_atomically(store.folder / "transfer.md", table.markdown() + "\n")
    print(f"\n{table.text()}\n\nTable and cells: {store.folder}")
    if failures:
        raise ScenarioError("\n  ".join(["some runs failed:", *(f"{key}: {text}" for key, text in failures.items())]))


def chosen(config: Mapping[str, Any]) -> list[str]:
    """Names of the networks to evaluate on."""
    names = config["only"] or list(config["networks"])
    unknown = [name for name in names if name not in config["networks"]]
    if unknown:
        raise ScenarioError(f"only: there is no {unknown[0]!r}; networks: {', '.join(config['networks'])}")
    return names


def rows_wanted(config: Mapping[str, Any]) -> dict[str, list[str]]:
    """The overrides of evaluate.py behind each row: every network, at every load asked for."""
    rows = {}
    for name in chosen(config):
        overrides = [*config["networks"][name], *config["overrides"]]
        if config["rho"] is None:
            rows[name] = overrides
        for rho in config["rho"] or ():
            rows[f"{name} rho {rho:g}"] = [*overrides, f"scenario.substrate.target_rho={rho}"]
    return rows


def read_scenario(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The scenario that the overrides of a network make, as evaluate.py would read it."""
    try:
        with recipe_configs(Path(__file__).parent):
            composed = compose("evaluate", list(overrides))
    except HydraException as error:
        raise ScenarioError(f"networks.{name}: {error}") from error
    return {**cast(dict[str, Any], OmegaConf.to_container(composed.scenario, resolve=True)), "name": name}


def evaluations(config: Mapping[str, Any], name: str, world: Mapping[str, Any]) -> dict[str, Cell]:
    """Every method on one network, the policy last."""
    return {
        key: make_cell(
            "evaluation", f"{name}-{key}", {"scenario": world, "method": method, "training": None, **seeds_of(config)}
        )
        for key, method in config["method"].items()
    }


def bound(config: Mapping[str, Any], name: str, world: Mapping[str, Any]) -> Cell:
    """What is mathematically possible there."""
    return make_cell("bound", f"{name}-bound", {"scenario": world, **seeds_of(config)})


def seeds_of(config: Mapping[str, Any]) -> dict[str, list[int]]:
    """The seeds of every cell; with ``draws`` each workload seed meets the network of a scenario seed of its own."""
    seeds = list(range(config["seeds"]))
    return {"seeds": seeds, "scenario_seeds": seeds} if config["draws"] else {"seeds": seeds}


def network_rows(
    name: str, world: Mapping[str, Any], cells: Mapping[str, Cell], bound: Cell | None, store: CellStore
) -> list[dict[str, Any]]:
    """One row for each quantity of one network: mean over seeds and its interval."""
    scenario = Scenario.from_config(world)
    about = {"network": name, "nodes": scenario.substrate.num_nodes, "rho": round(scenario.offered_load(), 4)}
    aar = {key: values(store.read(cell), "aar") for key, cell in cells.items()}
    rows = [result_row(about, key, "aar", mean_interval(sample)) for key, sample in aar.items()]
    for key in [key for key in cells if key != POLICY]:
        difference, cost = paired_difference(aar[POLICY], aar[key]), paired_cost(store, cells[POLICY], cells[key])
        rows.append(result_row(about, POLICY, "aar_difference", difference, key))
        rows.append(result_row(about, POLICY, "paired_cost", cost, key))
    if bound is not None and store.has(bound):
        for kind, by_seed in store.read(bound)["bounds"].items():
            rows.append(result_row(about, kind, "aar_bound", mean_interval(list(by_seed.values()))))
    return rows


def transfer_table(rows: Sequence[Mapping[str, Any]], methods: Sequence[str], about: str) -> Table:
    """The rows as one line for each network."""
    others = [key for key in methods if key != POLICY]
    bounds = dict.fromkeys(row["method"] for row in rows if row["metric"] == "aar_bound")
    columns = [
        *(Column("aar", ".3f", key) for key in methods),
        *(Column("aar_difference", "+.3f", POLICY, key) for key in others),
        *(Column("paired_cost", ".2f", POLICY, key) for key in others),
        *(Column("aar_bound", ".3f", kind) for kind in bounds),
    ]
    by = {"network": "", "nodes": "", "rho": ".2f"}
    return pivot(f"One policy on every network: {about}", rows, by, columns)


if __name__ == "__main__":
    main()
