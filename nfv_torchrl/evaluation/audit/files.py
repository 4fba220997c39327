"""Reads the five files of a run with the standard library alone.

Nothing here, nor anywhere in the audit, uses the code that made the run: a mistake in that code must not hide itself.
"""

from __future__ import annotations

import csv
import io
import json
import math
import stat
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from nfv_torchrl.evaluation.audit.problems import Problems, UnreadableRun

UNITS = 1_000_000
"""Whole bit/s in a Mbit/s, whole cycles/s in a Mcycles/s: amounts are compared as whole numbers, exactly."""
LONGEST_STAY = 2**40
"""Slots; whoever asks for more leaves then."""
LONGEST_HORIZON, MOST_REQUESTS = 10_000_000, 5_000_000
LARGEST_FILE, LONGEST_LINE = 2 << 30, 16 << 20
"""Bytes. More than any run has; a device or a damaged file shall not fill the memory."""
LARGEST_INTEGER = 2**128
"""Seeds have that many bits at most."""

WORKLOAD_HEADERS = [
    ["slot", "service", "ingress_index", "egress_index", "lifetime"],
    ["slot", "service", "ingress_index", "egress_index", "lifetime", "demand"],
    ["slot", "service", "ingress_index", "egress_index", "lifetime", "time"],
    ["slot", "service", "ingress_index", "egress_index", "lifetime", "demand", "time"],
    ["slot", "service", "ingress", "egress", "lifetime"],  # of older runs; indices too
]
SCENARIO_KEYS: dict[str, Any] = {
    "horizon": int, "warmup": int, "arrival_rate": (int, float), "mean_lifetime": (int, float), "colocation": bool,
    "mask": str, "admission_control": bool, "observe_lifetime": bool, "max_steps": int, "vnfs": dict,
    "services": list, "failure_timeline": list, "seeds": dict, "method": str, "workload_path": (str, type(None)),
}  # fmt: skip


ANY, FREE = "any", -1
"""An end of a request that is free, in files and here."""
PAPER_KINDS = [{"name": "cpu", "scales_with_rate": True}]


class Vm(NamedTuple):
    """Of each kind of resources: capacity in whole millionths and in its unit (Mcycles/s), unit cost in $."""

    units: tuple[int, ...]
    capacity: tuple[float, ...]
    unit_cost: tuple[float, ...]


class Link(NamedTuple):
    """One direction of a link. Capacity in bit/s and in Mbit/s, delay in ms, unit cost in $ per Mbit/s."""

    units: int
    capacity: float
    delay: float
    unit_cost: float


class Service(NamedTuple):
    """What a request asks for: amounts of each function and kind, in millionths and in units; rate of each segment.

    ``work``: Mcycles/s that the processing delay of a function follows from. ``own_delay``: ms beside it.
    ``tolerable_delay``: ms, infinite where any will do. ``weight``: of a service in the mix. ``mean_lifetime``: s.
    """

    load_units: tuple[tuple[int, ...], ...]
    load: tuple[tuple[float, ...], ...]
    work: tuple[float, ...]
    own_delay: tuple[float, ...]
    rate_units: tuple[int, ...]
    rate: tuple[float, ...]
    tolerable_delay: float
    weight: float = 0.0
    mean_lifetime: float = 0.0


class Request(NamedTuple):
    """One row of workload.csv."""

    slot: int
    service: str
    ingress: int
    egress: int
    lifetime: float
    demand: str = ""
    time: float | None = None

    @property
    def departure(self) -> int:
        """Slot at whose beginning it has left; lifetimes past all horizons count as ``LONGEST_STAY``."""
        if self.time is not None:
            return max(self.slot + 1, math.ceil(min(self.leaves, LONGEST_STAY)))
        return self.slot + min(max(1, math.ceil(self.lifetime)), LONGEST_STAY)

    @property
    def arrives(self) -> float:
        """When it comes, s."""
        return self.slot if self.time is None else self.time

    @property
    def leaves(self) -> float:
        """When it leaves, s, before all that come then or later."""
        if self.time is None:
            return self.departure
        return max(self.time + self.lifetime, math.nextafter(self.time, math.inf))


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
    demands: dict[tuple[str, str], Service] = field(default_factory=dict)

    def asked(self, request: Request) -> Service:
        """What a request asks for: its own demand, or that of its service."""
        return self.demands[request.service, request.demand] if request.demand else self.services[request.service]

    @property
    def steps_are_shared(self) -> bool:
        """Whether the requests of a service in a slot share the steps that they may take."""
        return self.scenario.get("step_budget") == "slot"

    @property
    def distinct(self) -> bool:
        """Whether functions of a request may not share a node."""
        return self.scenario.get("placement") == "distinct"

    def link_between(self, tail: int, head: int) -> tuple[tuple[int, int], Link] | None:
        """The link that leads from one node to another, and the name of its capacity; None if there is none."""
        link = self.links.get((tail, head))
        if link is not None:
            return (tail, head), link
        link = self.links.get((head, tail))
        return None if link is None or self.full_duplex else ((head, tail), link)

    @cached_property
    def full_duplex(self) -> bool:
        """Whether each direction of a link has a capacity of its own; ``links`` then has both."""
        return any((head, tail) in self.links for tail, head in self.links)


