from __future__ import annotations

import csv
import math

from nfv_torchrl.evaluation.figures import MOST_ERROR_BARS, line_figure, save_figure, tidy_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval


def rows(points: int = 3) -> list[dict]:
    made = [tidy_row("greedy", x, mean_interval([x, x + 1, x + 2]), command="run me") for x in range(points)]
    made += [tidy_row("bound", x, Interval(5.0, math.nan, math.nan, 1)) for x in reversed(range(points))]
    return made


def test_a_line_a_series_with_error_bars_where_there_is_an_interval():
    figure = line_figure(rows(), x_label="requests/s", y_label="AAR", title="toy", dashed=("bound",))
    (axes,) = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["greedy", "bound"]
    lines = {line.get_label(): line for line in axes.lines}
    assert lines["greedy"].get_linestyle() == "-" and lines["bound"].get_linestyle() == "--"
    assert list(lines["bound"].get_xdata()) == [0, 1, 2]  # sorted, whatever the rows' order
    assert len(axes.containers) == 1  # no bars for the bound
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("requests/s", "AAR", "toy")


def test_many_points_have_a_band():
    (axes,) = line_figure(rows(MOST_ERROR_BARS + 1), x_label="iteration", y_label="AAR").axes
    assert len(axes.collections) == 2 and not axes.containers


def test_figure_without_rows():
    assert not line_figure([], x_label="x", y_label="y").axes[0].lines


def test_three_files_and_the_same_bytes_again(tmp_path):
    def save(stem):
        return save_figure(line_figure(rows(), x_label="x", y_label="y"), rows(), tmp_path / "figures" / stem)

    first, second = save("aar"), save("again")
    assert [path.name for path in first] == ["aar.png", "aar.pdf", "aar.csv"]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == sorted(p.name for p in [*first, *second])
    assert first[0].read_bytes().startswith(b"\x89PNG") and first[1].read_bytes().startswith(b"%PDF")
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    table = list(csv.DictReader(first[2].open()))
    assert table[0] == {
        "series": "greedy", "x": "0", "mean": "1.0", "ci_low": table[0]["ci_low"], "ci_high": table[0]["ci_high"],
        "n": "3", "command": "run me",
    }  # fmt: skip
    assert table[-1]["ci_low"] == "" and table[-1]["command"] == ""
