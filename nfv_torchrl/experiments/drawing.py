"""Figures of several panels in which a method always has the same colour and marker."""

from __future__ import annotations

import re
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
CAPTION_LETTERS_PER_INCH = 15
CAPTION_LINE, CAPTION_MARGIN = 0.15, 0.16
"""Inches: of a line of the caption, and around it."""
LEGEND_SIZE, POINTS_PER_INCH = 9, 72
LETTERS_OF_A_HANDLE = 8
MATHEMATICS = {
    "λ": r"$\lambda$",
    "μ": r"$\mu$",
    "ρ": r"$\rho$",
    "γ": r"$\gamma$",
    "w_cost": r"$w_\mathrm{cost}$",
    "w_acc": r"$w_\mathrm{acc}$",
    "exp(-t/μ)": r"$e^{-t/\mu}$",
    "O(P_n (P_i + P_h P_n + P_o))": r"$O(P_n (P_i + P_h P_n + P_o))$",
    "O(E F)": r"$O(E F)$",
    "O(L + N log N + F K)": r"$O(L + N \log N + F K)$",
}
SYMBOLS = re.compile("|".join(map(re.escape, sorted(MATHEMATICS, key=len, reverse=True))))
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
    caption: str,
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
        title: what is shown, above all.
        caption: what it took, and what to know, in small letters below.
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
    found |= {name: looks([other])[other]._replace(line="--") for name, other in like.items()}

    def draw(axes: Any, shown: Sequence[Row]) -> None:
        for name in series:
            mine = [row for row in shown if row["series"] == name]
            if mine:
                draw_series(axes, mine, name, found[name])
        axes.set_xlabel(mathematics(x_label))
        axes.set(**{f"{axis}scale": "log" for axis in log})
        if "y" in log:  # less than a decade would show a single number
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
        if ticks is not None:
            axes.set_xticks(list(ticks), [mathematics(text) for text in ticks.values()])
            axes.minorticks_off()

    with matplotlib.rc_context(STYLE):
        height = 5.2 + (GAP_HEIGHT if below else 0)
        figure = Figure(figsize=(1.4 + 4.6 * len(panels), height), layout="constrained")
        set_title(figure, title)
        room = set_caption(figure, caption)
        ratios = [2, 1] if below else [1]
        sharey: Any = "row" if isinstance(y_label, str) else False
        grid = figure.subplots(len(ratios), len(panels), squeeze=False, sharey=sharey, height_ratios=ratios)
        for column, panel in enumerate(panels):
            draw(grid[0, column], [row for row in rows if row["panel"] == panel])
            grid[0, column].set_title(mathematics(panel), fontsize=10)
            if y_label == "AAR":
                end_at_one(grid[0, column])
            if not isinstance(y_label, str):
                grid[0, column].set_ylabel(mathematics(y_label[panel]))
            if below:
                shown = [row for row in below if row["panel"] == panel]
                draw(grid[1, column], shown)
                grid[1, column].set(xlim=grid[0, column].get_xlim(), ylim=GAP_RANGE)
                if not shown:
                    _say_instead(grid[1, column], "myopic_optimal is at the bound:\nthere is no gap to close")
        if isinstance(y_label, str):
            grid[0, 0].set_ylabel(mathematics(y_label))
        if below:
            bound = below[0]["reference"].removeprefix("bound: ")
            grid[1, 0].set_ylabel(f"share of the gap from\nmyopic_optimal to the\n{bound} bound closed")
        _legend(figure, grid[0], room)
    return figure


def set_title(figure: Figure, title: str) -> None:
    """``title`` above all panels, broken where the figure is too narrow for it."""
    figure.suptitle(_broken(figure, title, LETTERS_PER_INCH), fontsize=10)


def set_caption(figure: Figure, caption: str) -> float:
    """``caption`` in small letters below all else, for which the figure grows.

    Returns:
        The room that it takes, in inches.
    """
    text = _broken(figure, caption, CAPTION_LETTERS_PER_INCH)
    room = CAPTION_LINE * (1 + text.count("\n")) + CAPTION_MARGIN
    height = figure.get_figheight() + room
    figure.set_figheight(height)
    figure.get_layout_engine().set(rect=(0, room / height, 1, 1 - room / height))  # type: ignore[union-attr, call-arg]
    figure.text(0.01, CAPTION_MARGIN / 2 / height, text, fontsize=8, color="#444444", va="bottom", linespacing=1.2)
    return room


def mathematics(text: str) -> str:
    """Symbols in ``text`` as Matplotlib sets mathematics; a dollar stays one."""
    return SYMBOLS.sub(lambda found: MATHEMATICS[found[0]], text.replace("$", r"\$"))


def _broken(figure: Figure, text: str, letters_per_inch: int) -> str:
    text = re.sub(r" = (\S+)( s\b)?", lambda found: found[0].replace(" ", "\u00a0"), text)  # stays on one line
    width = int(letters_per_inch * figure.get_figwidth())
    lines = [line for part in text.split("\n") for line in textwrap.wrap(part, width, break_on_hyphens=False)]
    return mathematics("\n".join(lines))


def end_at_one(axes: Any) -> None:
    """A share is 1 at most, and so is its axis, but for the room of a marker."""
    low, high = axes.get_ylim()
    if high > 1:
        axes.set_ylim(low, max(1, 1 + 0.02 * (1 - low)))


def _say_instead(axes: Any, text: str) -> None:
    axes.clear()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, fontsize=9, color="#444444")


def _legend(figure: Figure, grid: Sequence[Any], room: float) -> None:
    """One entry for each series of any panel, below them all and above ``room`` inches."""
    entries: dict[str, Any] = {}
    for axes in grid:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        longest = max(map(len, entries)) + LETTERS_OF_A_HANDLE
        columns = max(1, int(LETTERS_PER_INCH * figure.get_figwidth() / longest))
        columns = min(columns, MOST_COLUMNS, len(entries))
        labels = [mathematics(label) for label in entries]
        figure.legend(
            list(entries.values()),
            labels,
            loc="outside lower center",
            ncols=columns,
            fontsize=LEGEND_SIZE,
            borderaxespad=0.5 + room * POINTS_PER_INCH / LEGEND_SIZE,
        )


def _order(name: str) -> int:
    return list(LOOKS).index(name) if name in LOOKS else len(LOOKS)
