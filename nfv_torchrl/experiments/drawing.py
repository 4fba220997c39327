"""Figures of several panels in which a method always has the same colour and marker."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from nfv_torchrl.evaluation.figures import STYLE, Row, csv_text, draw_series, save_figure
from nfv_torchrl.evaluation.looks import LOOKS, looks
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.rows import Rows
from nfv_torchrl.experiments.study import Study
from nfv_torchrl.files import write_atomically

LETTERS_PER_INCH = 14
LETTERS_OF_A_HANDLE = 8
MOST_COLUMNS = 5
GAP_HEIGHT = 2.6
GAP_RANGE = (-1.05, 1.05)
"""Shares of the gap that are drawn; what lies below is in the CSV alone."""


@dataclass
class Drawn:
    """A figure, the rows that it shows, and paired comparisons that go into a CSV of their own."""

    figure: Figure
    rows: Rows
    paired: Rows = field(default_factory=list)

    def save(self, stem: Path) -> None:
        """``stem``.png, .pdf, .csv and, if there are any, _paired.csv."""
        save_figure(self.figure, self.rows, stem)
        if self.paired:
            write_atomically(stem.with_name(f"{stem.name}_paired.csv"), csv_text(self.paired))


class Experiment(Protocol):
    """One figure: what has to be computed for it, and how it is drawn."""

    def cells(self, study: Study) -> list[Cell]:
        """The cells it shows (what these need comes by itself)."""

    def draw(self, study: Study, store: CellStore) -> Drawn:
        """The figure of computed cells."""


def panel_figure(
    rows: Sequence[Row],
    *,
    title: str,
    x_label: str,
    y_label: str | Mapping[str, str],
    ticks: Mapping[float, str] | None = None,
    log: str = "",
    like: Mapping[str, str] | None = None,
    below: Sequence[Row] = (),
) -> Figure:
    """One panel beside the other for each value of ``panel`` among ``rows``, with one legend.

    Args:
        rows: tidy table with the column ``panel``.
        title: above all.
        x_label: of all panels.
        y_label: of all panels, or by panel.
        ticks: places and labels on the horizontal axis.
        log: axes that are logarithmic: ``x``, ``y`` or ``xy``.
        like: series that are dashed, and the series whose colour they have.
        below: shares of the gap to a bound, drawn in a second row of panels.
    """
    panels = list(dict.fromkeys(row["panel"] for row in rows))
    series = sorted(dict.fromkeys(row["series"] for row in rows), key=_order)
    like = like or {}
    found = looks(name for name in series if name not in like)
    found |= {name: LOOKS[other]._replace(line="--") for name, other in like.items()}

    def draw(axes: Any, shown: Sequence[Row]) -> None:
        for name in series:
            mine = [row for row in shown if row["series"] == name]
            if mine:
                draw_series(axes, mine, name, found[name])
        axes.set_xlabel(x_label)
        axes.set(**{f"{axis}scale": "log" for axis in log})
        if "y" in log:  # less than a decade would show a single number
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
        if ticks is not None:
            axes.set_xticks(list(ticks), list(ticks.values()))
            axes.minorticks_off()

    with matplotlib.rc_context(STYLE):
        height = 5.2 + (GAP_HEIGHT if below else 0)
        figure = Figure(figsize=(1.4 + 4.6 * len(panels), height), layout="constrained")
        set_title(figure, title)
        ratios = [2, 1] if below else [1]
        sharey: Any = "row" if isinstance(y_label, str) else False
        grid = figure.subplots(len(ratios), len(panels), squeeze=False, sharey=sharey, height_ratios=ratios)
        for column, panel in enumerate(panels):
            draw(grid[0, column], [row for row in rows if row["panel"] == panel])
            grid[0, column].set_title(panel, fontsize=10)
            if not isinstance(y_label, str):
                grid[0, column].set_ylabel(y_label[panel])
            if below:
                draw(grid[1, column], [row for row in below if row["panel"] == panel])
                grid[1, column].set(xlim=grid[0, column].get_xlim(), ylim=GAP_RANGE)
        if isinstance(y_label, str):
            grid[0, 0].set_ylabel(y_label)
        if below:
            bound = below[0]["reference"].removeprefix("bound: ")
            grid[1, 0].set_ylabel(f"share of the gap from\nmyopic_optimal to the\n{bound} bound closed")
        _legend(figure, grid[0])
    return figure


def set_title(figure: Figure, title: str) -> None:
    """The lines of ``title`` above all panels, broken where the figure is too narrow for them."""
    width = int(LETTERS_PER_INCH * figure.get_figwidth())
    lines = [line for part in title.split("\n") for line in textwrap.wrap(part, width, break_on_hyphens=False)]
    figure.suptitle("\n".join(lines), fontsize=9)


def _legend(figure: Figure, grid: Sequence[Any]) -> None:
    """One entry for each series of any panel, below them all."""
    entries: dict[str, Any] = {}
    for axes in grid:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        longest = max(map(len, entries)) + LETTERS_OF_A_HANDLE
        columns = max(1, int(LETTERS_PER_INCH * figure.get_figwidth() / longest))
        columns = min(columns, MOST_COLUMNS, len(entries))
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns, fontsize=9)


def _order(name: str) -> int:
    return list(LOOKS).index(name) if name in LOOKS else len(LOOKS)
