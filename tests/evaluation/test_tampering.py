"""A whole evaluation, written by the real code, tampered with in every way we could think of: each is noticed, by name.

Whoever tampers here also writes the SHA-256 of what was changed anew, so that it is the numbers that give it away;
``CHECKSUMS`` are the changes that no number contradicts.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from handmade import read_decisions, write_decisions

from nfv_torchrl.bounds.bound import blind_bound, hindsight_bound
from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.evaluation.bounds import recompute_bound
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import write_summary
from nfv_torchrl.methods import PlannerMethod, RandomMethod
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.scenario import paper_scenario

SEEDS = [3, 1, 2]
Tampering = Callable[[Path], object]


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory) -> Path:
    """Two methods, three seeds, two bounds, failures and a warm-up, on a network with too little room."""
    folder = tmp_path_factory.mktemp("evaluation") / "out"
    scenario = paper_scenario(
        5, 0, horizon=16, warmup=2, arrival_rate=20, mean_lifetime=60, max_steps=12,
        substrate={"vms_max": 1, "vm_capacity": (160.0, 200.0)},
        failures={"p_fail_vm": 0.03, "p_fail_link": 0.03, "p_repair": 0.3},
    )  # fmt: skip
    comparison = Comparison(scenario)
    for method in (RandomMethod(), PlannerMethod(MyopicPlanner(), name="myopic_optimal")):
        for record in run_method(scenario, method, SEEDS):
            write_run(folder / method.name / f"seed_{record.workload_seed}", record, comparison.add(record))
    for seed in SEEDS:
        given = scenario, scenario.workload(seed), scenario.failure_timeline(seed)
        comparison.add_bound("hindsight", seed, hindsight_bound(*given).aar)
        comparison.add_bound("blind", seed, blind_bound(*given).aar)
    write_summary(folder, comparison, "random")
    return folder


def problems(folder: Path, bounds: bool = False) -> list[str]:
    reports = audit_folders([folder], recompute_bound=recompute_bound if bounds else None)
    return [f"{report.folder.relative_to(folder)}: {text}" for report in reports for text in report.problems]


def test_the_evaluation_as_it_was_written_is_clean(evaluation):
    assert problems(evaluation, bounds=True) == []
    with (evaluation / "summary.csv").open() as file:
        kinds = {row["metric"] for row in csv.DictReader(file)}
    assert kinds >= {"aar", "aar_difference", "aar_relative_difference", "paired_cost", "gap_closed", "aar_bound"}
    reasons = {decision["reason"] for decision in read_decisions(evaluation / "random" / "seed_3")}
    assert len(reasons) > 3


# ---------------------------------------------------------------- ways to tamper


def refresh(folder: Path) -> None:
    """The checksums of what is there now."""
    path = folder / "evaluation.json"
    if path.is_file():
        document = json.loads(path.read_text())
        for name in document["files"]:
            if (folder / name).is_file():
                document["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        path.write_text(json.dumps(document))


def of_json(name: str, change: Callable[[dict], object]) -> Tampering:
    def tamper(folder: Path) -> None:
        document = json.loads((folder / name).read_text())
        change(document)
        (folder / name).write_text(json.dumps(document))

    return tamper


def of_all(name: str, change: Callable[[dict], object]) -> Tampering:
    """In every run alike."""

    def tamper(folder: Path) -> None:
        for run in (path for path in folder.glob("*/seed_*") if path.is_dir()):
            of_json(name, change)(run)

    return tamper


def of_lines(name: str, change: Callable[[list[str]], object]) -> Tampering:
    def tamper(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        change(lines)
        (folder / name).write_text("\n".join(lines) + "\n")

    return tamper


def of_row(name: str, which: str, column: int, value: str | Callable[[str], str]) -> Tampering:
    """One cell of the row that begins with ``which``."""

    def change(lines: list[str]) -> None:
        row = next(k for k, line in enumerate(lines) if line.startswith(which))
        cells = lines[row].split(",")
        cells[column] = value(cells[column]) if callable(value) else value
        lines[row] = ",".join(cells)

    return of_lines(name, change)


def scaled(factor: float) -> Callable[[str], str]:
    return lambda text: repr(float(text) * factor)


def without_row(name: str, which: str) -> Tampering:
    return of_lines(name, lambda lines: lines.remove(next(line for line in lines if line.startswith(which))))


def without_column(name: str) -> Tampering:
    return of_lines(name, lambda lines: lines.__setitem__(slice(None), [line.rpartition(",")[0] for line in lines]))


def swap_rows(lines: list[str]) -> None:
    lines[2], lines[3] = lines[3], lines[2]


def of_rejections(change: Callable[[list[dict]], object], run: str = "random/seed_3") -> Tampering:
    def tamper(folder: Path) -> None:
        decisions = read_decisions(folder / run)
        change(decisions)
        write_decisions(folder / run, decisions)

    return tamper


def swap_reasons(decisions: list[dict]) -> None:
    """The counts of reasons stay: no metric shows it."""
    first = next(d for d in decisions if d["reason"] == "vm_capacity")
    other = next(d for d in decisions if d["reason"] not in (None, "vm_capacity"))
    first["reason"], other["reason"] = other["reason"], first["reason"]


def shorten_tried(decisions: list[dict]) -> None:
    next(d for d in decisions if d["reason"] and len(d["tried"]) > 1)["tried"].pop()


def replace_with(name: str, make: Callable[[Path], object]) -> Tampering:
    def tamper(folder: Path) -> None:
        (folder / name).unlink()
        make(folder / name)

    return tamper


def linked(folder: Path) -> None:
    target = folder.parent / "elsewhere"
    shutil.move(folder / DECISIONS, target)
    (folder / DECISIONS).symlink_to(target)


def with_line(text: str | bytes) -> Tampering:
    def tamper(folder: Path) -> None:
        lines = (folder / DECISIONS).read_bytes().splitlines(keepends=True)
        lines[1] = (text if isinstance(text, bytes) else text.encode()) + b"\n"
        (folder / DECISIONS).write_bytes(b"".join(lines))

    return tamper


def faster(folder: Path) -> None:
    """Half the wall time in the run's own file, both numbers alike."""
    of_json(METRICS, lambda d: d.update(
        decision_seconds=d["decision_seconds"] / 2, decisions_per_second=d["decisions_per_second"] * 2
    ))(folder)  # fmt: skip


