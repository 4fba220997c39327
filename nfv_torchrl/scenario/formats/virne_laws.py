"""The laws from which Virne draws its requests: its ``v_sim_setting.yaml``, and chains drawn from such laws."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_text
from nfv_torchrl.scenario.formats.requests import Asked
from nfv_torchrl.scenario.quoting import one_line, shown

MOST_REQUESTS, MOST_FUNCTIONS, MOST_AMOUNT = 10**6, 1000, 10**9


def _cpu() -> dict[str, tuple[int, int]]:
    return {"cpu": (0, 20)}


@dataclass(frozen=True)
class ChainLaws:
    """Chains as Virne's published ones are drawn: whole amounts, each uniform between two ends that are included.

    Attributes:
        requests: how many.
        functions: of a chain.
        amounts: of each kind of resource that a function takes.
        bandwidth: Mbit/s of each link between two functions.
        arrival_rate: requests a second. Gaps between arrivals are Poisson numbers of whole seconds with mean
            1 / ``arrival_rate``.
        mean_lifetime: s, exponential.

    Raises:
        ScenarioError: a value is out of range.
    """

    requests: int = 1000
    functions: tuple[int, int] = (2, 10)
    amounts: dict[str, tuple[int, int]] = field(default_factory=_cpu)
    bandwidth: tuple[int, int] = (0, 50)
    arrival_rate: float = 0.14
    mean_lifetime: float = 500.0

    def __post_init__(self) -> None:
        if not 1 <= self.requests <= MOST_REQUESTS:
            raise ScenarioError(f"requests: {shown(self.requests)}; use an integer from 1 to {MOST_REQUESTS:,}")
        for what, interval, least, most in (
            ("functions", self.functions, 1, MOST_FUNCTIONS),
            ("bandwidth", self.bandwidth, 0, MOST_AMOUNT),
            *((f"amounts of {kind}", interval, 0, MOST_AMOUNT) for kind, interval in self.amounts.items()),
        ):
            low, high = interval
            if not (isinstance(low, int) and isinstance(high, int) and least <= low <= high <= most):
                raise ScenarioError(f"{what}: {shown(interval)}; use two integers in order, from {least} to {most:,}")
        if not self.amounts:
            raise ScenarioError("amounts: there are none; name at least one kind of resource")
        for name in ("arrival_rate", "mean_lifetime"):
            if not 1e-9 <= getattr(self, name) <= 1e9:
                raise ScenarioError(f"{name}: {shown(getattr(self, name))}; use a number from 1e-9 to 1e9")


def draw_asked(laws: ChainLaws, rng: np.random.Generator, source: str) -> list[Asked]:
    """Requests of ``laws`` in order of arrival; ``source`` names them in messages."""
    count = laws.requests
    times = np.cumsum(rng.poisson(1 / laws.arrival_rate, size=count)).astype(float).tolist()
    lifetimes = np.maximum(rng.exponential(laws.mean_lifetime, size=count), np.finfo(float).tiny).tolist()
    lengths = rng.integers(*laws.functions, size=count, endpoint=True).tolist()
    drawn = []
    for row, length in enumerate(lengths):
        amounts = {
            kind: tuple(rng.integers(*interval, size=length, endpoint=True).astype(float).tolist())
            for kind, interval in laws.amounts.items()
        }
        rates = rng.integers(*laws.bandwidth, size=length - 1, endpoint=True).astype(float).tolist()
        name = f"{source}: request {row}"
        drawn.append(Asked(name, times[row], lifetimes[row], amounts, (0.0, *rates, 0.0), None, (0.0,) * length))
    return drawn


def read_laws(path: Path) -> ChainLaws:
    """The laws of a file in the form of Virne's ``v_sim_setting.yaml``, whose topology is ``path``.

    Raises:
        ScenarioError: it cannot be read, or draws something else than such chains; the message names the key.
    """
    try:
        data = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{path}: is not valid YAML ({one_line(str(error))}); repair it") from error
    if not isinstance(data, Mapping):
        raise ScenarioError(f"{path}: holds a {type(data).__name__}; the keys of Virne's v_sim_setting.yaml are needed")
    file = _Settings(data, str(path))
    topology = file.mapping("topology").get("type")
    if topology != "path":
        raise ScenarioError(f"{path}: topology.type is {shown(topology)}; only chains are drawn, whose type is 'path'")
    links = file.resources("link_attrs_setting")
    if list(links) != ["bw"]:
        raise ScenarioError(f"{path}: link_attrs_setting has {shown(list(links))}; only 'bw' is drawn")
    rate = file.law("arrival_rate", "poisson", "lam")
    try:
        return ChainLaws(
            requests=int(file.number(data, "num_v_nets")),
            functions=file.interval(file.mapping("v_net_size"), "v_net_size"),
            amounts=file.resources("node_attrs_setting"),
            bandwidth=links["bw"],
            arrival_rate=rate if file.mapping("arrival_rate").get("reciprocal") else 1 / rate,
            mean_lifetime=file.law("lifetime", "exponential", "scale"),
        )
    except ScenarioError as error:
        raise ScenarioError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


class _Settings:
    """Values of a settings file, refused by name."""

    def __init__(self, data: Mapping[str, Any], source: str) -> None:
        self.data, self.source = data, source

    def mapping(self, key: str) -> Mapping[str, Any]:
        value = self.data.get(key)
        if not isinstance(value, Mapping):
            raise ScenarioError(f"{self.source}: {key} is {shown(value)}; a mapping was expected")
        return value

    def number(self, data: Mapping[str, Any], key: str) -> float:
        value = data.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise ScenarioError(f"{self.source}: {key} is {shown(value)}; a positive number was expected")
        return value

    def law(self, key: str, distribution: str, parameter: str) -> float:
        """``parameter`` of the law under ``key``, which is ``distribution``."""
        data = self.mapping(key)
        if data.get("distribution") != distribution:
            raise ScenarioError(
                f"{self.source}: {key} is {shown(data.get('distribution'))}; only {distribution} is drawn"
            )
        return self.number(data, parameter)

    def interval(self, data: Mapping[str, Any], where: str) -> tuple[int, int]:
        """``low`` and ``high`` of a uniform law of integers."""
        if (data.get("distribution"), data.get("dtype")) != ("uniform", "int"):
            raise ScenarioError(f"{self.source}: {where} is {shown(dict(data))}; only uniform integers are drawn")
        low, high = (data.get(end) for end in ("low", "high"))
        if any(isinstance(end, bool) or not isinstance(end, int) for end in (low, high)):
            raise ScenarioError(f"{self.source}: {where} has low {shown(low)}, high {shown(high)}; integers are needed")
        return low, high  # type: ignore[return-value]

    def resources(self, key: str) -> dict[str, tuple[int, int]]:
        """The interval of each resource of a list of attributes."""
        entries = self.data.get(key)
        if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
            raise ScenarioError(f"{self.source}: {key} is {shown(entries)}; a list of attributes was expected")
        return {
            str(entry.get("name")): self.interval(entry, key) for entry in entries if entry.get("type") == "resource"
        }
