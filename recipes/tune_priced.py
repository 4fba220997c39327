"""Tune the constants of `priced` and `priced_admit` once, on networks and requests that no table shows.

    python recipes/tune_priced.py output=runs/tune_priced.csv

For every price p, steepness M and refusal threshold: AAR at each load, and what is judged, the mean over networks,
loads and colocation off and on of the paired AAR difference to `myopic_optimal`, with its 95 % interval over networks.
The best without a threshold are the constants for `priced`, the best with one those for `priced_admit`. All keys:
config/tune_priced.yaml.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.evaluation.figures import csv_text
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.statistics import mean_interval
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim_file
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners import MyopicPlanner, PricedPlanner
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import TunePricedSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_file

FIRST_SEED = 2000
COLUMNS = "price,steepness,threshold,"
"""What an output of this recipe begins with."""
Setting = tuple[float, float, float | None]
"""Price p, steepness M, refusal threshold (None: never)."""


@recipe("tune_priced")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, TunePricedSettings)
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    output = None if config["output"] is None else run_file(config["output"])
    worlds = scenarios(config)
    if output is not None:
        claim_file("output", output, lambda path: path.read_text("utf-8", "replace").startswith(COLUMNS))
    settings: list[Setting] = list(itertools.product(config["prices"], config["steepness"], config["thresholds"]))
    work = [(setting, worlds, config["seeds"]) for setting in [None, *settings]]
    with instantiate(cfg.parallel) as workers:
        answers = list(ProgressBar(workers.map(measure, work), total=len(work), unit="setting"))
    myopic, *priced = answers  # each [loads x colocation, networks, (AAR, cost)]
    rows = [row(setting, answer, myopic) for setting, answer in zip(settings, priced, strict=True)]
    rows.sort(key=lambda row: (-row["aar_gain"], row["cost_per_accepted"]))
    show(rows, config, myopic)
    if output is not None:
        write_atomically(output, csv_text(rows))


def scenarios(config: dict[str, Any]) -> list[list[Scenario]]:
    """For each load with each colocation rule, the scenario on every network."""
    return [
        [
            Scenario.from_config({**config["scenario"], **load, "colocation": colocation, "seed": seed})
            for seed in config["scenario_seeds"]
        ]
        for load in config["loads"]
        for colocation in config["colocation"]
    ]


def measure(work: tuple[Setting | None, list[list[Scenario]], int]) -> np.ndarray:
    """AAR and cost per accepted request ($), float64 [W, S, 2], on W x S scenarios; None: of `myopic_optimal`."""
    setting, worlds, seeds = work
    return np.array([_scores(setting, networks, seeds) for networks in worlds])


def _scores(setting: Setting | None, networks: list[Scenario], seeds: int) -> np.ndarray:
    """[S, 2]: the mean over ``seeds`` workloads of each network, which are its own."""
    if setting is None:
        method = PlannerMethod(MyopicPlanner(), name="myopic_optimal")
    else:
        price, steepness, threshold = setting
        planner = PricedPlanner(price=price, steepness=steepness, admit_threshold=threshold)
        method = PlannerMethod(planner, name="priced")
    scenarios = [scenario for scenario in networks for _ in range(seeds)]
    records = run_method(scenarios, method, range(FIRST_SEED, FIRST_SEED + len(scenarios)))
    runs = [compute_metrics(record) for record in records]
    return np.array([(run["aar"], run["cost_per_accepted"]) for run in runs]).reshape(len(networks), seeds, 2).mean(1)


def row(setting: Setting, answer: np.ndarray, myopic: np.ndarray) -> dict[str, Any]:
    """One setting: gain over `myopic_optimal` with its interval over networks, cost, and AAR of each load."""
    gain = mean_interval((answer - myopic)[:, :, 0].mean(axis=0))
    price, steepness, threshold = setting
    return {
        "price": price,
        "steepness": steepness,
        "threshold": threshold,
        "aar_gain": gain.mean,
        "ci_low": gain.low,
        "ci_high": gain.high,
        "cost_per_accepted": float(answer[:, :, 1].mean()),
        **{f"aar_{place}": float(aar) for place, aar in enumerate(answer[:, :, 0].mean(axis=1))},
    }


def show(rows: Sequence[dict[str, Any]], config: dict[str, Any], myopic: np.ndarray) -> None:
    """Print all settings, best first, and the two choices."""
    names = [
        f"l{load['arrival_rate']:g} m{load['mean_lifetime']:g} {'on' if colocation else 'off'}"
        for load in config["loads"]
        for colocation in config["colocation"]
    ]
    print(
        f"AAR by load (lambda, mu) and colocation, {len(config['scenario_seeds'])} networks; gain over myopic_optimal"
    )
    head = "  ".join(f"{name:>14}" for name in names)
    print(f"{'p':>6} {'M':>7} {'refuse above':>12}  {'gain':>17} {'$/accepted':>10}  {head}")
    base = "  ".join(f"{aar:14.4f}" for aar in myopic[:, :, 0].mean(axis=1))
    print(f"{'myopic_optimal':>27}  {'':>17} {myopic[:, :, 1].mean():10.1f}  {base}")
    for line in rows:
        cells = "  ".join(f"{line[f'aar_{place}']:14.4f}" for place in range(len(names)))
        gain = f"{line['aar_gain']:+.4f} ± {line['aar_gain'] - line['ci_low']:.4f}"
        cost = f"{line['cost_per_accepted']:10.1f}"
        threshold = "never" if line["threshold"] is None else f"{line['threshold']:g}"
        print(f"{line['price']:6g} {line['steepness']:7g} {threshold:>12}  {gain:>17} {cost}  {cells}")
    for name, refuses in (("priced", False), ("priced_admit", True)):
        best = next((line for line in rows if (line["threshold"] is not None) == refuses), None)
        if best is not None:
            threshold = f" admit_threshold={best['threshold']:g}" if refuses else ""
            print(f"best for {name}: price={best['price']:g} steepness={best['steepness']:g}{threshold}")


if __name__ == "__main__":
    main()
