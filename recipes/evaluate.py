"""Compare methods on the same requests, seed by seed, and audit what they decided.

    python recipes/evaluate.py method=[random,random_feasible,greedy,tabu,myopic_optimal]
    python recipes/evaluate.py method=[greedy,checkpoint] checkpoint=runs/dqn/best.pt scenario=paper output=runs/table
    python recipes/evaluate.py scenario=heavy scenario.colocation=true method=[greedy,priced_admit] bounds=true
    python recipes/evaluate.py scenario=heavy scenario_seeds=10 method=[greedy,myopic_optimal] bounds=true
    python recipes/evaluate.py seeds=100 bounds=true parallel.jobs=8

Prints the mean and the 95 % confidence interval of every metric over the workload seeds, and paired differences to a
reference method. With scenario_seeds the network changes with the workload, and intervals are over networks. With
output=DIR it writes DIR/METHOD/seed_S/ (scenario, substrate, workload, decisions, metrics), S the workload seed,
DIR/summary.csv, DIR/per_seed.csv and DIR/evaluation.json (what belongs to it). All keys: config/evaluate.yaml.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import AuditError, ScenarioError
from nfv_torchrl.evaluation.audit import audit_folders, find_runs
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import RunRecord, write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.spread import bounds_of, pieces, run_piece
from nfv_torchrl.evaluation.tables import render, write_summary
from nfv_torchrl.folders import claim
from nfv_torchrl.methods import Method, methods_from_config
from nfv_torchrl.parallel import Workers
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.request_sets import holds_laws
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.recipes import EvaluateSettings, read_settings
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_folder, set_threads


@recipe("evaluate")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, EvaluateSettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    set_threads(cfg.threads)
    scenarios, seeds = read_runs(config)
    methods = methods_from_config(config["method"], scenarios)
    reference = choose_reference(config["reference"], methods)
    comparison = Comparison(scenarios[0])
    worlds = scenarios * len(seeds) if len(scenarios) == 1 else scenarios

    with output_folder(config["output"], methods, seeds) as folder:
        with instantiate(cfg.parallel) as workers:
            for record in run_all(config["method"], methods, scenarios, seeds, workers):
                write_run(folder / record.method / f"seed_{record.workload_seed}", record, comparison.add(record))
            if cfg.bounds:
                add_bounds(comparison, worlds, seeds, workers)
        write_summary(folder, comparison, reference)
        print(render(comparison, reference))
        if cfg.audit:
            audit(folder)
        if config["output"] is not None:
            print(f"\nDecisions and tables: {folder}")


def read_runs(config: dict[str, Any]) -> tuple[list[Scenario], list[int]]:
    """The scenario, or one for each scenario seed, and the workload seeds of all runs.

    With ``scenario_seeds`` the i-th network meets the i-th workload seed. One workload seed for all networks would give
    them the same arrivals, and the interval would leave out how much these matter.
    """
    seeds = list_of_seeds("seeds", config["seeds"])
    if config["scenario_seeds"] is None:
        scenario = Scenario.from_config(config["scenario"])
        if scenario.workload_path is not None and scenario.failures.off and len(seeds) > 1:
            # The same requests again and again would pass for certainty.
            print(f"One workload, that of {scenario.workload_path}: it is run once, under seed {seeds[0]}.\n")
            seeds = seeds[:1]
        return [scenario], seeds
    networks = list_of_seeds("scenario_seeds", config["scenario_seeds"])
    if len(networks) != len(seeds):
        raise ScenarioError(
            f"scenario_seeds: {len(networks)} of them and {len(seeds)} seeds; each network meets one workload seed, so "
            f"use as many, such as seeds={len(networks)}"
        )
    path = config["scenario"]["workload"]["path"]
    if path is not None and not holds_laws(path):
        raise ScenarioError("scenario_seeds: networks change but workload.path is one file; leave one of them null")
    scenarios = [Scenario.from_config({**config["scenario"], "seed": seed}) for seed in networks]
    longest = max(scenario.horizon for scenario in scenarios)  # with horizon=null each is as long as its requests
    return [each if each.horizon == longest else each.replace(horizon=longest) for each in scenarios], seeds


def choose_reference(name: str | None, methods: Sequence[Method]) -> str:
    """The method that the others are paired with."""
    names = [method.name for method in methods]
    if name is None:
        return "greedy" if "greedy" in names else names[0]
    if name not in names:
        raise ScenarioError(f"reference: {name!r} is none of the methods that run; use one of {names}")
    return name


@contextlib.contextmanager
def output_folder(output: str | None, methods: Sequence[Method], seeds: Sequence[int]) -> Iterator[Path]:
    """``output``, or a temporary folder: what is not kept is audited all the same.

    An earlier evaluation in ``output`` is replaced, but not mixed with this one. Jobs of a sweep have folders of their
    own below it.
    """
    if output is None:
        with tempfile.TemporaryDirectory(prefix="evaluation_") as temporary:
            yield Path(temporary)
        return
    folder = run_folder(output, "output")
    claim("output", folder, "evaluation")
    mine = {folder / method.name / f"seed_{seed}" for method in methods for seed in seeds}
    others = [str(run.relative_to(folder)) for run in find_runs(folder) if run not in mine]
    if others:
        raise ScenarioError(
            f"output: {folder} holds {', '.join(others[:3])} of another evaluation; name another folder or empty it"
        )
    yield folder


def run_all(
    entries: Mapping[str, Any],
    methods: Sequence[Method],
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    workers: Workers,
) -> Iterator[RunRecord]:
    """The records of all methods, one after the other here, or in pieces by several workers."""
    if workers.jobs > 1:
        work = [
            piece
            for (key, entry), method in zip(entries.items(), methods, strict=True)
            for piece in pieces({key: entry}, method, scenarios, seeds)
        ]
        for records in ProgressBar(workers.map(run_piece, work), total=len(work), unit="run"):
            yield from records
        return
    worlds = list(scenarios) * len(seeds) if len(scenarios) == 1 else scenarios
    requests = sum(len(world.workload(seed)) for world, seed in zip(worlds, seeds, strict=True))
    for method in methods:
        with ProgressBar(total=requests, desc=method.name, unit="request") as bar:
            records = run_method(scenarios, method, seeds, progress=bar.update)
        yield from records


def add_bounds(comparison: Comparison, worlds: Sequence[Scenario], seeds: Sequence[int], workers: Workers) -> None:
    """Upper bounds on AAR; ``worlds``: the scenario of each of the ``seeds``."""
    runs = list(zip(worlds, seeds, strict=True))
    found = ProgressBar(workers.map(bounds_of, runs), total=len(runs), desc="bounds", unit="seed")
    for seed, bounds in zip(seeds, found, strict=True):
        for name, aar in bounds.items():
            comparison.add_bound(name, seed, aar)


def audit(folder: Path) -> None:
    """Recompute everything from the files in ``folder`` but bounds, which have been solved a moment ago."""
    reports = audit_folders([folder], progress=lambda runs: ProgressBar(runs, desc="audit", unit="run"))
    found = [f"{report.folder}: {problem}" for report in reports for problem in report.problems]
    if found:
        raise AuditError("\n  ".join(["the audit found", *found]))
    print(f"\nAudit, runs: {len(reports)}, requests: {sum(r.requests for r in reports):,}, nothing found.")


if __name__ == "__main__":
    main()
