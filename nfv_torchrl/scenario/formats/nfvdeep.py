"""``requests.json`` of CN-UPB/NFVdeep (github.com/CN-UPB/NFVdeep): requests, or the laws from which it draws them.

A list holds requests. An object holds the intervals of its ``poisson_arrival_uniform_load``. Amounts have no units: cpu
and memory count in those of the network, bandwidths are read as Mbit/s, delays as ms, times as s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
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


def read_nfvdeep(path: Path, generator: Callable[[], np.random.Generator]) -> RequestSet:
    """The requests of a list, or requests drawn as an object says.

    A request is there in the slots from its arrival to ``arrival_time + ttl``, both included, so that its lifetime is
    ``ttl + 1``.

    Args:
        path: the file.
        generator: gives what requests are drawn with, where the file holds intervals.

    Raises:
        ScenarioError: it cannot be read, or holds something else; the message names the request.
    """
    data = load_json(path)
    if isinstance(data, Mapping):
        return RequestSet(str(path), _draw(_Laws(data, str(path)), generator(), str(path)))
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

    def integers(self, name: str, rng: np.random.Generator, size: int) -> np.ndarray:
        """Uniform in low .. high, both included, int64 [size]."""
        low, high = self.intervals[name]
        return rng.integers(int(low), int(high), size=size, endpoint=True)

    def numbers(self, name: str, rng: np.random.Generator, size: int) -> np.ndarray:
        """Uniform between low and high, float64 [size]."""
        return rng.uniform(*self.intervals[name], size=size)


def _draw(laws: _Laws, rng: np.random.Generator, source: str) -> list[Asked]:
    """Requests as CN-UPB/NFVdeep draws them: arrivals are rounded up to whole slots, lifetimes down."""
    count = int(laws.integers("num_requests", rng, 1)[0])
    slots, stay = (int(laws.integers(name, rng, 1)[0]) for name in ("num_timeslots", "service_rate"))
    times = np.ceil(np.cumsum(rng.exponential(slots / count, size=count)))
    lifetimes = np.floor(rng.exponential(stay, size=count)) + 1.0
    kinds = {
        "cpu": laws.integers("cpus", rng, laws.num_vnfs).astype(float),
        "memory": laws.numbers("memory", rng, laws.num_vnfs),
    }
    delays = laws.numbers("vnf_delays", rng, laws.num_vnfs)
    lengths = laws.integers("sfc_length", rng, count)
    latencies = laws.numbers("max_response_latency", rng, count)
    rates = laws.numbers("bandwidth", rng, count).tolist()
    return [
        _drawn(
            f"{source}: request {row}", (times[row], lifetimes[row], latencies[row]), rates[row], chosen, kinds, delays
        )
        for row, chosen in enumerate(rng.integers(laws.num_vnfs, size=int(length)) for length in lengths)
    ]


def _drawn(
    name: str,
    when: tuple[float, float, float],
    rate: float,
    chosen: np.ndarray,
    kinds: Mapping[str, np.ndarray],
    delays: Sequence[float] | np.ndarray,
) -> Asked:
    """A request of the VNFs ``chosen``; ``when``: arrival (s), lifetime (s), tolerable delay (ms)."""
    time, lifetime, tolerable = (float(value) for value in when)
    amounts = {kind: tuple(amount[chosen].tolist()) for kind, amount in kinds.items()}
    rates = (0.0, *[rate] * (len(chosen) - 1), 0.0)
    return Asked(name, time, lifetime, amounts, rates, tolerable, tuple(np.asarray(delays)[chosen].tolist()))
