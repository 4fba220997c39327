"""One policy, or those of several training seeds, on many networks: from cells to rows and tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.pivot import Column, pivot, result_row
from nfv_torchrl.evaluation.statistics import mean_interval
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.rows import LOWEST, cost_ratios, lowest, together, values
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.vocabulary import TABLE

POLICY = "checkpoint"
OF_SERVICES = ("aar/SERVICE", "turned_away/SERVICE")
"""What is told for each service, of the policy."""
Rows = list[dict[str, Any]]


def policy_files(config: Mapping[str, Any]) -> list[str]:
    """The policies that ``checkpoint`` or ``checkpoints`` names, one for each training seed.

    Raises:
        ScenarioError: there is none, or one is no file.
    """
    files = config["checkpoints"] or [config["checkpoint"]]
    for file in files:
        if file is None or not Path(file).is_file():
            raise ScenarioError(f"checkpoint: {file} is no file; name one, such as runs/candidate/best.pt")
    return list(files)


def with_policies(methods: Mapping[str, Any], files: Sequence[str]) -> dict[str, Any]:
    """The methods, with one for each policy file: ``checkpoint``, or ``checkpoint_0``, ``checkpoint_1`` and so on."""
    found = {}
    for key, method in methods.items():
        if key != POLICY:
            found[key] = method
            continue
        for number, file in enumerate(files):
            name = POLICY if len(files) == 1 else f"{POLICY}_{number}"
            found[name] = {**method, "path": file, "name": name}
    return found


def is_policy(name: str) -> bool:
    """Whether a method is the policy, of any training seed."""
    return re.fullmatch(rf"{POLICY}(_\d+)?", name) is not None


def network_rows(
    name: str, world: Mapping[str, Any], cells: Mapping[str, Cell], bound: Cell | None, store: CellStore
) -> Rows:
    """One row for each quantity of one network: mean over its seeds and its interval.

    The policies of several training seeds are one method: for each seed of the network their mean, so that the interval
    says what other networks and requests would change. ``aar_difference_lowest`` is the mean of the training seed that
    is lowest.
    """
    scenario = Scenario.from_config(world)
    about = {"network": name, "nodes": scenario.substrate.num_nodes, "rho": round(scenario.offered_load(), 4)}
    policies = [cell for key, cell in cells.items() if is_policy(key)]
    others = {key: cell for key, cell in cells.items() if not is_policy(key)}
    rows = [
        result_row(about, key, "aar", mean_interval(values(store.read(cell), "aar"))) for key, cell in others.items()
    ]
    if policies:
        rows += _own_rows(about, policies, [service.name for service in scenario.catalogue.types], store)
        for key, cell in others.items():
            rows += _paired_rows(about, policies, key, cell, store)
    if bound is not None and store.has(bound):
        for kind, by_seed in store.read(bound)["bounds"].items():
            rows.append(result_row(about, kind, "aar_bound", mean_interval(list(by_seed.values()))))
    return rows


def _own_rows(about: Mapping[str, Any], policies: Sequence[Cell], services: Sequence[str], store: CellStore) -> Rows:
    """What the policy does by itself, in all and for each service."""
    results = [store.read(cell) for cell in policies]
    rows = [result_row(about, POLICY, "aar", together([values(result, "aar") for result in results]))]
    for service in services:
        for metric in OF_SERVICES:
            samples = [values(result, TABLE[metric].key(service)) for result in results]
            rows.append(result_row(about, POLICY, metric, together(samples), part=service))
    return rows


def _paired_rows(about: Mapping[str, Any], policies: Sequence[Cell], key: str, other: Cell, store: CellStore) -> Rows:
    """The policy against another method, on the same requests."""
    theirs = values(store.read(other), "aar")
    differences = [np.subtract(values(store.read(cell), "aar"), theirs) for cell in policies]
    costs = [cost_ratios(store, (cell,), (other,)) for cell in policies]
    rows = [
        result_row(about, POLICY, "aar_difference", together(differences), key),
        result_row(about, POLICY, "paired_cost", together(costs), key),
    ]
    if len(policies) > 1:
        rows.append(result_row(about, POLICY, LOWEST, lowest(differences), key))
    return rows


def transfer_tables(rows: Rows, methods: Sequence[str], about: str) -> list[Table]:
    """The rows as two tables with a line for each network: the policy beside the others, then its services.

    Args:
        rows: of ``network_rows``.
        methods: names of all methods.
        about: what the title says of seeds and rules.
    """
    others = [key for key in methods if not is_policy(key)]
    bounds = dict.fromkeys(row["method"] for row in rows if row["metric"] == "aar_bound")
    seeds_to = dict.fromkeys(row["reference"] for row in rows if row["metric"] == LOWEST)
    columns = [
        *(Column("aar", ".4f", key) for key in (*others, POLICY)),
        *(Column("aar_difference", "+.4f", POLICY, key) for key in others),
        *(Column(LOWEST, "+.4f", POLICY, key, f"lowest training seed to {key}") for key in seeds_to),
        *(Column("paired_cost", ".3f", POLICY, key) for key in others),
        *(Column("aar_bound", ".4f", kind) for kind in bounds),
    ]
    by = {"network": "", "nodes": "", "rho": ".2f"}
    parts = dict.fromkeys(row["metric"] for row in rows if "/" in row["metric"])
    of_services = [Column(metric, ".4f", POLICY, title=re.sub("[_/]", " ", metric)) for metric in sorted(parts)]
    return [
        pivot(f"One policy on every network: {about}", rows, by, columns),
        pivot(
            "The policy by service: AAR, and the share rejected although there was a walk",
            rows,
            {"network": ""},
            of_services,
        ),
    ]