def read_run(folder: Path) -> RunFiles:
    """Read all files of the run in ``folder``.

    Raises:
        UnreadableRun: a file is missing, or broken beyond what can be reported line by line.
    """
    problems = Problems()
    scenario = read_json(folder / "scenario.json")
    for key, kind in SCENARIO_KEYS.items():
        wrong = isinstance(scenario.get(key), bool) and kind is not bool
        if key not in scenario or wrong or not isinstance(scenario[key], kind):
            raise UnreadableRun(f"scenario.json: '{key}' is missing or of the wrong kind")
    if not 0 <= scenario["warmup"] < scenario["horizon"] <= LONGEST_HORIZON or scenario["max_steps"] < 1:
        raise UnreadableRun("scenario.json: horizon, warmup or max_steps is out of range")
    try:
        services = _services(scenario)
        kinds: list[dict[str, Any]] = scenario.get("resources") or PAPER_KINDS
        vms, links = _substrate(read_json(folder / "substrate.json"), [kind["name"] for kind in kinds], problems)
        workload = _workload(folder / "workload.csv", len(vms), services, scenario["horizon"])
        demands = {
            (request.service, request.demand): _demand(request.demand, kinds) for request in workload if request.demand
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise UnreadableRun(f"scenario.json or substrate.json lacks something: {error!r}") from error
    decisions = _decisions(folder / "decisions.jsonl", problems)
    metrics = read_json(folder / "metrics.json")
    return RunFiles(scenario, vms, links, services, workload, decisions, metrics, problems, demands)


def is_number(value: Any) -> bool:
    """A finite JSON number; true and false are none."""
    return is_index(value) or (isinstance(value, float) and math.isfinite(value))


def is_index(value: Any) -> bool:
    """A JSON integer; true and false are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def _services(scenario: dict[str, Any]) -> dict[str, Service]:
    kinds = scenario.get("resources") or PAPER_KINDS
    result = {}
    for entry in scenario["services"]:
        chain = [scenario["vnfs"][vnf] for vnf in entry["chain"]]
        rates = entry.get("rates") or [mean_of(entry["rate"])] * (len(chain) + 1)
        if len(rates) != len(chain) + 1:
            raise UnreadableRun(f"scenario.json: service {entry['name']!r} has {len(rates)} rates")
        chain = [vnf if isinstance(vnf, dict) else {kinds[0]["name"]: vnf} for vnf in chain]
        load = [
            tuple(vnf.get(kind["name"], 0.0) * (rate if kind["scales_with_rate"] else 1.0) for kind in kinds)
            for vnf, rate in zip(chain, rates, strict=False)
        ]
        own = [vnf.get("delay") for vnf in chain]
        asked = _asked(load, rates, mean_of(entry["tolerable_delay"]), own, kinds)
        own_mean = entry.get("mean_lifetime")
        result[entry["name"]] = asked._replace(
            weight=entry["weight"], mean_lifetime=scenario["mean_lifetime"] if own_mean is None else own_mean
        )
    return result


def mean_of(value: Any) -> Any:
    """A number, or the middle of an interval that requests draw from."""
    return (value[0] + value[1]) / 2 if isinstance(value, list) else value


def _asked(
    load: list[tuple[float, ...]],
    rates: list[float],
    tolerable: float | None,
    own: list[float | None],
    kinds: list[Any],
) -> Service:
    """``own``: processing delay that each function states, None where it follows from load and VM."""
    scales = kinds[0]["scales_with_rate"]
    return Service(
        load_units=tuple(tuple(round(x * UNITS) for x in amounts) for amounts in load),
        load=tuple(load),
        work=tuple(x[0] if stated is None and scales else 0.0 for x, stated in zip(load, own, strict=True)),
        own_delay=tuple(stated or 0.0 for stated in own),
        rate_units=tuple(round(rate * UNITS) for rate in rates),
        rate=tuple(rates),
        tolerable_delay=math.inf if tolerable is None else tolerable,
    )


def _demand(text: str, kinds: list[Any]) -> Service:
    """The demand in a cell of workload.csv."""
    try:
        data = _parse_object(text.encode())
        columns = [[float(x) for x in data["amounts"][kind["name"]]] for kind in kinds]
        load = list(zip(*columns, strict=True))
        rates = data["rates"] if isinstance(data["rates"], list) else [data["rates"]] * (len(load) + 1)
        own = data.get("processing_delay") or [None] * len(load)
        if len(rates) != len(load) + 1 or len(own) != len(load):
            raise ValueError("numbers of rates or processing delays that do not fit the functions")
        return _asked(load, [float(rate) for rate in rates], data.get("tolerable_delay"), own, kinds)
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableRun(f"workload.csv: the demand {text[:100]!r} is none: {error!r}") from error


def _substrate(
    document: dict[str, Any], kinds: list[str], problems: Problems
) -> tuple[list[list[Vm]], dict[tuple[int, int], Link]]:
    nodes = {node["id"]: node["vms"] for node in document["nodes"]}
    if sorted(nodes) != list(range(len(nodes))):
        raise UnreadableRun("substrate.json: the node ids are not 0, 1, 2, ...")
    if document.get("graph", {}).get("resources", ["cpu"]) != kinds:
        raise UnreadableRun(f"substrate.json: its kinds of resources are not those of scenario.json, {kinds}")
    vms = [[_vm(vm, kinds) for vm in nodes[node]] for node in range(len(nodes))]
    for node, here in enumerate(vms):
        if any(units <= 0 for vm in here for units in vm.units):
            problems.add(f"substrate.json: node {node} has a VM without capacity")
    links: dict[tuple[int, int], Link] = {}
    for link in document["links"] if "links" in document else document["edges"]:
        ends = (min(link["source"], link["target"]), max(link["source"], link["target"]))
        if ends in links or ends[0] == ends[1] or not {*ends} <= nodes.keys():
            problems.add(f"substrate.json: link {ends} is there twice, joins a node to itself or an unknown node")
        directions = {ends: link["capacity"]}
        if "back_capacity" in link:
            directions[ends[::-1]] = link["back_capacity"]
        for direction, capacity in directions.items():
            links[direction] = Link(round(capacity * UNITS), capacity, link["delay"], link["unit_cost"])
            if links[direction].units <= 0:
                problems.add(f"substrate.json: link {ends} has no capacity")
    if len({"back_capacity" in link for link in document.get("links", document.get("edges", []))}) > 1:
        problems.add("substrate.json: some links have a back_capacity, others not")
    return vms, links


def _vm(vm: dict[str, Any], kinds: list[str]) -> Vm:
    capacity, unit_cost = (
        tuple(vm[key][kind] for kind in kinds) if isinstance(vm[key], dict) else (vm[key],)
        for key in ("capacity", "unit_cost")
    )
    return Vm(tuple(round(x * UNITS) for x in capacity), capacity, unit_cost)


def read_csv(path: Path, *headers: list[str]) -> tuple[list[tuple[int, list[str]]], list[str]]:
    """The rows below one of the ``headers``, with their line numbers; and that header.

    Raises:
        UnreadableRun: the file cannot be read, or its first line is another.
    """
    rows = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        header = next(rows, [])
        if header not in headers:
            raise UnreadableRun(f"{path.name}: the header is not {','.join(headers[0])}")
        return [(rows.line_num, row) for row in rows], header
    except csv.Error as error:
        raise UnreadableRun(f"{path.name} line {rows.line_num}: {error}") from error


def _workload(path: Path, nodes: int, services: dict[str, Service], horizon: int) -> list[Request]:
    requests: list[Request] = []
    rows, header = read_csv(path, *WORKLOAD_HEADERS)
    for line, row in rows:
        where = f"workload.csv line {line}"
        try:
            slot, service, ingress, egress, lifetime, *_ = row
            first, last = (FREE if end == ANY else int(end) for end in (ingress, egress))
            more = dict(zip(header[5:], row[5:], strict=True))
            time = float(more["time"]) if "time" in more else None
            request = Request(int(slot), service, first, last, float(lifetime), more.get("demand", ""), time)
        except (ValueError, TypeError) as error:
            raise UnreadableRun(f"{where}: {error}") from error
        earliest = requests[-1].slot if requests else 0
        if not earliest <= request.slot < horizon:
            raise UnreadableRun(f"{where}: slot {request.slot} is out of order or beyond the horizon {horizon}")
        if (
            time is not None
            and not max(request.slot, requests[-1].arrives if requests else 0) <= time < request.slot + 1
        ):
            raise UnreadableRun(f"{where}: the time {time} is not in slot {request.slot}, or out of order")
        if service not in services:
            raise UnreadableRun(f"{where}: unknown service {service!r}")
        if not (FREE <= request.ingress < nodes and FREE <= request.egress < nodes):
            raise UnreadableRun(f"{where}: ingress {ingress} and egress {egress} are not nodes of the network")
        if not 0 < request.lifetime < math.inf:
            raise UnreadableRun(f"{where}: the lifetime {lifetime} is not positive")
        requests.append(request)
    return requests


def _decisions(path: Path, problems: Problems) -> list[dict[str, Any] | None]:
    decisions: list[dict[str, Any] | None] = []
    with _open(path) as file:
        while line := file.readline(LONGEST_LINE):
            where = f"decisions.jsonl line {len(decisions) + 1}"
            if len(decisions) == MOST_REQUESTS or len(line) == LONGEST_LINE:
                raise UnreadableRun(f"{where}: more than {MOST_REQUESTS} lines, or one too long to be a decision")
            decision = None
            try:
                decision = _parse_object(line)
                if not line.endswith(b"\n"):
                    problems.add(f"{where}: the line is not ended, the file may have been cut")
            except ValueError as error:
                problems.add(f"{where}: {error}")
            decisions.append(decision)
    return decisions


def _parse_object(data: bytes) -> dict[str, Any]:
    """The JSON object in ``data``; a ValueError says why there is none."""
    try:
        document = _DECODER.decode(data.decode("utf-8"))
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None
    if not isinstance(document, dict):
        raise ValueError("not a JSON object")
    return document


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("a key is there twice")
    return result


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is too large a number")
    return value


def _integer(text: str) -> int:
    value = int(text) if len(text) < 50 else LARGEST_INTEGER
    if abs(value) >= LARGEST_INTEGER:
        raise ValueError(f"{text[:20]}... is too large an integer")
    return value


_DECODER = json.JSONDecoder(
    parse_constant=_refuse_constant, object_pairs_hook=_object, parse_float=_finite, parse_int=_integer
)


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        UnreadableRun: there is none.
    """
    with _open(path) as file:
        try:
            return _parse_object(file.read())
        except ValueError as error:
            raise UnreadableRun(f"{path.name}: {error}") from error


def read_text(path: Path) -> str:
    """The text of a file whose last line is ended.

    Raises:
        UnreadableRun: it is no such text.
    """
    with _open(path) as file:
        try:
            text = file.read().decode("utf-8")
        except UnicodeDecodeError as error:
            raise UnreadableRun(f"{path.name}: {error}") from error
    if text and not text.endswith("\n"):
        raise UnreadableRun(f"{path.name}: the last line is not ended, the file may have been cut")
    return text


def _open(path: Path) -> BinaryIO:
    """A file for reading; links, devices and pipes are none that an evaluation writes, and may never end."""
    try:
        about = path.lstat()
        if not stat.S_ISREG(about.st_mode):
            raise UnreadableRun(f"{path.name}: is a link, a folder or a device, not a file")
        if about.st_size > LARGEST_FILE:
            raise UnreadableRun(f"{path.name}: {about.st_size / 1e9:.1f} GB, more than any run has")
        return path.open("rb")
    except OSError as error:
        raise UnreadableRun(f"{path.name}: {error.strerror}") from error
