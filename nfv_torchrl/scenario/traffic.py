"""Traffic matrices over time as a law of arrivals: how many requests, and between which nodes."""

from __future__ import annotations

import datetime
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.scenario.demand_files import read_demand_series, read_demands
from nfv_torchrl.scenario.formats.demands import DemandMatrix
from nfv_torchrl.scenario.quoting import shown
from nfv_torchrl.scenario.substrate import Substrate


class Traffic:
    """A series of M demand matrices on a network; after its end it begins anew.

    Args:
        series: the matrices, in order of time, with the same nodes.
        substrate: has a node for each that sends or receives anything, by id or label.
        interval: s that each matrix holds; None: as the matrices' times say, of which the last holds as long as the
            one before it, and a single one always.

    Raises:
        ScenarioError: no traffic at all, an unknown node, or times that say nothing and no interval.
    """

    def __init__(self, series: Sequence[DemandMatrix], substrate: Substrate, interval: float | None) -> None:
        self.source = series[0].source
        self._edges = _edges(series, interval)  # float64 [M + 1], s: when each matrix begins, and the end
        nodes = _nodes(series, substrate)
        self._pairs = [nodes[matrix.pairs] for matrix in series]
        kept = [pairs[:, 0] != pairs[:, 1] for pairs in self._pairs]
        if any(matrix.values[~keep].any() for matrix, keep in zip(series, kept, strict=True)):
            warnings.warn(f"{self.source}: demands from a node to itself are not used", ScenarioWarning, stacklevel=2)
        values = [np.where(keep, matrix.values, 0.0) for matrix, keep in zip(series, kept, strict=True)]
        self._shares = [np.cumsum(here) / max(here.sum(), np.finfo(float).tiny) for here in values]
        totals = np.array([here.sum() for here in values])
        mean = float(totals @ np.diff(self._edges)) / self._edges[-1]
        if not mean > 0:
            raise ScenarioError(f"{self.source}: all demands are 0; give a file with traffic")
        self._relative = totals / mean

    def arrays(self) -> list[np.ndarray]:
        """All that arrivals follow from, for fingerprints."""
        return [self._edges, self._relative, *self._pairs, *self._shares]

    def relative_totals(self, horizon: int) -> np.ndarray:
        """Mean total in each slot over that of the whole series, float64 [T]."""
        before = np.r_[0.0, np.cumsum(self._relative * np.diff(self._edges))]
        turns, within = np.divmod(np.arange(horizon + 1, dtype=np.float64), self._edges[-1])
        return np.diff(turns * before[-1] + np.interp(within, self._edges, before))

    def draw_ends(self, slot: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Ingress and egress int64 [R] of requests that arrive in ``slot`` int64 [R], in proportion to demands.

        A slot takes the matrix that holds in its middle, or where that has no traffic the one after it.
        """
        ends = np.zeros((len(slot), 2), np.int64)
        draw = rng.random(len(slot))
        moment = (slot + 0.5) % self._edges[-1]
        matrix = self._with_traffic()[np.searchsorted(self._edges, moment, side="right") - 1]
        for place in np.unique(matrix).tolist():
            mine = matrix == place
            demand = np.searchsorted(self._shares[place], draw[mine], side="right")
            ends[mine] = self._pairs[place][np.minimum(demand, len(self._shares[place]) - 1)]
        return ends[:, 0], ends[:, 1]

    def _with_traffic(self) -> np.ndarray:
        """For each matrix, itself or the next that has traffic, int64 [M]."""
        busy = np.flatnonzero(self._relative > 0)
        return busy[np.searchsorted(busy, np.arange(len(self._relative))) % len(busy)]


def read_traffic(path: str | os.PathLike[str], substrate: Substrate, interval: float | None) -> Traffic:
    """The traffic of a file of demands, or of a folder that has one for each time (``docs/data.md``).

    Raises:
        ScenarioError: it cannot be used; the message names the file.
    """
    try:
        series = read_demand_series(path) if Path(path).is_dir() else [read_demands(path)]
    except ScenarioError as error:
        raise ScenarioError(f"arrivals.path: {str(error).removeprefix('substrate.path: ')}") from error
    return Traffic(series, substrate, interval)


def _edges(series: Sequence[DemandMatrix], interval: float | None) -> np.ndarray:
    """When each matrix begins, and when the last ends, float64 [M + 1], s from the first."""
    if interval is not None or len(series) == 1:
        return (interval or 1.0) * np.arange(len(series) + 1, dtype=np.float64)
    times = [_seconds(matrix) for matrix in series]
    begins = np.array(times) - times[0]
    if np.any(np.diff(begins) <= 0):
        raise ScenarioError(f"{series[0].source}: matrices have the same time; set arrivals.interval, or remove some")
    return np.r_[begins, 2 * begins[-1] - begins[-2]]


def _seconds(matrix: DemandMatrix) -> float:
    """The time that a file states as year, month, day, hour, minute (and second), s."""
    digits = re.sub(r"\D", "", matrix.time)
    try:
        form = {12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}[len(digits)]
        when = datetime.datetime.strptime(digits, form).replace(tzinfo=datetime.UTC)
    except (KeyError, ValueError):
        raise ScenarioError(
            f"{matrix.source}: its time is {shown(matrix.time)}, not one of year, month, day, hour and minute; set "
            "arrivals.interval to the s that each matrix holds"
        ) from None
    return when.timestamp()


def _nodes(series: Sequence[DemandMatrix], substrate: Substrate) -> np.ndarray:
    """Node of each name of the matrices, int64 [names]; -1 for one that nothing comes from or goes to."""
    first = series[0]
    used = np.zeros(len(first.names), np.bool_)
    for matrix in series:
        used[matrix.pairs[matrix.values > 0]] = True
    nodes = np.full(len(first.names), -1, np.int64)
    for place in np.flatnonzero(used).tolist():
        try:
            nodes[place] = substrate.node_index(first.names[place])
        except ScenarioError as error:
            raise ScenarioError(f"{first.source}: demands name a node that the network lacks: {error}") from error
    return nodes
