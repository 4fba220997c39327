"""One policy on many networks: the same weights, unchanged, against planners on the same requests.

    python recipes/dqn.py preset=mlp network=candidate run_dir=runs/candidate
    python recipes/transfer.py checkpoint=runs/candidate/best.pt
    python recipes/transfer.py checkpoint=runs/candidate/best.pt only=[paper_50,geant2009] seeds=10
    python recipes/transfer.py checkpoint=runs/evolution/best.pt rho=[0.5,1,2] draws=true seeds=10
    python recipes/transfer.py checkpoints=[runs/plans/0/best.pt,runs/plans/1/best.pt]    # of several training seeds

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
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.transfer import is_policy, network_rows, policy_files, transfer_tables, with_policies
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim
from nfv_torchrl.settings.recipes import TransferSettings, read_settings
from nfv_torchrl.training.cli import recipe, recipe_configs
from nfv_torchrl.training.setup import run_folder


@recipe("transfer")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, TransferSettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    files = policy_files(config)
    config["method"] = with_policies(config["method"], files)
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
    if len(files) > 1:
        about = f"{len(files)} training seeds, {about}"
    tables = transfer_tables(rows, list(config["method"]), about)
    write_atomically(store.folder / "transfer.csv", csv_text(rows))
    write_atomically(store.folder / "transfer.md", "\n\n".join(each.markdown() for each in tables) + "\n")
    print("", *(each.text() for each in tables), f"Tables and cells: {store.folder}", sep="\n\n")
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
    found = {}
    for key, method in config["method"].items():
        spec = {"scenario": world, "method": method, "training": None, **seeds_of(config)}
        found[key] = make_cell("evaluation", f"{name}-{key}", spec | ({"turned_away": True} if is_policy(key) else {}))
    return found


def bound(config: Mapping[str, Any], name: str, world: Mapping[str, Any]) -> Cell:
    """What is mathematically possible there."""
    return make_cell("bound", f"{name}-bound", {"scenario": world, **seeds_of(config)})


def seeds_of(config: Mapping[str, Any]) -> dict[str, list[int]]:
    """The seeds of every cell; with ``draws`` each workload seed meets the network of a scenario seed of its own."""
    seeds = list(range(config["seeds"]))
    return {"seeds": seeds, "scenario_seeds": seeds} if config["draws"] else {"seeds": seeds}


if __name__ == "__main__":
    main()
