"""Reproduce every figure of the paper: methods on the same requests, agents trained for each scenario, all audited.

    python recipes/figures.py                                  # all figures, a preview
    python recipes/figures.py budget=full output=runs/full     # the paper's ranges, ten workload seeds
    python recipes/figures.py figure=[aar_vs_nodes,anuc_vs_nodes]

Writes OUTPUT/NAME.png, .pdf and .csv for each figure, and OUTPUT/cells/*.json, from which they are drawn: a cell is
one method on one scenario (or a training run, a bound), shared by the figures that show it. What is there is not
computed again, so the same command goes on after an interruption. An agent is trained for one scenario, that is for the
network and endpoints of scenario.seed, and meets workload seeds it never saw. All keys: config/figures.yaml.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.experiments.catalogue import chosen
from nfv_torchrl.experiments.cells import CellStore, with_needs
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.drawing import Experiment
from nfv_torchrl.experiments.study import Study
from nfv_torchrl.folders import claim
from nfv_torchrl.parallel import Workers
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.settings.recipes import FiguresSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.logger import EventLog
from nfv_torchrl.training.setup import run_folder


@recipe("figures")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, FiguresSettings)
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    recipes = Path(__file__).parent
    study, store = Study(config, recipes), CellStore(run_folder(config["output"], "output"), recipes)
    figures = chosen(config["figure"])
    failures = compute_all(figures, study, store, instantiate(cfg.parallel))
    draw_all(figures, study, store, failures)
    if failures:
        print("\n".join([f"\n{len(failures)} cells failed:", *(f"  {key}: {why}" for key, why in failures.items())]))
        sys.exit(1)


def compute_all(figures: Mapping[str, Experiment], study: Study, store: CellStore, workers: Workers) -> dict[str, str]:
    """Compute what the store lacks, under a progress bar; returns what failed."""
    cells = with_needs(cell for figure in figures.values() for cell in figure.cells(study))
    claim("output", store.folder, "cells")
    lacking = [cell for cell in cells if not store.has(cell)]
    training = sum(cell.kind == "training" for cell in lacking)
    print(f"{len(cells)} cells, {len(cells) - len(lacking)} of them there already, {training} training runs to do.")
    if not lacking:
        return {}
    return compute_shown(cells, store, workers)


def draw_all(figures: Mapping[str, Experiment], study: Study, store: CellStore, failures: Mapping[str, str]) -> None:
    """Draw every figure whose cells are there, into files and for TensorBoard."""
    logger = EventLog(store.folder)
    for name, figure in ProgressBar(figures.items(), desc="drawing", unit="figure"):
        if any(cell.key in failures for cell in figure.cells(study)):
            print(f"{name}: not drawn, some of its cells failed")
            continue
        drawn = figure.draw(study, store)
        drawn.save(store.folder / name)
        logger.figure(name, drawn.figure, 0)
    logger.close()
    print(f"Figures: {store.folder}\nTensorBoard: tensorboard --logdir {store.folder}")


if __name__ == "__main__":
    main()
