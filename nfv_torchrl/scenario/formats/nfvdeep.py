"""``requests.json`` of CN-UPB/NFVdeep (github.com/CN-UPB/NFVdeep): requests, or the laws from which it draws them.

A list holds requests. An object holds the intervals of its ``poisson_arrival_uniform_load``. Amounts have no units: cpu
and memory count in those of the network, bandwidths are read as Mbit/s, delays as ms, times as s.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import load_json
from nfv_torchrl.scenario.formats.requests import Asked, RequestSet
from nfv_torchrl.scenario.quoting import shown

KINDS = {"cpu": "cpu_demand", "memory": "memory_demand"}
"""Kinds of resources, and what a list of requests calls them."""
LAWS = "poisson_arrival_uniform_load"
NEEDED = ("arrival_time", "ttl", "bandwidth_demand", "max_response_latency", "vnfs")
INTERVALS = (
    "num_timeslots", "num_requests", "service_rate", "sfc_length", "bandwidth", "max_response_latency", "cpus",
    "memory", "vnf_delays",
)  # fmt: skip
MOST_REQUESTS = 10**6


def read_nfvdeep(path: Path, seed: int) -> RequestSet:
    """The requests of a list, or those that CN-UPB/NFVdeep draws with ``seed`` as an object says (``static: true``).

    A request is there in the slots from its arrival to ``arrival_time + ttl``, both included, so that its lifetime is
    ``ttl + 1``.

    Args:
        path: the file.
        seed: what requests are drawn with, where the file holds intervals.

    Raises:
        ScenarioError: it cannot be read, or holds something else; the message names the request.
    """
    data = load_json(path)
    if isinstance(data, Mapping):
        return RequestSet(str(path), _draw(_Laws(data, str(path)), random.Random(seed), str(path)))
    if not isinstance(data, list) or not data:
        raise ScenarioError(f"{path}: holds {shown(data)}; a list of requests or the object of {LAWS!r} was expected")
    unused: set[str] = set()
    requests = [_request(entry, f"{path}: request {place}", unused) for place, entry in enumerate(data)]
    return RequestSet(str(path), sorted(requests, key=lambda asked: asked.time), tuple(sorted(unused)))


# -------------------------------------------------------------------- a list of requests


def _request(entry: Any, where: str, unused: set[str]) -> Asked:
    if not isinstance(entry, Mapping) or not {*NEEDED} <= entry.keys():
        raise ScenarioError(f"{where}: is {shown(entry)}; an object with {', '.join(NEEDED)} was expected")
    unused |= {str(key) for key in entry.keys() - {*NEEDED, "processing_delays"}}
    vnfs = entry["vnfs"]
    if not isinstance(vnfs, list) or not vnfs or not all(isinstance(vnf, Mapping) for vnf in vnfs):
        raise ScenarioError(f"{where}: vnfs is {shown(vnfs)}; a list of {{{', '.join(KINDS.values())}}} was expected")
    unused |= {f"{key} (vnfs)" for vnf in vnfs for key in vnf.keys() - {*KINDS.values()}}
    amounts = {
        kind: tuple(_number(vnf.get(name), f"{where}: {name}") for vnf in vnfs)
        for kind, name in KINDS.items()
        if any(name in vnf for vnf in vnfs)
    }
    delays = entry.get("processing_delays") or [0.0] * len(vnfs)
    if not isinstance(delays, list) or len(delays) != len(vnfs):
        raise ScenarioError(f"{where}: processing_delays is {shown(delays)}; one number for each VNF was expected")
    rate = _number(entry["bandwidth_demand"], f"{where}: bandwidth_demand")
    return Asked(
        where,
        _number(entry["arrival_time"], f"{where}: arrival_time"),
        _number(entry["ttl"], f"{where}: ttl") + 1.0,
        amounts,
        (0.0, *[rate] * (len(vnfs) - 1), 0.0),
        _number(entry["max_response_latency"], f"{where}: max_response_latency"),
        tuple(_number(delay, f"{where}: processing_delays") for delay in delays),
    )


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise ScenarioError(f"{where}: is {shown(value)}; a finite number of at least 0 was expected")
    return float(value)


# -------------------------------------------------------------------- laws to draw from


class _Laws:
    """The intervals of an object; ``[low, high]`` by name."""

    def __init__(self, data: Mapping[str, Any], source: str) -> None:
        known = {"type", "static", "num_vnfs", *INTERVALS}
        if data.get("type") != LAWS or data.keys() - known or known - data.keys() - {"static"}:
            raise ScenarioError(
                f"{source}: is no list of requests, nor the object of type {LAWS!r} with {', '.join(sorted(known))}"
            )
        self.source = source
        self.num_vnfs = self._count(data["num_vnfs"], "num_vnfs")
        self.intervals = {name: self._interval(data[name], name) for name in INTERVALS}
        for name in ("num_timeslots", "num_requests", "service_rate", "sfc_length"):
            low, _ = self.intervals[name]
            if low < 1 or any(end != int(end) for end in self.intervals[name]):
                raise ScenarioError(f"{source}: {name} is {shown(data[name])}; integers from 1 on were expected")
        if self.intervals["num_requests"][1] > MOST_REQUESTS:
            raise ScenarioError(f"{source}: num_requests is more than {MOST_REQUESTS:,}; use less")

    def _interval(self, value: Any, name: str) -> tuple[float, float]:
        pair = value if isinstance(value, list) and len(value) == 2 else [None, None]
        low, high = (_number(end, f"{self.source}: {name}") for end in pair)
        if low > high:
            raise ScenarioError(f"{self.source}: {name} is {shown(value)}; [low, high] was expected")
        return low, high

    def _count(self, value: Any, name: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 10**4:
            raise ScenarioError(f"{self.source}: {name} is {shown(value)}; an integer from 1 to 10,000 was expected")
        return value

    def integer(self, name: str, rng: random.Random) -> int:
        """Uniform in low .. high, both included."""
        low, high = self.intervals[name]
        return rng.randint(int(low), int(high))

    def number(self, name: str, rng: random.Random) -> float:
        """Uniform between low and high."""
        return rng.uniform(*self.intervals[name])


def drawn_stay(path: Path, seed: int) -> int:
    """Mean of the exponential law of the lifetimes that are drawn with ``seed`` as an object says, slots.

    Raises:
        ScenarioError: the file holds something else.
    """
    return _first_draws(_Laws(load_json(path), str(path)), random.Random(seed))[2]


def _first_draws(laws: _Laws, rng: random.Random) -> tuple[int, int, int]:
    """Number of requests, slots that they come in, mean stay."""
    return tuple(laws.integer(name, rng) for name in ("num_requests", "num_timeslots", "service_rate"))  # type: ignore[return-value]


def _draw(laws: _Laws, rng: random.Random, source: str) -> list[Asked]:
    """The requests that CN-UPB/NFVdeep draws: the same numbers from the same generator, in its order.

    Arrivals are rounded up to whole slots, lifetimes down.
    """
    count, slots, stay = _first_draws(laws, rng)
    times = np.ceil(np.cumsum([rng.expovariate(count / slots) for _ in range(count)])).tolist()
    lifetimes = [math.floor(rng.expovariate(1 / stay)) + 1.0 for _ in range(count)]
    vnfs = [(float(laws.integer("cpus", rng)), laws.number("memory", rng)) for _ in range(laws.num_vnfs)]
    delays = [laws.number("vnf_delays", rng) for _ in range(laws.num_vnfs)]
    requests = []
    for row in range(count):
        chosen = [rng.randint(0, laws.num_vnfs - 1) for _ in range(laws.integer("sfc_length", rng))]
        tolerable, rate = laws.number("max_response_latency", rng), laws.number("bandwidth", rng)
        amounts = {kind: tuple(vnfs[vnf][place] for vnf in chosen) for place, kind in enumerate(KINDS)}
        rates = (0.0, *[rate] * (len(chosen) - 1), 0.0)
        own = tuple(delays[vnf] for vnf in chosen)
        requests.append(Asked(f"{source}: request {row}", times[row], lifetimes[row], amounts, rates, tolerable, own))
    return requests
