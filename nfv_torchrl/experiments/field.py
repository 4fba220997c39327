"""Methods on networks and requests that others use, at several loads: rows, table and picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from hydra import compose
from hydra.errors import HydraException
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.pivot import result_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval
from nfv_torchrl.evaluation.tables import UNDEFINED, Table
from nfv_torchrl.experiments.cells import Cell, CellStore, make_cell
from nfv_torchrl.experiments.drawing import panel_figure
from nfv_torchrl.experiments.rows import LOWEST, cost_ratios, lowest, together, values
from nfv_torchrl.experiments.transfer import POLICY, is_policy
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.cli import recipe_configs

MEASURES = {
    "aar": ".4f",
    "lrc": ".3f",
    "lar": ",.0f",
    "cost_per_accepted": ",.1f",
    "decisions_per_second": ",.0f",
    "unproved": ",.1f",
}
"""What a table shows of every method, where its runs have it; ``unproved`` only if it is not zero everywhere."""
ROUNDING = 1e-9
"""An interval that is a smaller share of its mean is none: it is what rounding leaves where all are the same."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Place:
    """One network at one load.

    Attributes:
        name: of the network.
        load: what is varied, such as an arrival rate.
        methods: an evaluation for each.
        bound: what no method can exceed; None: not asked for.
    """

    name: str
    load: float
    methods: Mapping[str, Cell]
    bound: Cell | None

    @property
    def cells(self) -> list[Cell]:
        """All that is to compute."""
        return [*self.methods.values(), *([] if self.bound is None else [self.bound])]


def places_of(config: Mapping[str, Any], recipes: Path) -> list[Place]:
    """Every network of ``config["places"]`` at each of its loads.

    Raises:
        ScenarioError: ``only`` names none of them, or overrides that no scenario has.
    """
    wanted = config["only"] or list(config["places"])
    if unknown := [name for name in wanted if name not in config["places"]]:
        raise ScenarioError(f"only: there is no {unknown[0]!r}; places: {', '.join(config['places'])}")
    return [
        _place(config, recipes, name, load, check=number == 0)
        for name in wanted
        for number, load in enumerate(config["places"][name]["loads"])
    ]


def _place(config: Mapping[str, Any], recipes: Path, name: str, load: float, check: bool) -> Place:
    """``check``: whether to read the scenario's files now, so that what cannot be read is said before any work."""
    overrides = [*config["common"], *config["places"][name]["overrides"], *config["overrides"]]
    at_load = [text.replace("LOAD", f"{load:g}") for text in overrides]
    scenario = scenario_config(recipes, f"places.{name}", at_load)
    if check:
        _read(scenario, f"places.{name}")
    seeds = list(range(config["seeds"]))
    common = {"scenario": scenario, "seeds": seeds} | ({"scenario_seeds": seeds} if config["draws"] else {})
    where = f"{name}-{load:g}"
    entries = {key: limited(method, config["labels"]) for key, method in config["method"].items()}
    methods = {
        key: make_cell("evaluation", f"{where}-{key}", {**common, "method": method, "training": None})
        for key, method in entries.items()
    }
    return Place(name, load, methods, make_cell("bound", f"{where}-bound", common) if config["bounds"] else None)


def _read(scenario: Mapping[str, Any], name: str) -> None:
    try:
        Scenario.from_config(scenario)
    except ScenarioError as error:
        raise ScenarioError(f"{name}: {error}") from error


def limited(method: Mapping[str, Any], labels: int | None) -> Mapping[str, Any]:
    """The settings of a method with ``labels`` as the limit of its exact search, if it has one, and none of its own."""
    planner = method.get("planner")
    if labels is None or not isinstance(planner, Mapping) or planner.get("labels", 0) is not None:
        return method
    return {**method, "planner": {**planner, "labels": labels}}