def rename_run(folder: Path) -> None:
    (folder / "random" / "seed_3").rename(folder / "random" / "seed_4")


def swap_runs(folder: Path) -> None:
    for old, new in (("seed_3", "x"), ("seed_1", "seed_3"), ("x", "seed_1")):
        (folder / "random" / old).rename(folder / "random" / new)


DECISIONS, METRICS = "random/seed_3/decisions.jsonl", "random/seed_3/metrics.json"
SCENARIO, SUBSTRATE = "random/seed_3/scenario.json", "random/seed_3/substrate.json"
WORKLOAD = "random/seed_3/workload.csv"

NOTICED: dict[str, tuple[Tampering, str]] = {
    # summary.csv
    "mean": (of_row("summary.csv", "random,aar,", 2, scaled(1.001)), r"summary.csv: mean of random, aar is"),
    "mean emptied": (of_row("summary.csv", "random,aar,", 2, ""), "summary.csv: mean of random, aar is empty"),
    "mean no number": (of_row("summary.csv", "random,aar,", 2, "much"), "mean of random, aar is much"),
    "mean nan": (of_row("summary.csv", "random,aar,", 2, "nan"), "mean of random, aar is nan"),
    "interval narrowed": (of_row("summary.csv", "random,aar,", 3, scaled(1.01)), "ci_low of random, aar"),
    "interval widened": (of_row("summary.csv", "random,anuc,", 4, scaled(1.01)), "ci_high of random, anuc"),
    "interval removed": (of_row("summary.csv", "random,aar,", 3, ""), "ci_low of random, aar is empty"),
    "n": (of_row("summary.csv", "random,aar,", 5, "30"), "n of random, aar is 30, it should be 3"),
    "paired difference": (of_row("summary.csv", "myopic_optimal,aar_difference", 2, scaled(1.01)),
                          "mean of myopic_optimal, aar_difference, random"),
    "its interval": (of_row("summary.csv", "myopic_optimal,aar_difference", 3, scaled(0.9)),
                     "ci_low of myopic_optimal, aar_difference"),
    "relative difference": (of_row("summary.csv", "myopic_optimal,aar_relative", 4, scaled(1.01)),
                            "ci_high of myopic_optimal, aar_relative_difference"),
    "paired cost": (of_row("summary.csv", "myopic_optimal,paired_cost", 2, scaled(0.99)),
                    "mean of myopic_optimal, paired_cost"),
    "paired cost's interval": (of_row("summary.csv", "myopic_optimal,paired_cost", 3, scaled(0.99)),
                               "ci_low of myopic_optimal, paired_cost"),
    "reference": (of_row("summary.csv", "myopic_optimal,paired_cost", 6, "tabu"), "paired_cost, random is missing"),
    "gap closed": (of_row("summary.csv", "random,gap_closed", 2, scaled(0.5)), "mean of random, gap_closed"),
    "bound's mean": (of_row("summary.csv", "hindsight,aar_bound", 2, scaled(1.01)), "mean of hindsight, aar_bound"),
    "bound's interval": (of_row("summary.csv", "blind,aar_bound", 4, scaled(1.01)), "ci_high of blind, aar_bound"),
    "scenario's name": (of_row("summary.csv", "random,aar,", 7, "heavy"), "scenario of random, aar is heavy"),
    "colocation": (of_row("summary.csv", "random,aar,", 8, "1"), "colocation of random, aar is 1"),
    "lifetimes": (of_row("summary.csv", "random,aar,", 9, "1"), "observe_lifetime of random, aar is 1"),
    "method renamed": (of_row("summary.csv", "random,aar,", 0, "tabu"), "the row tabu, aar belongs to nothing"),
    "speed's mean": (of_row("summary.csv", "random,decisions_per_second", 2, scaled(2)), "decisions_per_second is"),
    "summary's row removed": (without_row("summary.csv", "random,mean_hops"), "the row random, mean_hops is missing"),
    "summary's row doubled": (of_lines("summary.csv", lambda x: x.append(x[3])), "a row with the same name"),
    "summary's row added": (of_lines("summary.csv", lambda x: x.append("a,joy,1,1,1,1,,paper,0,0")), "row a, joy bel"),
    "summary's rows swapped": (of_lines("summary.csv", swap_rows), "summary.csv: the rows are not in the order"),
    "summary's column removed": (without_column("summary.csv"), "summary.csv: the header is not"),
    "summary's header": (of_lines("summary.csv", lambda x: x.pop(0)), "summary.csv: the header is not"),
    "summary emptied": (lambda f: (f / "summary.csv").write_text(""), "summary.csv: the header is not"),
    "summary cut": (lambda f: (f / "summary.csv").write_text((f / "summary.csv").read_text()[:-9]), "not ended"),
    "summary removed": (lambda f: (f / "summary.csv").unlink(), "summary.csv: the file is missing"),
    # per_seed.csv
    "value": (of_row("per_seed.csv", "random,3,aar,", 3, scaled(1.001)), "value of random, 3, aar"),
    "rho of a row": (of_row("per_seed.csv", "random,3,aar,", 5, scaled(1.1)), "rho of random, 3, aar"),
    "scenario seed of a row": (of_row("per_seed.csv", "random,3,aar,", 4, "7"), "scenario_seed of random, 3, aar is 7"),
    "seed of a row": (of_row("per_seed.csv", "random,3,aar,", 1, "7"), "the row random, 7, aar belongs to nothing"),
    "speed of a row": (of_row("per_seed.csv", "random,3,decisions_per_second", 3, scaled(2)), "s_per_second is"),
    "time of a row": (of_row("per_seed.csv", "random,3,decision_seconds", 3, scaled(2)), "decision_seconds is"),
    "bound above": (of_row("per_seed.csv", "blind,3,aar_bound", 3, scaled(1.001)), "aar_bound of blind, seed 3 is"),
    "bound below": (of_row("per_seed.csv", "hindsight,3,aar_bound", 3, "0.01"), "is 0.01, a method reached"),
    "bound of a seed removed": (without_row("per_seed.csv", "hindsight,3,aar_bound"), "hindsight, 3, aar_bound is mis"),
    "row removed": (without_row("per_seed.csv", "random,3,anuc"), "per_seed.csv: the row random, 3, anuc is missing"),
    "rows swapped": (of_lines("per_seed.csv", swap_rows), "per_seed.csv: the rows are not in the order"),
    "column removed": (without_column("per_seed.csv"), "per_seed.csv: the header is not"),
    "per_seed.csv removed": (lambda f: (f / "per_seed.csv").unlink(), "per_seed.csv: the file is missing"),
    # evaluation.json
    "evaluation.json removed": (lambda f: (f / "evaluation.json").unlink(), "evaluation.json: No such file"),
    "method left out": (of_json("evaluation.json", lambda d: d["methods"].remove("random")), "reference make no sense"),
    "seed left out": (of_json("evaluation.json", lambda d: d["seeds"].pop()), "seeds, bounds or reference make no"),
    "bound left out": (of_json("evaluation.json", lambda d: d["bounds"].pop("blind")), "blind, aar_bound belongs to n"),
    "reference moved": (of_json("evaluation.json", lambda d: d.update(reference="myopic_optimal")), "is missing"),
    "file left out": (of_json("evaluation.json", lambda d: d["files"].pop(METRICS)), "metrics.json is missing under"),
    "runs and tables removed": (lambda f: [shutil.rmtree(f / m) for m in ("random", "myopic_optimal")],
                                "random/seed_3: the run is missing"),
    # runs
    "run removed": (lambda f: shutil.rmtree(f / "random" / "seed_3"), "random/seed_3: the run is missing"),
    "run added": (lambda f: shutil.copytree(f / "random" / "seed_3", f / "random" / "seed_9"), "seed_9: the run belo"),
    "run renamed": (rename_run, "random/seed_4: the run belongs to no method"),
    "runs exchanged": (swap_runs, r"random/seed_3/scenario.json: method and workload seed are \('random', 1\)"),
    "file added": (lambda f: (f / "random" / "seed_3" / "notes.txt").write_text("x"), "notes.txt is no file of a run"),
    "file removed": (lambda f: (f / METRICS).unlink(), "metrics.json: No such file"),
    "method's name": (of_json(SCENARIO, lambda d: d.update(method="tabu")), r"workload seed are \('tabu', 3\)"),
    "workload seed": (of_json(SCENARIO, lambda d: d["seeds"].update(workload=5)), r"seed are \('random', 5\)"),
    "scenario seed": (of_json(SCENARIO, lambda d: d["seeds"].update(scenario=5)), "scenario.json differs from that of"),
    "mask": (of_json(SCENARIO, lambda d: d.update(mask="feasible")), "what it tried gives invalid_action"),
    "mask of all": (of_all("scenario.json", lambda d: d.update(mask="feasible")), "what it tried gives invalid_action"),
    "name of one": (of_json(SCENARIO, lambda d: d.update(name="heavy")), "scenario.json differs from that of"),
    "name of all": (of_all("scenario.json", lambda d: d.update(name="heavy")), "scenario of random, aar is paper"),
    "arrival rate of all": (of_all("scenario.json", lambda d: d.update(arrival_rate=5.0)), "metrics.json: rho is"),
    "lifetime of all": (of_all("scenario.json", lambda d: d.update(mean_lifetime=11.0)), "metrics.json: rho is"),
    "horizon of all": (of_all("scenario.json", lambda d: d.update(horizon=17)), "metrics.json: "),
    "warm-up of all": (of_all("scenario.json", lambda d: d.update(warmup=3)), "metrics.json: arrived is"),
    "steps of all": (of_all("scenario.json", lambda d: d.update(max_steps=99)), "what it tried|passes every check"),
    "admission control": (of_all("scenario.json", lambda d: d.update(admission_control=False)), "gives invalid_action"),
    "lifetimes seen by all": (of_all("scenario.json", lambda d: d.update(observe_lifetime=True)),
                              "observe_lifetime of random, aar is 0"),
    "tolerable delay": (of_all("scenario.json", lambda d: d["services"][0].update(tolerable_delay=1)), "are tolerable"),
    "huge horizon": (of_json(SCENARIO, lambda d: d.update(horizon=10**12)), "horizon, warmup or max_steps"),
    "reasons exchanged": (of_rejections(swap_reasons), "rejected for .*, what it tried gives"),
    "tried shortened": (of_rejections(shorten_tried), "tried passes every check"),
    "tried removed": (of_rejections(lambda d: [x.pop("tried") for x in d]), r"unknown keys \['tried'\]"),
    "tried emptied": (of_rejections(lambda d: [x.update(tried=[]) for x in d if x["reason"]]), "not the steps up to"),
    "slot a float": (of_rejections(lambda d: d[0].update(slot=float(d[0]["slot"]))), "line 1 .*is not the request"),
    "speed": (of_json(METRICS, lambda d: d.update(decisions_per_second=1e6)), "does not fit decision_seconds"),
    "speed, consistently": (faster, "decision_seconds of|value of random, 3, decision_seconds is"),
    "metrics reordered": (of_json(METRICS, lambda d: d.update(rho=d.pop("rho"))), "rows are not in the order"),
    "VM's price": (of_json(SUBSTRATE, lambda d: d["nodes"][0]["vms"][0].update(unit_cost=1.0)), "substrate.json diff"),
    "lifetime": (of_lines(WORKLOAD, lambda x: x.__setitem__(1, x[1] + "1")), "workload.csv differs from that of"),
    # files that are none
    "nested deeply": (with_line("[" * 200_000), "decisions.jsonl line 2: brackets are nested too deeply"),
    "nested metrics": (lambda f: (f / METRICS).write_text('{"a":' * 200_000), "metrics.json: brackets are nested"),
    "NaN": (with_line('{"slot": NaN}'), "decisions.jsonl line 2: NaN is not a JSON number"),
    "huge integer": (with_line('{"slot": 1' + "0" * 9000 + "}"), "decisions.jsonl line 2: .* too large an integer"),
    "huge number": (with_line('{"slot": 1e999}'), "decisions.jsonl line 2: 1e999 is too large a number"),
    "binary": (with_line(bytes(range(128, 256))), "decisions.jsonl line 2: 'utf-8' codec"),
    "zeros": (lambda f: (f / WORKLOAD).write_bytes(b"\0" * 99 + b"\n"), "workload.csv: the header|line contains"),
    "not ended": (lambda f: (f / DECISIONS).write_text((f / DECISIONS).read_text().rstrip()), "the line is not ended"),
    "a link": (linked, "decisions.jsonl: is a link"),
    "a folder": (replace_with(METRICS, Path.mkdir), "metrics.json: is a link, a folder or a device"),
    "a pipe": (replace_with(METRICS, os.mkfifo), "metrics.json: is a link, a folder or a device"),
    "a device": (replace_with(METRICS, lambda p: p.symlink_to("/dev/zero")), "metrics.json: is a link, a folder"),
}  # fmt: skip

