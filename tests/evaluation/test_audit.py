"""The audit finds nothing in correct runs, and each kind of tampering in the others."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import toy
from handmade import first_fit, read_decisions, write_decisions
from hypothesis import given, settings
from hypothesis import strategies as st
from toy import DUO, SOLO

from nfv_torchrl.errors import AuditError
from nfv_torchrl.evaluation.audit import audit_folders, audit_run, find_runs
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import RunRecord, write_run
from nfv_torchrl.scenario.failures import FailureTimeline

REFUSED = 6  # row of the request that the policy refuses: line 7
WORKLOAD = toy.workload_of(
    (0, DUO, 0, 3, 1.5),
    (0, DUO, 0, 3, 6.5),
    (0, DUO, 1, 3, 6.0),
    (1, SOLO, 3, 0, 9.0),
    (1, DUO, 1, 3, 1.0),
    (2, DUO, 0, 3, 4.0),
    (3, SOLO, 2, 0, 1.0),
    (4, DUO, 0, 3, 2.5),
    (6, SOLO, 3, 0, 1.0),
)
# VM 1.1 is down in slots 2 and 3, link 1-2 in 4 and 5: the one interrupts lines 2, 3 and 4, the other line 6.
TIMELINE = toy.timeline_of(
    (2, toy.vm_resource(1, 1), False),
    (4, toy.vm_resource(1, 1), True),
    (4, toy.link_resource(2), False),
    (6, toy.link_resource(2), True),
)


def write(folder: Path, record: RunRecord) -> Path:
    return write_run(folder, record, compute_metrics(record))


def busy_run(folder: Path, **changes) -> Path:
    settings = {"horizon": 8, "admission_control": True, "warmup": 1}
    scenario = toy.toy_scenario(**(settings | changes))
    return write(folder, first_fit(scenario, WORKLOAD, TIMELINE, refuse=frozenset({REFUSED})))


def edit_json(folder: Path, name: str, change: Callable[[dict], object]) -> None:
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))


# ---------------------------------------------------------------- clean runs


@pytest.mark.parametrize("colocation", [False, True])
def test_correct_run_with_failures_is_clean(tmp_path, colocation):
    folder = busy_run(tmp_path / "run", colocation=colocation)
    report = audit_run(folder)
    assert report.problems == []
    assert (report.clean, report.requests) == (True, 9)
    report.raise_if_problems()
    assert sum(decision["interrupted_at"] is not None for decision in read_decisions(folder)) >= 3


def test_a_run_with_the_older_header_is_clean(tmp_path):
    folder = write(tmp_path / "run", first_fit(toy.toy_scenario(), toy.toy_workload()))
    text = (folder / "workload.csv").read_text()
    (folder / "workload.csv").write_text(text.replace("_index", "", 2))
    assert audit_run(folder).problems == []


def test_run_without_requests_is_clean(tmp_path):
    workload = toy.toy_workload()
    nothing = type(workload)(*(column[:0] for column in vars(workload).values() if column is not None))
    assert audit_run(write(tmp_path / "run", first_fit(workload=nothing))).problems == []


def test_workload_file_gives_rho(tmp_path):
    path = tmp_path / "requests.csv"
    toy.toy_workload().to_csv(path, toy.toy_catalogue())
    record = first_fit(toy.toy_scenario(workload_path=str(path)))
    assert audit_run(write(tmp_path / "run", record)).problems == []
    assert compute_metrics(record)["rho"] != compute_metrics(first_fit())["rho"]


requests = st.tuples(
    st.integers(0, 5), st.sampled_from([DUO, SOLO]), st.integers(0, 3), st.integers(1, 3), st.floats(0.1, 5)
)
events = st.lists(st.tuples(st.integers(0, 5), st.sampled_from([0, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12])), max_size=6)


def timeline_from(draws: list[tuple[int, int]]) -> FailureTimeline:
    """Each draw turns the state of its resource over; repairs of a slot come first."""
    rows, down = [], set()
    for slot in range(6):
        turned = {resource for at, resource in draws if at == slot}
        rows += [(slot, resource, True) for resource in sorted(turned & down)]
        rows += [(slot, resource, False) for resource in sorted(turned - down)]
        down ^= turned
    return toy.timeline_of(*rows) if rows else FailureTimeline.empty()


@given(
    drawn=st.lists(requests, min_size=1, max_size=12),
    draws=events,
    colocation=st.booleans(),
    warmup=st.integers(0, 3),
    factor=st.sampled_from([0.999999, 1.000001]),
)
@settings(max_examples=25)
def test_random_runs_are_clean_until_a_number_is_touched(tmp_path_factory, drawn, draws, colocation, warmup, factor):
    drawn = [(slot, kind, ingress, (ingress + step) % 4, life) for slot, kind, ingress, step, life in sorted(drawn)]
    scenario = toy.toy_scenario(colocation=colocation, warmup=warmup, catalogue=toy.toy_catalogue(2000, 2000))
    record = first_fit(scenario, toy.workload_of(*drawn), timeline_from(draws))
    folder = write(tmp_path_factory.mktemp("random") / "run", record)
    assert audit_run(folder).problems == []

    stated = json.loads((folder / "metrics.json").read_text())
    for key, value in stated.items():
        if value:
            (folder / "metrics.json").write_text(json.dumps(stated | {key: value * factor}))
            assert any(key in problem for problem in audit_run(folder).problems)


# ---------------------------------------------------------------- tampered decisions


def set_field(line: int, key: str, value: object) -> Callable[[list[dict]], None]:
    return lambda decisions: decisions[line - 1].update({key: value})


def set_step(line: int, number: int, *step: object) -> Callable[[list[dict]], None]:
    return lambda decisions: decisions[line - 1]["steps"].__setitem__(number - 1, list(step))


def add_step(line: int, number: int, *step: object) -> Callable[[list[dict]], None]:
    return lambda decisions: decisions[line - 1]["steps"].insert(number - 1, list(step))


def drop_step(line: int, number: int) -> Callable[[list[dict]], None]:
    return lambda decisions: decisions[line - 1]["steps"].pop(number - 1)


def swap_functions(decisions: list[dict]) -> None:
    decisions[0]["steps"][0][2], decisions[0]["steps"][2][2] = 1, 0


# Lines 1 and 2 read [1, 0, 0], [0, 0, null], [1, 1, 1], [2, 0, null], [3, 0, null]; line 5 is solo, 3 to 0:
# [1, 1, 0], [0, 0, null]; line 7 is refused; line 8 reads [1, 0, 0], [3, 1, 1].
TAMPERED = {
    "hop over no link": (set_step(1, 1, 3, 0, 0), r"line 1 .*step 1: there is no link between 0 and 3"),
    "cost a little lower": (set_field(1, "cost", 119 * (1 - 1e-8)), r"line 1 .*the cost is 118\.9.*the steps cost 119"),
    "delay a little lower": (set_field(2, "delay_ms", 964.99999), r"line 2 .*the delay is 964\.9.*take 965"),
    "cost not a number": (set_field(1, "cost", float("nan")), r"line 1: NaN is not a JSON number"),
    "cost infinite": (set_field(1, "cost", float("inf")), r"line 1: Infinity is not a JSON number"),
    "cost missing": (set_field(1, "cost", None), r"line 1 .*the cost is None"),
    "cost true": (set_field(1, "cost", True), r"line 1 .*the cost is True"),
    "functions swapped": (swap_functions, r"line 1 .*step 1: places function 1, but function 0 is next"),
    "function skipped": (set_step(1, 3, 1, 1, None), r"line 1 .*1 of 2 functions are placed"),
    "function placed twice": (set_step(1, 4, 2, 0, 1), r"line 1 .*step 4: places function 1, but all functions are"),
    "function unknown": (set_step(1, 3, 1, 1, 7), r"line 1 .*step 3: places function 7, but function 1 is next"),
    "request twice": (lambda d: d.insert(3, d[2]), r"answers 10 requests, workload.csv has 9"),
    "request twice, where": (lambda d: d.insert(3, d[2]), r"line 4: not the request of workload.csv line 5"),
    "request dropped": (lambda d: d.pop(4), r"line 5: not the request of workload.csv line 6"),
    "last request dropped": (lambda d: d.pop(), r"line 9: missing"),
    "two requests swapped": (lambda d: d.insert(0, d.pop(2)), r"line 1 .*is not the request of workload.csv line 2"),
    "lifetime changed": (set_field(1, "lifetime", 1.4), r"line 1 .*1\.4.* is not the request of workload.csv line 2"),
    "egress changed": (set_field(1, "egress", 2), r"line 1 .*is not the request of workload.csv line 2"),
    "accepted with a reason": (set_field(1, "reason", "delay"), r"line 1 .*accepted, yet with the reason 'delay'"),
    "rejected, steps kept": (set_field(1, "accepted", False), r"line 1 .*rejected, yet has steps"),
    "rejected, cost kept": (set_field(REFUSED + 1, "cost", 1.0), r"line 7 .*rejected, yet cost is 1\.0"),
    "rejected without a reason": (set_field(REFUSED + 1, "reason", None), r"line 7 .*unknown reason None"),
    "reason unknown": (set_field(REFUSED + 1, "reason", "bad luck"), r"line 7 .*unknown reason 'bad luck'"),
    "accepted 1": (set_field(1, "accepted", 1), r"line 1 .*accepted is neither true nor false"),
    "rejection made an acceptance": (set_field(REFUSED + 1, "accepted", True), r"line 7 .*walk ends on node 2"),
    "VM unknown": (set_step(1, 1, 1, 2, 0), r"line 1 .*step 1: node 1 has no VM 2"),
    "node unknown": (set_step(1, 1, 4, 0, 0), r"line 1 .*step 1: node 4 has no VM 0"),
    "node negative": (set_step(1, 1, -3, 0, 0), r"line 1 .*step 1: node -3 has no VM 0"),
    "through the egress": (set_step(1, 2, 3, 0, None), r"line 1 .*step 3: leaves the egress 3"),
    "stays without colocation": (add_step(8, 2, 1, 1, 1), r"line 8 .*step 2: places again on node 1, but colocation"),
    "stays and forwards": (add_step(1, 2, 1, 0, None), r"line 1 .*step 2: stays on node 1 and places nothing"),
    "step after the end": (add_step(1, 6, 3, 1, None), r"line 1 .*step 6: comes after the walk has ended"),
    "egress not reached": (drop_step(1, 5), r"line 1 .*ends on node 2, not on the egress 3"),
    "no steps": (set_field(1, "steps", []), r"line 1 .*ends on node 0, not on the egress 3"),
    "steps null": (set_field(1, "steps", None), r"line 1 .*steps is not a list"),
    "step malformed": (set_step(1, 1, 1, 0), r"line 1 .*step 1: \[1, 0\] is not \[node, vm, function or null\]"),
    "interruption missing": (set_field(2, "interrupted_at", None), r"line 2: interrupted_at is None, .* is 2"),
    "interruption late": (set_field(3, "interrupted_at", 3), r"line 3: interrupted_at is 3, .* is 2"),
    "interruption made up": (set_field(8, "interrupted_at", 5), r"line 8: interrupted_at is 5, .* is None"),
    "failed VM used": (set_step(6, 1, 1, 1, 0), r"line 6 .*step 1: uses VM 1 of node 1, which has failed"),
    "failed link used": (
        set_field(8, "steps", [[1, 0, 0], [2, 0, 1], [3, 0, None]]),
        r"line 8 .*step 2: uses link 1-2, which has failed",
    ),
    "key missing": (lambda d: d[0].pop("delay_ms"), r"line 1 .*missing or unknown keys \['delay_ms'\]"),
    "key added": (set_field(1, "note", "hello"), r"line 1 .*missing or unknown keys \['note'\]"),
    "line no object": (lambda d: d.__setitem__(0, []), r"line 1: not a JSON object"),
}  # fmt: skip


@pytest.mark.parametrize("kind", TAMPERED)
def test_tampered_decisions_are_caught(tmp_path, kind):
    folder = busy_run(tmp_path / "run")
    change, expected = TAMPERED[kind]
    decisions = read_decisions(folder)
    change(decisions)
    write_decisions(folder, decisions)
    report = audit_run(folder)
    assert any(re.search(expected, problem) for problem in report.problems), report.problems
    with pytest.raises(AuditError, match="audit found"):
        report.raise_if_problems()


junk = st.none() | st.integers(-9, 9) | st.floats(-9, 9) | st.text(max_size=3) | st.just([]) | st.just({"a": 1})


@pytest.fixture(scope="module")
def kept_run(tmp_path_factory) -> Path:
    return busy_run(tmp_path_factory.mktemp("kept") / "run")


@given(line=st.integers(0, 8), data=st.data(), value=junk)
def test_no_field_can_be_changed(kept_run, line, data, value):
    decisions = original = read_decisions(kept_run)
    decision = decisions[line]
    key = data.draw(st.sampled_from(sorted(decision)))
    if decision[key] == value or isinstance(value, bool):
        return
    try:
        write_decisions(kept_run, [*decisions[:line], decision | {key: value}, *decisions[line + 1 :]])
        assert any(f"line {line + 1}" in problem for problem in audit_run(kept_run).problems)
    finally:
        write_decisions(kept_run, original)


def test_a_function_beyond_the_chain_is_found(kept_run):
    original, decisions = read_decisions(kept_run), read_decisions(kept_run)
    steps = decisions[0]["steps"]
    placed = [step[2] for step in steps if step[2] is not None]
    last_place = max(place for place, step in enumerate(steps) if step[2] is not None)
    steps[last_place + 1][2] = len(placed)  # a forwarding step claims the function after the last
    try:
        write_decisions(kept_run, decisions)
        assert any("all functions are placed" in problem for problem in audit_run(kept_run).problems)
    finally:
        write_decisions(kept_run, original)


@given(line=st.integers(0, 8), data=st.data(), value=junk)
def test_no_step_can_be_changed(kept_run, line, data, value):
    original = read_decisions(kept_run)
    decisions = read_decisions(kept_run)
    if line == REFUSED:
        return
    step = data.draw(st.sampled_from(decisions[line]["steps"]))
    place = data.draw(st.integers(0, 2))
    forwards_by_another_vm = place == 1 and step[2] is None and value in (0, 1)
    if step[place] == value or forwards_by_another_vm:
        return
    step[place] = value
    try:
        write_decisions(kept_run, decisions)
        assert any(f"line {line + 1}" in problem for problem in audit_run(kept_run).problems)
    finally:
        write_decisions(kept_run, original)


@given(name=st.sampled_from(["scenario.json", "substrate.json", "metrics.json"]), data=st.data(), value=junk)
def test_junk_in_other_files_never_crashes(kept_run, name, data, value):
    original = (kept_run / name).read_text()
    document = here = json.loads(original)
    while True:
        place = data.draw(st.sampled_from(sorted(here) if isinstance(here, dict) else range(len(here))))
        if not isinstance(here[place], dict | list) or not here[place] or data.draw(st.booleans()):
            break
        here = here[place]
    here[place] = value
    try:
        (kept_run / name).write_text(json.dumps(document))
        audit_run(kept_run)
    finally:
        (kept_run / name).write_text(original)


def test_broken_and_doubled_json(tmp_path):
    folder = busy_run(tmp_path / "run")
    lines = (folder / "decisions.jsonl").read_text().splitlines(keepends=True)
    lines[2] = lines[2][:40] + "\n"
    lines[3] = lines[3].replace('"slot": 1', '"slot": 1, "slot": 1')
    (folder / "decisions.jsonl").write_text("".join(lines))
    problems = " ".join(audit_run(folder).problems)
    assert "line 3: " in problems and "line 4: a key is there twice" in problems


# ---------------------------------------------------------------- capacities, exactly

A_AT_1 = [(1, 0, 0), (2, 0, None), (3, 1, 1)]  # duo, 0 to 3: 10 of the 40 Mcycles/s of VM 1.0, 20 of the 80 of VM 3.1
ROOMY = toy.toy_catalogue(10_000, 10_000)


def forced(folder: Path, workload, walks: dict, **changes) -> list[str]:
    return audit_run(
        write(folder, first_fit(toy.toy_scenario(catalogue=ROOMY, **changes), workload, walks=walks))
    ).problems


def test_a_full_vm_is_fine_and_one_more_is_not(tmp_path):
    four, five = (toy.workload_of(*[(0, DUO, 0, 3, 2.0)] * count) for count in (4, 5))
    assert forced(tmp_path / "four", four, dict.fromkeys(range(4), A_AT_1)) == []
    problems = forced(tmp_path / "five", five, dict.fromkeys(range(5), A_AT_1))
    assert problems[0].startswith("decisions.jsonl line 5 (slot 0) step 1: exceeds the capacity of VM 0 of node 1")
    assert "needs 10, 0 is left" in problems[0]


@pytest.mark.parametrize(("lifetime", "fine"), [(2.0, True), (2.0000001, False)])
def test_who_leaves_in_a_slot_makes_room_for_who_comes_in_it(tmp_path, lifetime, fine):
    workload = toy.workload_of(*[(0, DUO, 0, 3, lifetime)] * 4, (2, DUO, 0, 3, 1.0))
    problems = forced(tmp_path / "run", workload, dict.fromkeys(range(5), A_AT_1))
    assert (problems == []) == fine
    assert fine or "line 5 (slot 2) step 1: exceeds" in problems[0]


def test_a_unit_too_much_is_too_much(tmp_path):
    workload = toy.workload_of(*[(0, DUO, 0, 3, 2.0)] * 4)
    folder = write(tmp_path / "run", first_fit(toy.toy_scenario(), workload, walks=dict.fromkeys(range(4), A_AT_1)))
    assert audit_run(folder).problems == []
    edit_json(folder, "substrate.json", lambda d: d["nodes"][1]["vms"][0].update(capacity=39.999999))
    assert any(
        "line 4 (slot 0) step 1: exceeds the capacity of VM 0 of node 1" in p for p in audit_run(folder).problems
    )


def test_a_walk_competes_with_itself(tmp_path):
    # Solo needs 2 Mbit/s; link 1-3 has 4, enough for two passes and not for three.
    solo = toy.workload_of((0, SOLO, 2, 3, 1.0))
    there = [(1, 1, 0), (2, 0, None), (1, 0, None), (2, 0, None), (1, 0, None), (3, 0, None)]
    assert forced(tmp_path / "five", solo, {0: there}) == []
    around = toy.workload_of((0, SOLO, 0, 2, 1.0))
    back = [(1, 1, 0), (3, 0, None), (1, 0, None), (3, 0, None), (2, 0, None)]
    problems = forced(tmp_path / "three", around, {0: back})
    assert problems == ["decisions.jsonl line 1 (slot 0) step 4: exceeds the capacity of link 1-3: needs 2, 0 is left"]


def test_too_many_steps(tmp_path):
    walks = {0: [(1, 0, 0), (2, 0, None), (3, 1, 1)]}
    workload = toy.workload_of((0, DUO, 0, 3, 1.0))
    assert forced(tmp_path / "three", workload, walks, max_steps=3) == []
    assert "3 steps, 2 are allowed" in forced(tmp_path / "two", workload, walks, max_steps=2)[0]


def test_delay_beyond_what_is_tolerable(tmp_path):
    scenario = toy.toy_scenario(catalogue=toy.toy_catalogue(duo_delay=700))
    record = first_fit(scenario, toy.workload_of((0, DUO, 0, 3, 1.0)), walks={0: A_AT_1})
    (problem,) = audit_run(write(tmp_path / "run", record)).problems
    assert "line 1" in problem and "take 795.0 ms, 700 ms are tolerable" in problem


def test_departing_too_early(tmp_path):
    # VM 1.0 is full until slot 3; a method that gives it back after slot 1 puts line 5 there.
    workload = toy.workload_of(*[(0, DUO, 0, 3, 3.0)] * 4, (2, DUO, 0, 3, 1.0))
    problems = forced(tmp_path / "run", workload, {4: A_AT_1, **dict.fromkeys(range(4), A_AT_1)})
    assert "line 5 (slot 2) step 1: exceeds the capacity of VM 0 of node 1" in problems[0]


# ---------------------------------------------------------------- why a request was rejected


def reason_of(*tried: object, warm: int = 0, **changes) -> str:
    """What the audit says to a duo from 0 to 3 that was rejected for nothing it knows, after ``warm`` others."""
    names = {"catalogue": ROOMY, "admission_control": True, "mask": "adjacency"}
    scenario = toy.toy_scenario(**(names | changes))
    record = first_fit(
        scenario,
        toy.workload_of(*[(0, DUO, 0, 3, 2.0)] * (warm + 1)),
        refuse=frozenset({warm}),
        walks=dict.fromkeys(range(warm), A_AT_1),
    )
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "run", record)
        decisions = read_decisions(Path(folder) / "run")
        decisions[warm] |= {"tried": list(tried), "reason": "no_feasible_action"}
        write_decisions(Path(folder) / "run", decisions)
        mine = [text for text in audit_run(Path(folder) / "run").problems if f"line {warm + 1} " in text]
    return mine[0].partition("what it tried gives ")[2] or mine[0] if mine else "no_feasible_action"


@pytest.mark.parametrize(
    ("tried", "settings", "expected"),
    [
        ([[1, 0, 0]], {"warm": 4}, "vm_capacity"),  # four times 10 of the 40 Mcycles/s of VM 1.0
        ([[1, 1, 0], [3, 1, 1]], {"warm": 4}, "vm_capacity"),  # and of the 80 of VM 3.1
        ([[1, 1, 0], [3, 0, None]] * 1, {"warm": 0}, "passes every check"),
        ([[1, 0, 0], [0, 0, 1], [2, 0, None], [3, 1, 1]], {}, "step 4 places function 1, it is at function 2"),
        (["reject"], {}, "rejected_by_policy"),
        (["reject"], {"admission_control": False}, "invalid_action"),
        (["no action"], {}, "invalid_action"),
        ([[3, 0, 0]], {}, "invalid_action"),  # no link 0-3
        ([[1, 0, 0], [1, 1, 1]], {}, "invalid_action"),  # colocation is off
        ([[1, 2, 0]], {}, "invalid_action"),  # node 1 has two VMs
        ([[1, 0, None]], {"max_steps": 1}, "passes every check"),
        ([[1, 0, None], [0, 0, None]], {"max_steps": 1}, "step_limit"),
        ([[1, 0, 0], [0, 0, 1]], {"catalogue": toy.toy_catalogue(duo_delay=360)}, "delay"),
        ([[1, 0, 0]], {"catalogue": toy.toy_catalogue(duo_delay=360), "mask": "feasible"}, "invalid_action"),
        (["reject"], {"catalogue": toy.toy_catalogue(duo_delay=290), "mask": "feasible"}, "no_feasible_action"),
        (["reject"], {"catalogue": toy.toy_catalogue(duo_delay=296), "mask": "feasible"}, "rejected_by_policy"),
        ([[1, 0, 1]], {}, "places function 1, it is at function 0"),
        ([[3, 0, 0], [1, 0, 0]], {}, r"step 1 is refused .*, yet more steps follow"),
        ([[1, 0, 0], [0, 0, 1], "reject"], {}, "rejected_by_policy"),
        ([[1, 0, 0], [2, 0, 1], [3, 0, None]], {}, "passes every check"),
        ([], {}, "not the steps"),
        ([[1, 0]], {}, "is no step"),
        (["give up"], {}, "is no step"),
    ],
)  # fmt: skip
def test_the_reason_follows_from_what_was_tried(tried, settings, expected):
    found = reason_of(*tried, **settings)
    assert found == expected if "_" in expected or expected == "delay" else re.search(expected, found)


# ---------------------------------------------------------------- tampered other files

OTHER_FILES = {
    "AAR altered": ("metrics.json", lambda d: d.update(aar=1.0), "aar is 1.0, the decisions give 0.8"),
    "ANUC altered": ("metrics.json", lambda d: d.update(anuc=d["anuc"] * 1.00001), "anuc is"),
    "NaN where there is a number": ("metrics.json", lambda d: d.update(anuc=None), "anuc is None"),
    "metric missing": ("metrics.json", lambda d: d.pop("mean_hops"), "mean_hops is missing"),
    "metric added": ("metrics.json", lambda d: d.update(joy=1), "unknown metric joy"),
    "speed altered": ("metrics.json", lambda d: d.update(decisions_per_second=1e6), "does not fit decision_seconds"),
    "time negative": ("metrics.json", lambda d: d.update(decision_seconds=-1), "decision_seconds is -1"),
    "admission control off": (
        "scenario.json", lambda d: d.update(admission_control=False), "line 7 (slot 3): rejected for rejected_by",
    ),
    "failure removed": (
        "scenario.json", lambda d: d["failure_timeline"].pop(0), "slot 4: VM 1 of node 1 is working already",
    ),
    "failure moved": (
        "scenario.json", lambda d: d["failure_timeline"][0].update(slot=1), "line 2: interrupted_at is 2, by",
    ),
    "failures before repairs": (
        "scenario.json",
        lambda d: d["failure_timeline"].insert(1, d["failure_timeline"].pop(2)), "entry 3: slot 4 is out of order",
    ),
    "failure of nothing": (
        "scenario.json", lambda d: d["failure_timeline"][0].update(vm=[0, 1]), "entry 1: {'slot': 2,",
    ),
    "warm-up altered": ("scenario.json", lambda d: d.update(warmup=0), "metrics.json: arrived is 6"),
    "VM cheaper": (
        "substrate.json", lambda d: d["nodes"][1]["vms"][0].update(unit_cost=0.5), "line 1 (slot 0): the cost",
    ),
    "link faster": ("substrate.json", lambda d: d["links"][0].update(delay=9), "line 1 (slot 0): the delay"),
    "link removed": ("substrate.json", lambda d: d["links"].pop(0), "there is no link between 0 and 1"),
    "link doubled": ("substrate.json", lambda d: d["links"].append(d["links"][0]), "link (0, 1) is there twice"),
    "node renamed": ("substrate.json", lambda d: d["nodes"][0].update(id=9), "node ids are not 0, 1, 2"),
    "VMs missing": ("substrate.json", lambda d: d["nodes"][0].pop("vms"), "lacks something: KeyError('vms')"),
    "horizon missing": ("scenario.json", lambda d: d.pop("horizon"), "'horizon' is missing"),
}  # fmt: skip


@pytest.mark.parametrize("kind", OTHER_FILES)
def test_tampered_other_files_are_caught(tmp_path, kind):
    folder = busy_run(tmp_path / "run")
    name, change, expected = OTHER_FILES[kind]
    edit_json(folder, name, change)
    problems = audit_run(folder).problems
    assert any(expected in problem for problem in problems), problems


def test_tampered_workload_is_caught(tmp_path):
    for number, (old, new, expected) in enumerate(
        [
            ("0,duo,0,3,1.5", "0,duo,0,3,1.6", "line 1 (slot 0)"),
            ("0,duo,0,3,1.5", "7,duo,0,3,1.5", "workload.csv line 3: slot 0 is out of order"),
            ("0,duo,0,3,1.5", "0,trio,0,3,1.5", "workload.csv line 2: unknown service 'trio'"),
            ("0,duo,0,3,1.5", "0,duo,4,3,1.5", "workload.csv line 2: ingress 4 and egress 3"),
            ("0,duo,0,3,1.5", "0,duo,0,3,nan", "workload.csv line 2: the lifetime nan"),
            ("0,duo,0,3,1.5", "0,duo,0,3", "workload.csv line 2: not enough values"),
            ("slot,service", "service,slot", "workload.csv: the header"),
        ]
    ):
        folder = busy_run(tmp_path / str(number))
        text = (folder / "workload.csv").read_text()
        (folder / "workload.csv").write_text(text.replace(old, new))
        assert any(expected in problem for problem in audit_run(folder).problems)


@pytest.mark.parametrize("name", ["scenario.json", "substrate.json", "workload.csv", "decisions.jsonl", "metrics.json"])
def test_missing_file_is_named(tmp_path, name):
    folder = busy_run(tmp_path / "run")
    (folder / name).unlink()
    assert audit_run(folder).problems == [f"{name}: No such file or directory"]


# ---------------------------------------------------------------- whole evaluations


def test_methods_that_met_different_requests_are_caught(tmp_path):
    for method, lifetime in (("a", 1.0), ("b", 2.0)):
        record = first_fit(workload=toy.workload_of((0, DUO, 0, 3, lifetime)), method=method)
        write(tmp_path / method / "seed_0", record)
    write(tmp_path / "a" / "seed_1", first_fit(method="a"))
    reports = audit_folders([tmp_path])
    assert [report.folder.relative_to(tmp_path).as_posix() for report in reports] == [
        "a/seed_0",
        "a/seed_1",
        "b/seed_0",
    ]
    assert [report.problems for report in reports] == [
        [],
        [],
        ["workload.csv differs from that of a for the same seed"],
    ]


def test_runs_being_written_are_no_runs(tmp_path):
    write(tmp_path / "m" / "seed_0", first_fit())
    (tmp_path / "m" / "seed_0").rename(tmp_path / "m" / ".seed_0.7.partial")
    assert find_runs(tmp_path) == []
    assert audit_folders([tmp_path])[0].problems == ["no run in this folder"]


def test_long_lists_of_problems_are_cut(tmp_path):
    folder = busy_run(tmp_path / "run")
    decisions = read_decisions(folder)
    decisions[0]["steps"] = [[1, 0, None], [0, 0, None]] * 100
    write_decisions(folder, decisions)
    problems = audit_run(folder).problems
    assert len(problems) == 51
    assert problems[-1].endswith("more problems")


NOT_RECOMPUTED = "Not recomputed: decision_seconds (wall time), only that decisions_per_second and the tables fit it."


def test_recipe_prints_a_line_a_run_and_fails_on_problems(tmp_path):
    recipe = Path(__file__).parents[2] / "recipes" / "audit.py"
    folder = busy_run(tmp_path / "first_fit" / "seed_0")

    def audit() -> subprocess.CompletedProcess:
        return subprocess.run([sys.executable, recipe, tmp_path], capture_output=True, text=True, check=False)

    result = audit()
    assert (result.returncode, result.stdout) == (0, f"{folder}: 9 requests, ok\n{NOT_RECOMPUTED}\n"), result.stderr
    edit_json(folder, "metrics.json", lambda d: d.update(aar=0.9))
    result = audit()
    assert result.returncode == 1
    assert "metrics.json: aar is 0.9" in result.stdout


def test_audit_shares_no_code_with_what_it_checks():
    code = "import sys, nfv_torchrl.evaluation.audit; print('\\n'.join(m for m in sys.modules if m.startswith('nfv')))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    allowed = ("nfv_torchrl", "nfv_torchrl.errors", "nfv_torchrl.evaluation", "nfv_torchrl.vocabulary")  # names alone
    assert all(m in allowed or m.startswith("nfv_torchrl.evaluation.audit") for m in loaded), loaded


def test_metrics_of_the_report_are_the_written_ones(tmp_path):
    folder = busy_run(tmp_path / "run")
    stated = json.loads((folder / "metrics.json").read_text())
    for key, value in audit_run(folder).metrics.items():
        assert np.isclose(stated[key], value) if value is not None else stated[key] is None
