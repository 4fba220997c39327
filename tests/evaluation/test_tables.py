from __future__ import annotations

import csv
import math
from dataclasses import replace

import pytest
import toy
from handmade import first_fit
from toy import DUO, SOLO

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.tables import Table, headline, method_table, paired_table, render, write_summary

WORKLOADS = {
    1: toy.workload_of((0, DUO, 0, 3, 2.0), (0, DUO, 0, 3, 2.0), (1, SOLO, 3, 0, 2.0), (2, DUO, 1, 3, 1.0)),
    2: toy.workload_of((0, DUO, 0, 3, 1.0), (1, SOLO, 3, 0, 9.0)),
}


def comparison(seeds=(1, 2), **changes) -> Comparison:
    """``all`` accepts all, ``some`` refuses the first request: AAR 3/4 and 1/2. Refusals need admission control."""
    scenario = toy.toy_scenario(admission_control=True, **changes)
    runs = Comparison(scenario)
    for seed in seeds:
        runs.add(first_fit(scenario, WORKLOADS[seed], method="some", seed=seed, refuse=frozenset({0})))
        runs.add(first_fit(scenario, WORKLOADS[seed], method="all", seed=seed))
    return runs


def with_aar(values: dict[str, dict[int, float]], bound: dict[int, float] | None = None) -> Comparison:
    """A comparison in which only the AAR of each method and seed is as given."""
    runs = Comparison(toy.toy_scenario())
    for method, by_seed in values.items():
        for seed, aar in by_seed.items():
            record = first_fit(method=method, seed=seed)
            runs.add(record, compute_metrics(record) | {"aar": aar})
    for seed, aar in (bound or {}).items():
        runs.add_bound("lp", seed, aar)
    return runs


def test_means_and_paired_figures():
    runs = comparison()
    assert runs.methods == ["some", "all"]
    assert runs.interval("some", "aar").mean == (3 / 4 + 1 / 2) / 2
    assert runs.interval("some", "aar/solo").mean == 1
    assert runs.difference("all", "some").mean == pytest.approx((1 / 4 + 1 / 2) / 2)
    assert runs.relative_difference("all", "some").mean == pytest.approx(0.375 / 0.625)
    assert runs.paired_cost("all", "some").mean > 0
    assert runs.paired_cost("all", "all").mean == 1


def test_gap_closed_is_a_ratio_of_means():
    runs = with_aar({"myopic_optimal": {0: 0.80, 1: 0.70}, "mine": {0: 0.82, 1: 0.76}}, {0: 0.90, 1: 0.80})
    closed = runs.gap_closed("mine", "lp")
    assert closed is not None and closed.mean == pytest.approx(0.4)
    start = runs.gap_closed("myopic_optimal", "lp")
    assert start is not None and start.mean == 0


def test_no_gap_is_no_number():
    no_gap = with_aar({"myopic_optimal": {0: 0.9, 1: 0.9}, "mine": {0: 0.9, 1: 0.8}}, {0: 0.9, 1: 0.9005})
    assert no_gap.gap_closed("mine", "lp") is None
    assert "–" in paired_table(no_gap, "myopic_optimal").rows[1][-1]
    assert with_aar({"mine": {0: 0.9}}, {0: 1.0}).gap_closed("mine", "lp") is None


def test_methods_that_met_other_requests_are_not_compared():
    runs = comparison(seeds=(1,))
    with pytest.raises(ScenarioError, match="some and late met different requests under seed 1"):
        runs.add(replace(first_fit(runs.scenario, WORKLOADS[2], seed=1), method="late"))


def test_methods_that_met_other_networks_are_not_compared():
    runs = comparison(seeds=(1,))
    elsewhere = first_fit(runs.scenario.replace(seed=9), WORKLOADS[1], method="late", seed=1)
    with pytest.raises(ScenarioError, match="scenario seeds 0 and 9 under workload seed 1"):
        runs.add(elsewhere)


def test_headline_says_what_was_compared():
    assert headline(comparison()).startswith("rho = 0.14, scenario toy, lifetimes hidden, colocation off, ")
    seen = headline(comparison(seeds=(1,), observe_lifetime=True, colocation=True, warmup=1))
    assert "lifetimes seen, colocation on" in seen
    assert "1 workload seed," in seen and "first 1 slots left out" in seen


