"""Arrival processes: how many requests come in each slot, and by traffic matrices also between which nodes.

All have the mean ``arrival_rate``: ``uniform`` and ``poisson`` in every slot, ``modulated`` in the long run,
``profile`` over a period, ``matrix`` over the series.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import parse_dataclass, refuse, shown

if TYPE_CHECKING:
    from nfv_torchrl.scenario.scenario import Scenario

KEYS: dict[str, tuple[str, ...]] = {
    "uniform": (),
    "poisson": (),
    "modulated": ("busy", "mean_busy", "mean_calm"),
    "profile": ("rates", "period", "start"),
    "matrix": ("path", "interval"),
    "file": (),
}
"""The processes, and what each of them needs or may have."""
OPTIONAL = ("period", "start", "interval")
DAY = 86400.0
"""s."""


@dataclass(frozen=True)
class ArrivalProcess:
    """Who comes when. Durations are in s, as slots are.

    Attributes:
        process: ``uniform``: a number uniform in 0 .. 2 ``arrival_rate`` in each slot (the paper's); ``poisson``: a
            Poisson number; ``modulated``: a Poisson number at one of two rates, between which a Markov chain switches;
            ``profile``: a Poisson number at a rate that follows the time of day; ``matrix``: a Poisson number at a rate
            that follows the total of traffic matrices, between ends drawn in proportion to their demands; ``file``: as
            ``workload.path`` says.
        busy: of ``modulated``: the rate while busy over that while calm, at least 1.
        mean_busy, mean_calm: of ``modulated``: how long each state lasts on average, at least 1.
        rates: of ``profile``: relative rates that divide the period into equal parts.
        period: of ``profile``; null: a day.
        start: of ``profile``: time in the period when slot 0 begins; null: 0.
        path: of ``matrix``: file or folder of demands (``docs/data.md``).
        interval: of ``matrix``: how long each matrix holds; null: as the files' times say, a single one always.

    Raises:
        ScenarioError: an unknown process, a value that it has no use for, lacks or that is out of range.
    """

    process: str = "uniform"
    busy: float | None = None
    mean_busy: float | None = None
    mean_calm: float | None = None
    rates: tuple[float, ...] | None = None
    period: float | None = None
    start: float | None = None
    path: str | None = None
    interval: float | None = None

    def __post_init__(self) -> None:
        if self.process not in KEYS:
            raise ScenarioError(f"arrivals: {shown(self.process)} is unknown; use one of {', '.join(KEYS)}")
        mine = KEYS[self.process]
        for key in (spec.name for spec in fields(self) if spec.name != "process"):
            value = getattr(self, key)
            if key not in mine and value is not None:
                raise ScenarioError(f"arrivals.{key}: {self.process} has no use for it; remove it")
            if key in mine and value is None and key not in OPTIONAL:
                raise ScenarioError(f"arrivals.{key}: is missing; {self.process} needs {', '.join(mine)}")
        for key, least in (("busy", 1.0), ("mean_busy", 1.0), ("mean_calm", 1.0), ("period", 1.0), ("interval", 1e-3)):
            value = getattr(self, key)
            if value is not None and not least <= value <= 1e9:
                raise ScenarioError(f"arrivals.{key}: {shown(value)}; use a number from {least:g} to 1e9")
        if self.start is not None and not 0 <= self.start <= 1e9:
            raise ScenarioError(f"arrivals.start: {shown(self.start)} s; use 0 or a positive number up to 1e9")
        if self.rates is not None and not (
            self.rates and all(0 <= rate <= 1e9 for rate in self.rates) and sum(self.rates) > 0
        ):
            raise ScenarioError(f"arrivals.rates: {shown(self.rates)}; list numbers of at least 0, not all of them 0")

    def to_config(self) -> str | dict[str, Any]:
        """As a scenario's file has it: the name of the process, or a mapping with what else was set."""
        rest = {spec.name: getattr(self, spec.name) for spec in fields(self)[1:]}
        rest = {key: list(value) if isinstance(value, tuple) else value for key, value in rest.items()}
        rest = {key: value for key, value in rest.items() if value is not None}
        return {"process": self.process, **rest} if rest else self.process


UNIFORM, FILE = ArrivalProcess(), ArrivalProcess("file")


def parse_arrivals(config: Any, where: str) -> ArrivalProcess:
    """The process of a name, or of a mapping with ``process`` and what it needs; null: ``uniform``.

    Raises:
        ScenarioError: it is neither, or see ``ArrivalProcess``.
    """
    if config is None or isinstance(config, ArrivalProcess):
        return config or UNIFORM
    if isinstance(config, str):
        return ArrivalProcess(config)
    if not isinstance(config, Mapping):
        refuse(where, config, f"one of {', '.join(KEYS)}, or a mapping with process")
    return parse_dataclass(ArrivalProcess, config, where)


def draw_counts(scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Arrivals in each slot, int64 [T]. A longer horizon continues the same arrivals."""
    law, rate, horizon = scenario.arrivals, scenario.arrival_rate, scenario.horizon
    if law.process == "uniform":
        return rng.integers(0, round(2 * rate), size=horizon, endpoint=True)
    if law.process == "poisson":
        return rng.poisson(rate, size=horizon)
    if law.process == "modulated":
        states, counts = (np.random.default_rng(int(seed)) for seed in rng.integers(2**63, size=2))
        calm = rate / (1 + (float(law.busy or 1) - 1) * busy_share(law))
        return counts.poisson(np.where(_busy(law, horizon, states), calm * float(law.busy or 1), calm))
    if law.process == "profile":
        return rng.poisson(rate * relative_rates(law, horizon))
    return rng.poisson(rate * scenario.traffic.relative_totals(horizon))


def busy_share(law: ArrivalProcess) -> float:
    """Share of the slots that a modulated process is busy, in the long run."""
    return float(law.mean_busy or 1) / (float(law.mean_busy or 1) + float(law.mean_calm or 1))


def _busy(law: ArrivalProcess, horizon: int, rng: np.random.Generator) -> np.ndarray:
    """Whether each slot is busy, bool [T]: from slot to slot a state ends with probability 1 / its mean duration."""
    draw = rng.random(horizon)
    leave_busy, leave_calm = 1 / float(law.mean_busy or 1), 1 / float(law.mean_calm or 1)
    state = np.zeros(horizon, np.bool_)
    now = bool(draw[0] < busy_share(law))
    for slot, chance in enumerate(draw.tolist()):
        if slot > 0 and chance < (leave_busy if now else leave_calm):
            now = not now
        state[slot] = now
    return state


def relative_rates(law: ArrivalProcess, horizon: int) -> np.ndarray:
    """Mean rate of a profile in each slot over that of the period, float64 [T]."""
    rates = np.array(law.rates, np.float64)
    rates /= rates.mean()
    period, start = float(law.period or DAY), float(law.start or 0.0)
    edges = start + np.arange(horizon + 1, dtype=np.float64)
    part = np.r_[0.0, np.cumsum(rates)] * (period / len(rates))  # arrivals up to each edge of a part, at rate 1
    turns, within = np.divmod(edges, period)
    so_far = turns * period + np.interp(within, np.linspace(0.0, period, len(part)), part)
    return np.maximum(np.diff(so_far), 0.0)  # where the rate is 0, rounding makes it a little less


def check_rate(law: ArrivalProcess, rate: float, most: float) -> None:
    """Refuse an ``arrival_rate`` that ``law`` cannot have.

    Raises:
        ScenarioError: as said.
    """
    if law.process != "uniform":
        if not (math.isfinite(rate) and 1e-9 <= rate <= most):
            raise ScenarioError(f"arrival_rate: {shown(rate)}; use a positive number, from 1e-9 to {most:g}")
    elif not (0.5 <= rate <= most and 2 * rate == int(2 * rate)):
        raise ScenarioError(
            f"arrival_rate: {shown(rate)}; arrivals are uniform in 0 .. 2 * arrival_rate, so use a positive multiple "
            f"of 0.5, at most {most}, or arrivals=poisson, which takes any rate"
        )
