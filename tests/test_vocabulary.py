"""One table names what is logged, tabled and audited; code, files and docs agree, and a new metric needs no more."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy
from toy import DUO, SOLO

from nfv_torchrl import losses, vocabulary
from nfv_torchrl.evaluation import metrics
from nfv_torchrl.evaluation.audit import audit_run, recompute
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import method_table, write_summary
from nfv_torchrl.methods import RandomMethod
from nfv_torchrl.vocabulary import TABLE, Quantity, add, find, in_place, without_row

PAGE = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
SCENARIO = toy.toy_scenario(mask="feasible")
WORKLOAD = toy.workload_of((0, DUO, 0, 3, 2.0), (0, SOLO, 3, 0, 2.0), (1, DUO, 1, 3, 1.0))


@pytest.fixture
def growing() -> Iterator[None]:
    """Rows and functions that a test adds are taken out again."""
    registries = (TABLE, metrics.FUNCTIONS, recompute.OWN)
    before = [dict(registry) for registry in registries]
    yield
    for registry, content in zip(registries, before, strict=True):
        registry.clear()
        registry.update(content)


def one_run() -> metrics.RunRecord:
    return run_method(SCENARIO, RandomMethod(name="random", mask="feasible"), [0], workloads=[WORKLOAD])[0]


def test_the_page_prints_the_table():
    assert vocabulary.markdown() in PAGE, "print it anew: python -m nfv_torchrl.vocabulary"
    for column in (*vocabulary.SUMMARY_COLUMNS, *vocabulary.PER_SEED_COLUMNS):
        assert f"`{column}`" in PAGE
    for place in vocabulary.PLACES:
        assert f"\n| {place} | " in PAGE


def test_every_metric_of_a_run_is_computed_twice():
    rows = {row.name: row for row in in_place("files")}
    assert list(metrics.FUNCTIONS) == list(rows)
    assert set(recompute.OWN) == {name for name, row in rows.items() if not row.measured}
    assert [key for key in metrics.compute_metrics(one_run()) if find(key) is None] == []


def test_a_name_is_looked_up_with_its_part():
    assert find("aar") == (TABLE["aar"], "")
    assert find("aar/web") == (TABLE["aar/SERVICE"], "web")
    assert find("rejected/delay") == (TABLE["rejected/REASON"], "delay")
    assert find("anuc/web") is None and find("nonsense") is None
    assert TABLE["aar/SERVICE"].key("web") == "aar/web" and TABLE["aar"].key() == "aar"
    assert without_row(["train/aar/web", "eval/rho", "train/rho", "aar", "speed/frames_per_second", "train/mine"]) == [
        "train/rho", "aar", "train/mine",
    ]  # fmt: skip


def test_what_is_trained_and_evaluated_has_the_same_name():
    both = [row.name for row in TABLE.values() if row.train is not None]
    assert both and all({"train", "eval", "files"} <= {*TABLE[name].where} for name in both)


def test_every_key_that_a_loss_says_it_writes_has_a_row():
    kinds = [getattr(losses, name) for name in losses.__all__]
    # Some are properties once TorchRL has made one of them; recipes' tests see those losses run.
    written = [keys for kind in kinds if isinstance(keys := vars(kind).get("out_keys"), list)]
    said = {key for keys in written for key in keys}
    assert said and not without_row(f"train/{key}" for key in said)


def test_two_rows_of_one_name_are_refused(growing):
    with pytest.raises(ValueError, match="aar is in the table already"):
        add(Quantity("aar", "", "something else"))
    assert add(TABLE["aar"]) is TABLE["aar"]


def test_a_new_metric_reaches_files_tables_and_docs_and_needs_the_audits_own(growing, tmp_path):
    """With the two functions that the page shows."""
    function, again = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(function, {})
    record = one_run()
    comparison = Comparison(SCENARIO)
    folder = write_run(tmp_path / "random" / "seed_0", record, comparison.add(record))
    expected = int(record.hops[record.accepted].max())
    assert comparison.metrics["random"][0]["most_hops"] == expected > 0

    table = method_table(comparison)
    assert table.columns[-1] == "most hops" and table.rows[0][-1] == f"{expected:.2f} ± –"
    for path in write_summary(tmp_path, comparison):
        assert [row["metric"] for row in csv.DictReader(path.open())].count("most_hops") == 1
    assert "\n| `most_hops` | links | links used by the longest accepted walk | eval, files, audit | most hops |" in (
        vocabulary.markdown()
    )
    assert not without_row(["eval/most_hops"])

    (problem,) = audit_run(folder).problems[:1]
    assert problem == "metrics.json: most_hops cannot be checked, the audit has no arithmetic of its own for it"
    exec(again, {})
    assert audit_run(folder).clean


def test_the_table_imports_nothing_of_the_package():
    code = "import sys, nfv_torchrl.vocabulary; print(*(m for m in sys.modules if m.startswith('nfv')))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert set(loaded) <= {"nfv_torchrl", "nfv_torchrl.vocabulary"}