def test_method_table():
    runs = comparison()
    runs.add_bound("lp", 1, 1.0)
    table = method_table(runs)
    assert table.columns[:4] == ("method", "AAR", "AAR duo", "AAR solo")
    assert [row[0] for row in table.rows] == ["some", "all", "bound: lp"]
    assert table.rows[1][1] == "1.000 ± 0.000"
    assert table.rows[2][1:3] == ("1.000 ± –", "–")  # one seed: no interval


def test_one_seed_has_no_interval_anywhere():
    table = paired_table(comparison(seeds=(1,)), "some")
    assert table.rows[0] == ("some", "–", "–", "–")
    assert table.rows[1][1:3] == ("+0.2500 [–]", "+33.3 % [–]")


def test_text_and_markdown_hold_the_same_cells():
    runs = comparison()
    text, markdown = render(runs, "some"), render(runs, "some", markdown=True)
    for cell in (
        cell for table in (method_table(runs), paired_table(runs, "some")) for row in table.rows for cell in row
    ):
        assert cell in text and cell in markdown
    assert text.splitlines()[0].startswith("rho = ")
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines[:4]}) == 1
    assert "Against" not in render(runs)


def test_columns_are_aligned():
    lines = method_table(comparison()).text(width=1000).splitlines()[1:]
    assert len({len(line) for line in lines}) == 1


def test_summary_and_per_seed_files(tmp_path):
    runs = comparison()
    runs.add_bound("lp", 1, 1.0)
    summary, per_seed = write_summary(tmp_path, runs, "some")
    rows = list(csv.DictReader(summary.open()))
    by_key = {(row["method"], row["metric"]): row for row in rows}
    aar = runs.interval("some", "aar")
    row = by_key["some", "aar"]
    assert [float(row[key]) for key in ("mean", "ci_low", "ci_high", "n")] == [aar.mean, aar.low, aar.high, 2]
    assert (row["reference"], row["scenario"], row["colocation"], row["observe_lifetime"]) == ("", "toy", "0", "0")
    assert by_key["all", "paired_cost"]["reference"] == "some"
    assert ("some", "paired_cost") not in by_key
    assert by_key["lp", "aar_bound"]["ci_low"] == ""
    seeds = list(csv.DictReader(per_seed.open()))
    expected = {(m, s) for m in ("some", "all") for s in ("1", "2")} | {("lp", "1")}
    assert {(r["method"], r["seed"]) for r in seeds} == expected
    values = {(r["method"], r["seed"], r["metric"]): r["value"] for r in seeds}
    assert float(values["some", "2", "aar"]) == 0.5


def test_seeds_without_a_metric_do_not_count():
    runs = Comparison(toy.toy_scenario())
    for seed, kind in ((1, DUO), (2, SOLO)):
        work = toy.workload_of((0, kind, *((0, 3) if kind == DUO else (3, 0)), 1.0))
        runs.add(first_fit(workload=work, seed=seed))
    assert runs.interval("first_fit", "aar/duo").n == 1
    assert math.isnan(runs.metrics["first_fit"][2]["aar/duo"])


def test_a_table_fits_a_terminal_and_the_rest_follows_in_a_second_one():
    table = method_table(comparison())
    lines = table.text(width=60).splitlines()
    assert max(map(len, lines)) <= 60
    heads = [line for line in lines if line.startswith("method")]
    assert len(heads) > 1 and all(column in "".join(heads) for column in table.columns)
    assert sum(line.startswith("some ") for line in lines) == len(heads)


def test_a_column_wider_than_the_terminal_stands_alone():
    table = Table("title", ("method", "a" * 30, "b"), (("x", "1", "2"),))
    assert [line.split()[1:] for line in table.text(width=20).splitlines() if line.startswith("method")] == [
        ["a" * 30],
        ["b"],
    ]


def test_the_head_names_the_mask_that_acted():
    runs = Comparison(toy.toy_scenario(mask="adjacency"))
    runs.add(first_fit(toy.toy_scenario(mask="feasible"), method="own"))
    assert "mask feasible" in headline(runs) and "mask adjacency" not in headline(runs)
