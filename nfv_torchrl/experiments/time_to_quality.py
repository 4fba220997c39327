"""How much processor time agents take to come near the exact search: from cells to rows, a table and a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.statistics import Interval
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import panel_figure
from nfv_torchrl.experiments.rows import values
from nfv_torchrl.vocabulary import TABLE

SLACK = 1e-6
"""A share that lacks no more than this is reached: event files hold AAR as float32."""
LEFT = 0.5
"""Where the logarithmic axis of seconds shows what is there without training."""
TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
NEVER = "not reached"
Rows = list[dict[str, Any]]


class Point(NamedTuple):
    """A policy at one of the evaluations of its training; 0 frames: untrained.

    Attributes:
        frames: decisions of the training until then.
        seconds: its processor time until then.
        share: AAR over that of the exact search on the same requests.
    """

    frames: int
    seconds: float
    share: float


@dataclass(frozen=True)
class Timed:
    """The cells of the benchmark.

    Attributes:
        trained: by method and training seed, the training.
        exact: ``myopic_optimal`` on the workloads of its evaluations.
        store: what is there.
    """

    trained: Mapping[str, Mapping[int, Cell]]
    exact: Cell
    store: CellStore

    def curves(self) -> dict[str, dict[int, list[Point]]]:
        """By method and training seed, those that are there."""
        if not self.store.has(self.exact):
            return {}
        exact = fmean(values(self.store.read(self.exact), "aar"))
        found = {
            name: {seed: curve_of(self.store.read(run), exact) for seed, run in runs.items() if self.store.has(run)}
            for name, runs in self.trained.items()
        }
        return {name: curves for name, curves in found.items() if curves}

    def lacking(self) -> list[str]:
        """What is not there, for people: ``ppo: training seeds 1, 2``."""
        missing = {
            name: [str(seed) for seed, run in runs.items() if not self.store.has(run)]
            for name, runs in self.trained.items()
        }
        told = [f"{name}: training seeds {', '.join(seeds)}" for name, seeds in missing.items() if seeds]
        return told if self.store.has(self.exact) else ["myopic_optimal", *told]


def curve_of(result: Mapping[str, Any], exact: float) -> list[Point]:
    """The evaluations of a training, whose time before the first frame is none; ``exact``: AAR of the exact search."""
    return [
        Point(int(each["frames"]), each["processor_seconds"] if each["frames"] else 0.0, each["aar"] / exact)
        for each in result["eval"]
    ]


def first_at(curve: Sequence[Point], share: float) -> Point | None:
    """The first evaluation with at least that share; None: it was not reached.

    Examples:
        >>> curve = [Point(0, 0.0, 0.8), Point(100, 2.0, 0.96), Point(200, 4.0, 0.94), Point(300, 6.0, 0.97)]
        >>> first_at(curve, 0.95), first_at(curve, 0.98)
        (Point(frames=100, seconds=2.0, share=0.96), None)
    """
    return next((point for point in curve if point.share >= share - SLACK), None)


def quality_rows(curves: Mapping[str, Mapping[int, Sequence[Point]]], shares: Sequence[float]) -> Rows:
    """One row for each method and training seed; what was not reached is None."""
    return [
        _row(name, seed, curve, shares) for name, by_seed in curves.items() for seed, curve in sorted(by_seed.items())
    ]


def _row(name: str, seed: int, curve: Sequence[Point], shares: Sequence[float]) -> dict[str, Any]:
    row: dict[str, Any] = {"method": name, "seed": seed}
    for share in shares:
        first = first_at(curve, share)
        row[TABLE["seconds_to/SHARE"].key(f"{share:g}")] = None if first is None else first.seconds
        row[TABLE["frames_to/SHARE"].key(f"{share:g}")] = None if first is None else first.frames
    row["aar_share_untrained"] = curve[0].share
    row["aar_share_best"] = max(point.share for point in curve)
    row["aar_share"] = curve[-1].share
    row["frames"], row["processor_seconds"] = curve[-1].frames, curve[-1].seconds
    return row


def quality_table(title: str, rows: Rows, shares: Sequence[float]) -> Table:
    """One line for each method: the medians over training seeds of when each share was reached, then means.

    The last columns are the decisions and processor seconds of a whole training, and the training seeds that are there.
    """
    columns = ("method", *(f"{share:g}" for share in shares), "untrained", "best", "at the end", "frames", "s", "seeds")
    lines = []
    for name in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == name]
        whole = [f"{fmean(row[key] for row in mine):.4f}"
                 for key in ("aar_share_untrained", "aar_share_best", "aar_share")]  # fmt: skip
        spent = [f"{fmean(row['frames'] for row in mine) / 1000:,.0f}k",
                 f"{fmean(row['processor_seconds'] for row in mine):,.0f}"]  # fmt: skip
        lines.append((name, *(reached(mine, share) for share in shares), *whole, *spent, str(len(mine))))
    return Table(title, columns, tuple(lines))


def reached(rows: Rows, share: float) -> str:
    """When a method reached a share: ``12 s, 40k``, the medians over training seeds of seconds and frames.

    A seed that did not counts as later than all others, and the text says how many did: ``12 s, 40k (2/3)``.
    """
    seconds, frames = (
        [math.inf if row[key] is None else row[key] for row in rows]
        for key in (f"seconds_to/{share:g}", f"frames_to/{share:g}")
    )
    did = sum(map(math.isfinite, seconds))
    some = f" ({did}/{len(rows)})" if 0 < did < len(rows) else ""
    if math.isinf(median(seconds)):
        return NEVER + some
    if median(frames) == 0:
        return f"0 s, untrained{some}"
    return f"{median(seconds):.0f} s, {median(frames) / 1000:,.0f}k{some}"


def quality_figure(
    curves: Mapping[str, Mapping[int, Sequence[Point]]], title: str, caption: str, panel: str
) -> tuple[Figure, Rows]:
    """The share over processor seconds, evaluation by evaluation; and the rows of it.

    Means over training seeds, with the lowest and the highest: an interval of two or three would say nothing.
    """
    rows: Rows = []
    for name, by_seed in curves.items():
        at: dict[int, list[Point]] = {}
        for point in (point for curve in by_seed.values() for point in curve):
            at.setdefault(point.frames, []).append(point)
        for frames, points in sorted(at.items()):
            seconds = max(fmean(point.seconds for point in points), LEFT)
            rows.append(tidy_row(name, seconds, _span([point.share for point in points]), frames=frames, panel=panel))
    longest = max((row["x"] for row in rows), default=1.0)
    ticks = {LEFT: "0"} | {float(place): f"{place:g}" for place in TICKS if place <= longest}
    figure = panel_figure(
        rows,
        title=title,
        caption=caption,
        x_label="processor seconds of training",
        y_label="AAR / AAR of myopic_optimal",
        ticks=ticks,
        log="x",
    )
    return figure, rows


def _span(shares: Sequence[float]) -> Interval:
    """The mean, and from the lowest to the highest of several."""
    ends = (min(shares), max(shares)) if len(shares) > 1 else (math.nan, math.nan)
    return Interval(fmean(shares), *ends, len(shares))
