"""A comparison as tables: aligned text for the terminal, Markdown for documents, CSV for everything else."""

from __future__ import annotations

import csv
import io
import math
import os
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.manifest import write_manifest
from nfv_torchrl.evaluation.statistics import Interval
from nfv_torchrl.files import write_atomically
from nfv_torchrl.vocabulary import PER_SEED_COLUMNS, SUMMARY_COLUMNS, TABLE, Form, Quantity, find

UNDEFINED = "–"
WIDTH = 120
"""Columns of a terminal that a table may take."""
GAP = 2


@dataclass(frozen=True)
class Table:
    """A title, column heads and rows of cells, all text; the first column names the row."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self, width: int = WIDTH) -> str:
        """Aligned columns for a terminal, in several tables one below the other if they need more than ``width``."""
        lines = [self.columns, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.columns))]
        parts = ["\n".join(_ruled(lines, widths, chosen)) for chosen in _fitting(widths, width)]
        return "\n\n".join(["\n".join([textwrap.fill(self.title, width), parts[0]]), *parts[1:]])

    def markdown(self) -> str:
        """A Markdown table under its title in bold."""
        lines = [self.columns, ("---", *["---:"] * (len(self.columns) - 1)), *self.rows]
        return "\n".join([f"**{self.title}**", "", *("| " + " | ".join(line) + " |" for line in lines)])


def render(comparison: Comparison, reference: str | None = None, markdown: bool = False) -> str:
    """All tables of a comparison under the line that says what was compared.

    Args:
        comparison: the runs.
        reference: the method that the others are paired with; None (or a single method): no paired table.
        markdown: Markdown instead of text for a terminal.
    """
    tables = [method_table(comparison), detail_table(comparison)]
    if reference is not None and len(comparison.methods) > 1:
        tables.append(paired_table(comparison, reference))
    if reference is not None and len(comparison.methods) > 2:
        tables.append(cost_matrix(comparison))
    said = headline(comparison) if markdown else _filled(headline(comparison))
    return "\n\n".join([said, *(table.markdown() if markdown else table.text() for table in tables)])


def _filled(line: str) -> str:
    """Lines of at most ``WIDTH``, broken after commas only, so that ``N = 10`` stays together."""
    return textwrap.fill(line.replace(" ", "\0").replace(",\0", ", "), WIDTH).replace("\0", " ")


def headline(comparison: Comparison) -> str:
    """The scenario in one line, rho first."""
    scenario = comparison.scenario
    masks = {method: comparison.scenario_of(method).mask for method in comparison.methods}
    # What the scenario says need not be what acted: methods may bring a mask of their own.
    usual = scenario.mask if scenario.mask in masks.values() or not masks else next(iter(masks.values()))
    parts = [
        f"rho = {_loads(comparison)}",
        f"scenario {scenario.name}",
        f"lifetimes {'seen' if scenario.observe_lifetime else 'hidden'}",
        f"colocation {'on' if scenario.colocation else 'off'}",
        f"mask {usual}",
        f"admission control {'on' if scenario.admission_control else 'off'}",
        f"N = {scenario.substrate.num_nodes}",
        f"T = {scenario.horizon}",
        _seeds(comparison),
    ]
    if scenario.warmup:
        parts.append(f"first {scenario.warmup} slots left out")
    own = [f"{method} acts under mask {mask}" for method, mask in masks.items() if mask != usual]
    return ", ".join([*parts, *own])


def _loads(comparison: Comparison) -> str:
    """rho, and its range where networks differ."""
    by_network = {scenario.seed: scenario.offered_load() for scenario in comparison.scenarios().values()}
    loads = list(by_network.values())
    mean = f"{math.fsum(loads) / len(loads):.2f}"
    return mean if len(loads) == 1 else f"{mean} ({min(loads):.2f} to {max(loads):.2f})"


def _seeds(comparison: Comparison) -> str:
    networks, runs = len(comparison.scenario_seeds), len(comparison.scenarios())
    if networks > 1:
        return f"{networks} scenario seeds with a workload seed each"
    return f"{runs} workload seed{'s' if runs > 1 else ''}"


def method_table(comparison: Comparison) -> Table:
    """One row a method (and a bound): mean ± half width of the 95 % confidence interval of the main metrics."""
    shown = [(key, row) for key, row in _printed(comparison) if not row.details]
    rows = [
        (method, *(_metric_cell(comparison, method, key, row) for key, row in shown)) for method in comparison.methods
    ]
    for name in comparison.bounds:
        bound = _cell(comparison.bound(name), _share)
        rows.append((f"bound: {name}", *(bound if key == "aar" else UNDEFINED for key, _ in shown)))
    over = "scenario seeds (networks)" if len(comparison.scenario_seeds) > 1 else "workload seeds"
    title = f"Mean and 95 % confidence interval over {over}"
    return Table(title, ("method", *(_head(key, row) for key, row in shown)), tuple(rows))


def detail_table(comparison: Comparison) -> Table:
    """One row a method: why requests were rejected, what each service cost, what failures cut short, and answers that
    were not proved the best, if any."""
    shown = [
        (key, row)
        for key, row in _printed(comparison)
        if row.details and any(comparison.interval(method, key).mean > 0 for method in comparison.methods)
    ]
    rows = [
        (method, *(_metric_cell(comparison, method, key, row) for key, row in shown)) for method in comparison.methods
    ]
    title = "Rejections by reason (share of arrived), cost per accepted request of each service"
    return Table(title, ("method", *(_head(key, row) for key, row in shown)), tuple(rows))


def _printed(comparison: Comparison) -> Iterator[tuple[str, Quantity]]:
    """The metrics that have a column, and their rows in the table of all quantities."""
    for key in comparison.metric_names():
        found = find(key)
        if found is not None and found[0].head is not None:
            yield key, found[0]


def _head(key: str, row: Quantity) -> str:
    return f"{row.head}{key.removeprefix(row.key())}" if row.part else str(row.head)


def _metric_cell(comparison: Comparison, method: str, key: str, row: Quantity) -> str:
    interval, form = comparison.interval(method, key), FORMS[row.form]
    # The runs of a batch share their decision time, so its spread over seeds says nothing.
    if row.measured and not math.isnan(interval.mean):
        return form(interval.mean)
    return _cell(interval, form)


def paired_table(comparison: Comparison, reference: str) -> Table:
    """One row a method: difference of AAR to ``reference``, paired cost, share of the gap to each bound closed."""
    heads = [TABLE[name].head or name for name, _, _ in _paired(comparison, reference, reference)]
    closed = [f"{TABLE['gap_closed'].head}: {bound}" for bound in comparison.bounds]
    rows = []
    for method in comparison.methods:
        rows.append(
            (
                method,
                *(_span(interval, form) for _, interval, form in _paired(comparison, method, reference)),
                *(_span(comparison.gap_closed(method, bound), _percent) for bound in comparison.bounds),
            )
        )
    title = f"Against {reference} on the same seeds: difference of AAR [95 % confidence interval], cost ratio over the"
    return Table(f"{title} requests both accept", ("method", *heads, *closed), tuple(rows))


def cost_matrix(comparison: Comparison) -> Table:
    """Paired cost of every method (row) to every other (column): the mean over seeds."""
    rows = [
        (
            method,
            *(
                "–" if method == other else _share(comparison.paired_cost(method, other).mean)
                for other in comparison.methods
            ),
        )
        for method in comparison.methods
    ]
    title = "Paired cost, row over column: sum of phi over the requests both accept, as a ratio, mean over seeds"
    return Table(title, ("method", *comparison.methods), tuple(rows))


def _paired(
    comparison: Comparison, method: str, reference: str
) -> Iterator[tuple[str, Interval | None, Callable[[float], str]]]:
    """Name in the summary, interval and format of each paired figure; nothing for the reference itself."""
    same = method == reference
    yield "aar_difference", None if same else comparison.difference(method, reference), _signed
    yield "aar_relative_difference", None if same else comparison.relative_difference(method, reference), _percent
    yield "paired_cost", None if same else comparison.paired_cost(method, reference), _share


def write_summary(folder: str | os.PathLike[str], comparison: Comparison, reference: str | None = None) -> list[Path]:
    """Write ``summary.csv`` (a row for each method and metric; paired figures name their ``reference``) and
    ``per_seed.csv`` (every metric of every run, then the bounds) to ``folder``, and ``evaluation.json``, which says
    what the folder holds. An interval that is undefined is empty. Returns the paths of the two tables."""
    paths = [Path(folder) / "summary.csv", Path(folder) / "per_seed.csv"]
    scenario = comparison.scenario
    about = (scenario.name, int(scenario.colocation), int(scenario.observe_lifetime))
    summary = [
        (method, metric, *_numbers(interval), against, *about)
        for method, metric, interval, against in _summary_rows(comparison, reference)
    ]
    of_seed = {seed: (world.seed, world.offered_load()) for seed, world in comparison.scenarios().items()}
    per_seed = [
        (method, "" if seed is None else seed, metric, _number(value), *of_seed[seed])
        for method, runs in comparison.metrics.items()
        for seed, run in runs.items()
        for metric, value in run.items()
    ]
    per_seed += [
        (name, "" if seed is None else seed, "aar_bound", _number(value), *of_seed[seed])
        for name, values in comparison.bounds.items()
        for seed, value in values.items()
    ]
    write_atomically(paths[0], _csv(SUMMARY_COLUMNS, summary))
    write_atomically(paths[1], _csv(PER_SEED_COLUMNS, per_seed))
    write_manifest(folder, comparison, reference)
    return paths


def _summary_rows(comparison: Comparison, reference: str | None) -> Iterator[tuple[str, str, Interval, str]]:
    for method in comparison.methods:
        for metric in comparison.metric_names():
            yield method, metric, comparison.interval(method, metric), ""
        for name, interval, _ in _paired(comparison, method, reference) if reference is not None else ():
            if interval is not None:
                yield method, name, interval, reference or ""
        for bound in comparison.bounds:
            closed = comparison.gap_closed(method, bound)
            if closed is not None:
                yield method, "gap_closed", closed, bound
    for name in comparison.bounds:
        yield name, "aar_bound", comparison.bound(name), ""


def _csv(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return out.getvalue()


def _numbers(interval: Interval) -> tuple[object, ...]:
    return _number(interval.mean), _number(interval.low), _number(interval.high), interval.n


def _number(value: float) -> object:
    return "" if math.isnan(value) else value


def _cell(interval: Interval, form: Callable[[float], str]) -> str:
    """Mean ± half width."""
    if math.isnan(interval.mean):
        return UNDEFINED
    half = interval.half_width
    return f"{form(interval.mean)} ± {UNDEFINED if math.isnan(half) else form(half)}"


def _span(interval: Interval | None, form: Callable[[float], str]) -> str:
    """Estimate [low, high]: a paired interval need not be symmetric."""
    if interval is None or math.isnan(interval.mean):
        return UNDEFINED
    ends = UNDEFINED if math.isnan(interval.low) else f"{form(interval.low)}, {form(interval.high)}"
    return f"{form(interval.mean)} [{ends}]"


def _share(value: float) -> str:
    return f"{value:.3f}"


def _signed(value: float) -> str:
    return f"{value:+.4f}"


def _percent(value: float) -> str:
    return f"{100 * value:+.1f} %"


def _percent_of(value: float) -> str:
    return f"{100 * value:.1f} %"


def _amount(value: float) -> str:
    """About four digits, whatever the size."""
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 100 else 2
    return f"{value:,.{digits}f}"


def _fitting(widths: Sequence[int], width: int) -> list[list[int]]:
    """Columns of each table: those that fit beside the first one, which names the rows and is in all of them."""
    tables, taken = [[0]], widths[0]
    for column in range(1, len(widths)):
        if taken + GAP + widths[column] > width and len(tables[-1]) > 1:
            tables.append([0])
            taken = widths[0]
        tables[-1].append(column)
        taken += GAP + widths[column]
    return tables


def _ruled(lines: Sequence[Sequence[str]], widths: Sequence[int], columns: Sequence[int]) -> list[str]:
    """The chosen columns of all lines, aligned, with a rule below the head."""
    shown = []
    for line in lines:
        first, *others = (line[k].rjust(widths[k]) if k else line[k].ljust(widths[k]) for k in columns)
        shown.append((" " * GAP).join([first, *others]).rstrip())
    return [shown[0], "-" * len(shown[0]), *shown[1:]]


FORMS: dict[Form, Callable[[float], str]] = {"share": _share, "percent": _percent_of, "amount": _amount}
