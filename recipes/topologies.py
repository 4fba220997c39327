"""Compare methods on many networks at several loads: every topology that ships, and a large random network.

    python recipes/topologies.py method=[myopic_optimal,priced_admit,checkpoint] checkpoint=runs/evolution/best.pt
    python recipes/topologies.py networks=[abilene,geant2009] rho=[1] seeds=3

On each network every seed draws VMs, costs and endpoints anew (scenario seed) and the requests (workload seed), the
same for all methods; VM capacities are scaled to the offered load rho. Prints a table with a row for each network and
load, and writes it to OUTPUT/topologies.csv and .md as rows are done. All keys: config/topologies.yaml.
"""

from __future__ import annotations

import csv
import io
import tempfile
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from nfv_torchrl.errors import AuditError, ScenarioError
from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.methods import methods_from_config
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import overview_table
from nfv_torchrl.files import write_atomically
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.cli import check_keys, clear_errors
from nfv_torchrl.training.setup import set_threads

KEYS = ("scenario", "method", "checkpoint", "networks", "all_networks", "rho", "seeds", "reference", "output")


@hydra.main(config_path="config", config_name="topologies", version_base=None)
@clear_errors
def main(cfg: DictConfig) -> None:
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    check_keys(config, KEYS)
    set_threads(1)
    names = config["networks"] or list(config["all_networks"])
    for name in names:
        if name not in config["all_networks"]:
            raise ScenarioError(f"networks: there is no {name!r}; use {', '.join(config['all_networks'])}")
    comparisons: dict[str, Comparison] = {}
    for name, rho in tqdm([(name, rho) for name in names for rho in config["rho"]], unit="row", disable=None):
        comparisons[f"{name}, rho {rho:g}"] = compare(config, name, rho)
        write(comparisons, config)
    print(overview_table(comparisons, reference(config, comparisons)).text())
    print(f"\nAudit of every run: nothing found. Tables: {config['output']}")


def compare(config: dict[str, Any], name: str, rho: float) -> Comparison:
    """All methods on one network at one load, audited."""
    scenarios = [scenario(config, name, rho, seed) for seed in range(config["seeds"])]
    comparison = Comparison(scenarios[0])
    with tempfile.TemporaryDirectory(prefix="topologies_") as temporary:
        for method in methods_from_config(config["method"], scenarios):
            for record in run_method(scenarios, method, range(config["seeds"])):
                folder = Path(temporary) / method.name / f"seed_{record.workload_seed}"
                write_run(folder, record, comparison.add(record))
        found = [problem for report in audit_folders([Path(temporary)]) for problem in report.problems]
    if found:
        raise AuditError("\n  ".join([f"{name}, rho {rho}: the audit found", *map(str, found)]))
    return comparison


def scenario(config: dict[str, Any], name: str, rho: float, seed: int) -> Scenario:
    """One draw of VMs, costs and endpoints on a network."""
    base = config["scenario"]
    substrate = {**base["substrate"], **config["all_networks"][name], "target_rho": rho}
    return Scenario.from_config({**base, "name": name, "seed": seed, "substrate": substrate})


def reference(config: dict[str, Any], comparisons: dict[str, Comparison]) -> str:
    """The method that the others are paired with."""
    methods = next(iter(comparisons.values())).methods
    if config["reference"] not in methods:
        raise ScenarioError(f"reference: {config['reference']!r} is none of the methods that run; use one of {methods}")
    return config["reference"]


def write(comparisons: dict[str, Comparison], config: dict[str, Any]) -> None:
    """The table so far, as Markdown and CSV."""
    table = overview_table(comparisons, reference(config, comparisons))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.columns, *table.rows])
    write_atomically(Path(config["output"]) / "topologies.csv", text.getvalue())
    write_atomically(Path(config["output"]) / "topologies.md", table.markdown() + "\n")


if __name__ == "__main__":
    main()
