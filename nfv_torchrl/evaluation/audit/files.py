"""Reads the five files of a run with the standard library alone.

Nothing here, nor anywhere in the audit, uses the code that made the run: a mistake in that code must not hide itself.
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from nfv_torchrl.evaluation.audit.problems import Problems, UnreadableRun

UNITS = 1_000_000
"""Whole bit/s in a Mbit/s, whole cycles/s in a Mcycles/s: amounts are compared as whole numbers, exactly."""
LONGEST_STAY = 2**40
"""Slots; whoever asks for more leaves then."""

WORKLOAD_HEADERS = [
    ["slot", "service", "ingress_index", "egress_index", "lifetime"],
    ["slot", "service", "ingress", "egress", "lifetime"],  # of older runs; indices too
]
SCENARIO_KEYS: dict[str, Any] = {
    "horizon": int, "warmup": int, "arrival_rate": (int, float), "mean_lifetime": (int, float), "colocation": bool,
    "mask": str, "admission_control": bool, "observe_lifetime": bool, "max_steps": int, "vnfs": dict,
    "services": list, "failure_timeline": list, "seeds": dict, "method": str, "workload_path": (str, type(None)),
}  # fmt: skip


class Vm(NamedTuple):
    """Capacity in cycles/s and in Mcycles/s, unit cost in $ per Mcycles/s."""

    units: int
    capacity: float
    unit_cost: float


class Link(NamedTuple):
    """Capacity in bit/s and in Mbit/s, propagation delay in ms, unit cost in $ per Mbit/s."""

    units: int
    capacity: float
    delay: float
    unit_cost: float


class Service(NamedTuple):
    """Load of each function of the chain in cycles/s and in Mcycles/s; rate in bit/s and Mbit/s; delay budget in ms."""

    load_units: tuple[int, ...]
    load: tuple[float, ...]
    rate_units: int
    rate: float
    tolerable_delay: float
    weight: float


class Request(NamedTuple):
    """One row of workload.csv."""

    slot: int
    service: str
    ingress: int
    egress: int
    lifetime: float

    @property
    def departure(self) -> int:
        """Slot at whose beginning it leaves; lifetimes past all horizons count as :data:`LONGEST_STAY`."""
        return self.slot + min(max(1, math.ceil(self.lifetime)), LONGEST_STAY)


@dataclass
class RunFiles:
    """A run as its files tell it. ``decisions[k]`` is line k + 1, None where that line could not be read."""

    scenario: dict[str, Any]
    vms: list[list[Vm]]
    links: dict[tuple[int, int], Link]
    services: dict[str, Service]
    workload: list[Request]
    decisions: list[dict[str, Any] | None]
    metrics: dict[str, Any]
    problems: Problems = field(default_factory=Problems)


def read_run(folder: Path) -> RunFiles:
    """Read all files of the run in ``folder``.

    Raises:
        UnreadableRun: a file is missing, or broken beyond what can be reported line by line.
    """
    problems = Problems()
    scenario = _read_json(folder / "scenario.json")
    for key, kind in SCENARIO_KEYS.items():
        if key not in scenario or not isinstance(scenario[key], kind):
            raise UnreadableRun(f"scenario.json: '{key}' is missing or of the wrong kind")
    try:
        services = _services(scenario)
        vms, links = _substrate(_read_json(folder / "substrate.json"), problems)
        workload = _workload(folder / "workload.csv", len(vms), services, scenario["horizon"])
    except (KeyError, TypeError, AttributeError) as error:
        raise UnreadableRun(f"scenario.json or substrate.json lacks something: {error!r}") from error
    decisions = _decisions(folder / "decisions.jsonl", problems)
    return RunFiles(scenario, vms, links, services, workload, decisions, _read_json(folder / "metrics.json"), problems)


def is_number(value: Any) -> bool:
    """A finite JSON number; true and false are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def is_index(value: Any) -> bool:
    """A JSON integer; true and false are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def _services(scenario: dict[str, Any]) -> dict[str, Service]:
    cycles = scenario["vnfs"]
    result = {}
    for entry in scenario["services"]:
        rate = entry["rate"]
        load = tuple(cycles[vnf] * rate for vnf in entry["chain"])
        result[entry["name"]] = Service(
            tuple(round(x * UNITS) for x in load), load, round(rate * UNITS), rate, entry["tolerable_delay"],
            entry["weight"],
        )  # fmt: skip
    return result


def _substrate(document: dict[str, Any], problems: Problems) -> tuple[list[list[Vm]], dict[tuple[int, int], Link]]:
    nodes = {node["id"]: node["vms"] for node in document["nodes"]}
    if sorted(nodes) != list(range(len(nodes))):
        raise UnreadableRun("substrate.json: the node ids are not 0, 1, 2, ...")
    vms = [
        [Vm(round(vm["capacity"] * UNITS), vm["capacity"], vm["unit_cost"]) for vm in nodes[node]]
        for node in range(len(nodes))
    ]
    for node, here in enumerate(vms):
        if not here or any(vm.units <= 0 for vm in here):
            problems.add(f"substrate.json: node {node} has no VM, or one without capacity")
    links: dict[tuple[int, int], Link] = {}
    for link in document["links"] if "links" in document else document["edges"]:
        ends = (min(link["source"], link["target"]), max(link["source"], link["target"]))
        if ends in links or ends[0] == ends[1] or not {*ends} <= nodes.keys():
            problems.add(f"substrate.json: link {ends} is there twice, joins a node to itself or an unknown node")
        links[ends] = Link(round(link["capacity"] * UNITS), link["capacity"], link["delay"], link["unit_cost"])
        if links[ends].units <= 0:
            problems.add(f"substrate.json: link {ends} has no capacity")
    return vms, links


def _workload(path: Path, nodes: int, services: dict[str, Service], horizon: int) -> list[Request]:
    requests: list[Request] = []
    with _open(path) as file:
        rows = csv.reader(file)
        if next(rows, None) not in WORKLOAD_HEADERS:
            raise UnreadableRun(f"workload.csv: the header is not {','.join(WORKLOAD_HEADERS[0])}")
        for row in rows:
            where = f"workload.csv line {rows.line_num}"
            try:
                slot, service, ingress, egress, lifetime = row
                request = Request(int(slot), service, int(ingress), int(egress), float(lifetime))
            except ValueError as error:
                raise UnreadableRun(f"{where}: {error}") from error
            earliest = requests[-1].slot if requests else 0
            if not earliest <= request.slot < horizon:
                raise UnreadableRun(f"{where}: slot {request.slot} is out of order or beyond the horizon {horizon}")
            if service not in services:
                raise UnreadableRun(f"{where}: unknown service {service!r}")
            if not (0 <= request.ingress < nodes and 0 <= request.egress < nodes and ingress != egress):
                raise UnreadableRun(f"{where}: ingress {ingress} and egress {egress} are not two nodes of the network")
            if not 0 < request.lifetime < math.inf:
                raise UnreadableRun(f"{where}: the lifetime {lifetime} is not positive")
            requests.append(request)
    return requests


def _decisions(path: Path, problems: Problems) -> list[dict[str, Any] | None]:
    decoder = json.JSONDecoder(parse_constant=_refuse_constant, object_pairs_hook=_object)
    decisions: list[dict[str, Any] | None] = []
    with _open(path) as file:
        for line, text in enumerate(file, start=1):
            decision = None
            try:
                decision = decoder.decode(text)
                if not isinstance(decision, dict):
                    decision = None
                    raise ValueError("not a JSON object")
            except ValueError as error:
                problems.add(f"decisions.jsonl line {line}: {error}")
            decisions.append(decision)
    return decisions


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("a key is there twice")
    return result


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")


def _read_json(path: Path) -> dict[str, Any]:
    with _open(path) as file:
        try:
            document = json.load(file, parse_constant=_refuse_constant, object_pairs_hook=_object)
        except ValueError as error:
            raise UnreadableRun(f"{path.name}: {error}") from error
    if not isinstance(document, dict):
        raise UnreadableRun(f"{path.name}: not a JSON object")
    return document


def _open(path: Path) -> Any:
    try:
        return path.open(newline="", encoding="utf-8")
    except OSError as error:
        raise UnreadableRun(f"{path.name}: {error.strerror}") from error
