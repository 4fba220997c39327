"""Traffic that files ask for between pairs of nodes, with the names and the unit that the file gives."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import write_atomically
from nfv_torchrl.scenario.quoting import shown

MBIT_PER = {"bit/s": 1e-6, "kbit/s": 1e-3, "Mbit/s": 1.0, "Gbit/s": 1e3, "Tbit/s": 1e6}
"""Mbit/s in one of each unit that is understood."""


@dataclass(frozen=True, eq=False)
class DemandMatrix:
    """How much traffic goes from which node to which, as one file says.

    Attributes:
        source: the file, for messages.
        names: the file's ids of its nodes; those of a network of the same source are its ``Substrate.ids``.
        pairs: places in ``names`` of the source and the target of each demand, int64 [D, 2].
        values: how much, float64 [D], at least 0, in ``unit``.
        unit: one of ``MBIT_PER``, what else the file says, or empty if it says nothing: then only shares mean anything.
        time: when, as the file writes it, or empty.

    Raises:
        ScenarioError: shapes that do not fit, a demand that is negative or not finite.
    """

    source: str
    names: tuple[str, ...]
    pairs: np.ndarray
    values: np.ndarray
    unit: str = ""
    time: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", np.array(self.pairs, np.int64).reshape(-1, 2))
        object.__setattr__(self, "values", np.array(self.values, np.float64))
        if len(self.pairs) != len(self.values):
            raise ScenarioError(f"{self.source}: {len(self.pairs)} pairs but {len(self.values)} demands")
        for demand in np.flatnonzero(~((self.values >= 0) & np.isfinite(self.values)))[:1]:
            u, v = (self.names[node] for node in self.pairs[demand])
            raise ScenarioError(
                f"{self.source}: the demand from {shown(u)} to {shown(v)} is {self.values[demand]}; use a number of at "
                "least 0"
            )
        self.pairs.flags.writeable = self.values.flags.writeable = False

    def __len__(self) -> int:
        """Number of demands."""
        return len(self.values)

    def matrix(self) -> np.ndarray:
        """Float64 [N, N], from row to column, in ``unit``; demands of one pair add up."""
        table = np.zeros((len(self.names), len(self.names)))
        np.add.at(table, (self.pairs[:, 0], self.pairs[:, 1]), self.values)
        return table

    def in_mbit(self) -> np.ndarray:
        """``values`` in Mbit/s, float64 [D].

        Raises:
            ScenarioError: the file names no unit, or one that is not known.
        """
        if self.unit not in MBIT_PER:
            raise ScenarioError(
                f"{self.source}: its demands have {f'the unit {shown(self.unit)}' if self.unit else 'no unit'}; Mbit/s "
                "can be had of " + ", ".join(MBIT_PER)
            )
        return self.values * MBIT_PER[self.unit]


def write_demands(path: str | os.PathLike[str], series: Iterable[DemandMatrix]) -> None:
    """Write columns ``source``, ``target``, ``demand``, ``unit``, ``time``, one line a demand, with all digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["source", "target", "demand", "unit", "time"])
    for matrix in series:
        for (u, v), value in zip(matrix.pairs.tolist(), matrix.values.tolist(), strict=True):
            writer.writerow([matrix.names[u], matrix.names[v], value, matrix.unit, matrix.time])
    write_atomically(path, text.getvalue())


def demand_matrix(
    source: str, names: Iterable[str], rows: Iterable[tuple[str, str, float]], unit: str = "", time: str = ""
) -> DemandMatrix:
    """A matrix of ``rows`` (source, target, demand) that name nodes as ``names`` does.

    Raises:
        ScenarioError: a row names a node that is not there; see ``DemandMatrix`` for others.
    """
    known = tuple(names)
    index = {name: place for place, name in enumerate(known)}
    listed = list(rows)
    for end in (end for row in listed for end in row[:2]):
        if end not in index:
            raise ScenarioError(f"{source}: a demand names node {shown(end)}, which is not among the nodes; correct it")
    pairs = [(index[u], index[v]) for u, v, _ in listed]
    return DemandMatrix(source, known, np.array(pairs, np.int64), np.array([x for *_, x in listed]), unit, time)
