"""What every figure shares: the style, lines with their confidence intervals, and saving all or nothing."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib.figure import Figure

from nfv_torchrl.evaluation.looks import Look, looks
from nfv_torchrl.evaluation.statistics import Interval
from nfv_torchrl.files import write_atomically

STYLE: Any = {
    "figure.figsize": (6.4, 4.2),
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "font.size": 10,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
}
MOST_ERROR_BARS = 25
"""A series of more points than this shows its interval as a band."""

Row = Mapping[str, Any]
"""One row of a tidy table: ``series``, ``x``, ``mean``, ``ci_low``, ``ci_high`` and what else the CSV shall hold."""


def tidy_row(series: str, x: float, interval: Interval, **more: Any) -> dict[str, Any]:
    """One row of the tidy table that ``line_figure`` draws and ``save_figure`` writes."""
    return {
        "series": series,
        "x": x,
        "mean": interval.mean,
        "ci_low": interval.low,
        "ci_high": interval.high,
        "n": interval.n,
        **more,
    }


def line_figure(
    rows: Sequence[Row], *, x_label: str, y_label: str, title: str = "", dashed: Sequence[str] = ()
) -> Figure:
    """One line for each series of ``rows``, with its confidence interval where that is defined.

    Args:
        rows: tidy table (see ``Row``); series are drawn in order of appearance, with the looks of ``looks``.
        x_label: label of the horizontal axis, unit included.
        y_label: label of the vertical axis, unit included.
        title: what is shown, and on what scenario.
        dashed: series that are no method (a bound, a theory) and are drawn as dashed lines without markers.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(layout="constrained")
        axes = figure.add_subplot()
        for series, look in looks(str(row["series"]) for row in rows).items():
            points = [row for row in rows if row["series"] == series]
            draw_series(axes, points, series, look._replace(line="--") if series in dashed else look)
        axes.set(xlabel=x_label, ylabel=y_label, title=title)
        if any(abs(row["x"]) >= 10_000 for row in rows):
            axes.xaxis.set_major_formatter("{x:,.0f}")
            axes.tick_params("x", labelsize=9)
        if rows:
            figure.legend(loc="outside lower center", ncols=4, fontsize=9)  # beside the lines, not on them
    return figure


def draw_series(axes: Any, rows: Sequence[Row], label: str, look: Look) -> None:
    """One line over the ``rows`` of one series, with its confidence interval where that is defined.

    Args:
        axes: matplotlib axes.
        rows: tidy table of the series alone, in any order.
        label: what the legend says.
        look: colour, marker and line; a line that is not solid has no markers (a bound, a theory).
    """
    points = sorted(rows, key=lambda row: row["x"])
    x = [point["x"] for point in points]
    mean, low, high = ([float(point[key]) for point in points] for key in ("mean", "ci_low", "ci_high"))
    colour = look.colour
    band = len(points) > MOST_ERROR_BARS
    marker = "" if band or look.line != "-" else look.marker
    axes.plot(x, mean, color=colour, marker=marker, linestyle=look.line, label=label)
    if band:
        axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
        return
    known = [k for k in range(len(points)) if low[k] == low[k] and high[k] == high[k]]
    arms = [[mean[k] - low[k] for k in known], [high[k] - mean[k] for k in known]]
    if known:
        axes.errorbar([x[k] for k in known], [mean[k] for k in known], yerr=arms, fmt="none", ecolor=colour, capsize=2)


def save_figure(figure: Figure, rows: Sequence[Row], stem: str | os.PathLike[str]) -> list[Path]:
    """Write ``stem``.png, ``stem``.pdf and ``stem``.csv (the ``rows`` shown), each complete or not at all.

    The bytes depend on the figure alone: no date, no version goes into the files. Returns the three paths.
    """
    base = Path(stem)
    with matplotlib.rc_context(STYLE):
        png, pdf = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png", metadata={"Software": None})
        figure.savefig(pdf, format="pdf", metadata={"Creator": None, "Producer": None, "CreationDate": None})
    contents = {".png": png.getvalue(), ".pdf": pdf.getvalue(), ".csv": csv_text(rows).encode()}
    paths = {base.with_name(base.name + suffix): data for suffix, data in contents.items()}
    for path, data in paths.items():
        write_atomically(path, data)
    return list(paths)


def csv_text(rows: Sequence[Row]) -> str:
    """``rows`` as CSV; the columns are the keys in order of first appearance, NaN is an empty cell."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        values = (row.get(column, "") for column in columns)
        writer.writerow("" if value is None or value != value else value for value in values)
    return out.getvalue()