CHECKSUMS: dict[str, tuple[Tampering, str]] = {
    "probabilities of failures": (
        of_all("scenario.json", lambda d: d["failures"].update(p_repair=0.5)), "scenario.json: is not as it was written"
    ),
    "weights that cancel out": (
        of_all("scenario.json", lambda d: [s.update(weight=s["weight"] * 2) for s in d["services"]]), "not as it was wr"
    ),
    "spelling of numbers": (of_row("summary.csv", "random,aar,", 5, "3 "), "summary.csv: is not as it was written"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NOTICED)
def test_every_tampering_is_noticed_and_named(evaluation, tmp_path, kind):
    folder = tmp_path / "out"
    shutil.copytree(evaluation, folder)
    tamper, expected = NOTICED[kind]
    tamper(folder)
    refresh(folder)
    found = problems(folder, bounds=kind == "bound above")
    assert any(re.search(expected, text) for text in found), "\n".join(found)


@pytest.mark.parametrize("kind", CHECKSUMS)
def test_what_no_number_contradicts_is_seen_by_its_checksum(evaluation, tmp_path, kind):
    folder = tmp_path / "out"
    shutil.copytree(evaluation, folder)
    tamper, expected = CHECKSUMS[kind]
    tamper(folder)
    found = problems(folder)
    assert found and all("is not as it was written" in text or "summary.csv" in text for text in found)
    assert any(re.search(expected, text) for text in found), "\n".join(found)


def test_a_broken_run_does_not_end_the_audit_of_the_others(evaluation, tmp_path):
    folder = tmp_path / "out"
    shutil.copytree(evaluation, folder)
    NOTICED["nested deeply"][0](folder)
    reports = {report.folder.relative_to(folder).as_posix(): report for report in audit_folders([folder])}
    assert len(reports) == 7  # six runs, and the evaluation that lacks one
    assert not reports["random/seed_3"].clean
    assert all(reports[f"{m}/seed_{s}"].clean for m in ("random", "myopic_optimal") for s in (1, 2))