def scenario_config(recipes: Path, name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The scenario that evaluate.py would read from ``overrides``.

    Raises:
        ScenarioError: overrides that it does not take; ``name`` says whose they are.
    """
    try:
        with recipe_configs(recipes):
            composed = compose("evaluate", list(overrides))
    except HydraException as error:
        raise ScenarioError(f"{name}: {error}") from error
    return cast(dict[str, Any], OmegaConf.to_container(composed.scenario, resolve=True))


def place_rows(place: Place, store: CellStore, reference: str) -> Rows:
    """One row for each number of a place: means over seeds with their intervals.

    The policies of several training seeds are one method: for each seed of the place their mean.
    """
    results = {key: store.read(cell) for key, cell in place.methods.items()}
    about = {
        "network": place.name,
        "load": place.load,
        "rho": round(next(iter(results.values()))["rho"], 4),
        "source": "",
    }
    rows = []
    for name, keys in _as_one(results).items():
        runs = list(results[keys[0]]["metrics"].values())
        for metric in [metric for metric in MEASURES if metric in runs[0]]:
            rows.append(result_row(about, name, metric, together([values(results[key], metric) for key in keys])))
        if reference in results and name != reference:
            theirs = values(results[reference], "aar")
            differences = [np.subtract(values(results[key], "aar"), theirs) for key in keys]
            costs = [cost_ratios(store, (place.methods[key],), (place.methods[reference],)) for key in keys]
            rows.append(result_row(about, name, "aar_difference", together(differences), reference))
            if len(keys) > 1:
                rows.append(result_row(about, name, LOWEST, lowest(differences), reference))
            rows.append(result_row(about, name, "paired_cost", together(costs), reference))
    if place.bound is not None and store.has(place.bound):
        for kind, by_seed in store.read(place.bound)["bounds"].items():
            rows.append(result_row(about, f"bound: {kind}", "aar", mean_interval(list(by_seed.values()))))
    return rows


def _as_one(methods: Iterable[str]) -> dict[str, list[str]]:
    """What has a row: every method, and the policies of several training seeds as one; their keys."""
    named: dict[str, list[str]] = {}
    for key in methods:
        named.setdefault(POLICY if is_policy(key) else key, []).append(key)
    return named


def runs_of(place: Place, store: CellStore) -> list[tuple[str, dict[str, Any]]]:
    """What a manifest says of every run of a place: its name, scenario, seed, and the metrics of every method."""
    spec = next(iter(place.methods.values())).spec
    results = {key: store.read(cell)["metrics"] for key, cell in place.methods.items()}
    runs = []
    for number, seed in enumerate(spec["seeds"]):
        drawn = {"seed": spec["scenario_seeds"][number]} if "scenario_seeds" in spec else {}
        rows = {key: metrics[str(seed)] for key, metrics in results.items()}
        run = {"scenario": {**spec["scenario"], **drawn}, "seed": seed, "rows": rows}
        runs.append((f"{place.name}-{place.load:g}-seed_{seed}", run))
    return runs


def published_rows(published: Sequence[Mapping[str, Any]], places: Sequence[Place]) -> Rows:
    """What others publish of the same networks and loads, with its source; numbers without an interval."""
    there = {(place.name, place.load) for place in places}
    rows = []
    for entry in published:
        if (entry["place"], entry["load"]) not in there:
            continue
        about = {"network": entry["place"], "load": entry["load"], "rho": "", "source": entry["source"]}
        for metric in [metric for metric in MEASURES if metric in entry]:
            number = Interval(float(entry[metric]), float("nan"), float("nan"), int(entry.get("runs", 1)))
            rows.append(result_row(about, entry["method"], metric, number))
    return rows


def field_table(title: str, rows: Rows, reference: str, axis: str) -> Table:
    """One line for each method at each network and load."""
    there = {row["metric"] for row in rows if row["metric"] != "unproved" or row["mean"] > 0}
    measures = [metric for metric in MEASURES if metric in there]
    # RAC is AAR by another name; where requests bring their own demands, readers look for that name.
    heads = {"aar": "RAC" if "lrc" in measures else "AAR", "lrc": "LRC", "lar": "LAR", "cost_per_accepted": "cost $",
             "decisions_per_second": "decisions/s", "unproved": "unproved"}  # fmt: skip
    lines: dict[tuple[str, float, str], dict[tuple[str, str], Any]] = {}
    for row in rows:
        lines.setdefault((row["network"], row["load"], row["method"]), {})[row["metric"], row["reference"]] = row
    ordered = sorted(lines.items(), key=lambda line: (_first(rows, line[0][0]), line[0][1]))
    shown = {(metric, ""): MEASURES[metric] for metric in measures}
    several = any(row["metric"] == LOWEST for row in rows)
    shown |= {("aar_difference", reference): "+.4f"} | ({(LOWEST, reference): "+.4f"} if several else {})
    shown |= {("paired_cost", reference): ".3f"}
    table = [
        (f"{network}, {load:g} {axis}: {method}", *(_shown(found.get(key), form) for key, form in shown.items()))
        for (network, load, method), found in ordered
    ]
    training = ("lowest training seed",) if several else ()
    columns = ("", *(heads[metric] for metric in measures), f"to {reference}", *training, "paired cost")
    return Table(title, columns, tuple(table))


def _first(rows: Rows, network: str) -> int:
    return next(number for number, row in enumerate(rows) if row["network"] == network)


def _shown(row: Mapping[str, Any] | None, form: str) -> str:
    if row is None or row["mean"] != row["mean"]:
        return UNDEFINED
    half = max(row["mean"] - row["ci_low"], row["ci_high"] - row["mean"])
    # Runs that are played side by side share one measurement of time, which has no interval but that of rounding.
    alone = half != half or (half <= ROUNDING * row["mean"] and row["metric"] == "decisions_per_second")
    return f"{row['mean']:{form}}" + ("" if alone else f" ± {half:{form.removeprefix('+')}}")


def field_figure(title: str, rows: Rows, axis: str, caption: str) -> Figure:
    """Acceptance over the load, a panel for each network; what others publish are points of their own."""
    shown = [row for row in rows if row["metric"] == "aar"]
    tidy = [
        tidy_row(row["method"], row["load"], Interval(row["mean"], row["ci_low"], row["ci_high"], row["n"]),
                 panel=row["network"])
        for row in shown
    ]  # fmt: skip
    return panel_figure(tidy, title=title, caption=caption, x_label=axis, y_label="acceptance ratio")
