"""Results as rows for a CSV file, one for each number, and the same rows as a printed table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nfv_torchrl.evaluation.statistics import Interval
from nfv_torchrl.evaluation.tables import UNDEFINED, Table
from nfv_torchrl.vocabulary import INTERVAL_COLUMNS, TABLE

Row = Mapping[str, Any]


def result_row(
    about: Mapping[str, Any], method: str, metric: str, interval: Interval, reference: str = "", part: str = ""
) -> dict[str, Any]:
    """One number: the columns ``about``, then those that name it and its interval.

    Args:
        about: what the row is on, such as a network.
        method: whose number it is; of a bound, its name.
        metric: a name of the table of all quantities.
        interval: the number.
        reference: what the method is compared with.
        part: in place of the name's word in capitals, such as the service of ``aar/SERVICE``.
    """
    numbers = (interval.mean, interval.low, interval.high, interval.n)
    named = dict(zip(INTERVAL_COLUMNS, numbers, strict=True))
    return {**about, "method": method, "metric": TABLE[metric].key(part), **named, "reference": reference}


@dataclass(frozen=True)
class Column:
    """A column of a printed table: the numbers of one metric.

    Attributes:
        metric: its name.
        form: how a number is shown, such as ``+.3f``.
        method: whose numbers; None: of the method that the line is of.
        reference: what they are compared with.
        title: what is above it; empty: `AAR greedy`, `AAR difference to dqn`, ...
    """

    metric: str
    form: str
    method: str | None = None
    reference: str = ""
    title: str = ""

    @property
    def head(self) -> str:
        """What is above it."""
        if self.title:
            return self.title
        words = [TABLE[self.metric].head or self.metric]
        if self.reference:
            words += ["to", self.reference]
        elif self.method is not None:
            words.append(self.method)
        return " ".join(words)

    def shows(self, row: Row) -> bool:
        """Whether the number of a row belongs here."""
        same_method = self.method in (None, row["method"])
        return same_method and (row["metric"], row["reference"]) == (self.metric, self.reference)

    def cell(self, row: Row | None) -> str:
        """Mean ± half width of the interval, if there is one."""
        if row is None or math.isnan(row["mean"]):
            return UNDEFINED
        half = max(row["mean"] - row["ci_low"], row["ci_high"] - row["mean"])
        ends = "" if math.isnan(half) else f" ± {half:{self.form.removeprefix('+')}}"
        return f"{row['mean']:{self.form}}{ends}"


def pivot(title: str, rows: Sequence[Row], by: Mapping[str, str], columns: Sequence[Column]) -> Table:
    """One line for each value of the first column of ``by``, with a cell for each of ``columns``.

    Args:
        title: of the table.
        rows: of :func:`result_row`.
        by: columns of the rows that begin a line, and how a value is shown (a format such as ``.2f``).
        columns: the numbers beside them; a cell without a row is undefined.
    """
    first = next(iter(by))
    lines = []
    for value in dict.fromkeys(row[first] for row in rows):
        mine = [row for row in rows if row[first] == value]
        cells = [column.cell(next(filter(column.shows, mine), None)) for column in columns]
        lines.append((*(f"{mine[0][name]:{form}}" for name, form in by.items()), *cells))
    return Table(title, (*by, *(column.head for column in columns)), tuple(lines))
