"""A short run of the fuzzer (``tests/fuzz/run.py`` runs as long as one likes), and that it notices what it should."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from fuzz.arena import play
from fuzz.run import fuzz

from nfv_torchrl.errors import ScenarioError


def refuse(text: str) -> None:
    raise ScenarioError(text)


BAD = {
    "fine": (lambda number, folder: None, "loaded"),
    "refused": (lambda number, folder: refuse("key: wrong; set it right"), "refused"),
    "two lines": (lambda number, folder: refuse("key:\nwrong"), "not one line"),
    "bug": (lambda number, folder: {}["key"], "traceback"),
    "crash": (lambda number, folder: os.abort(), "crash"),
    "hang": (lambda number, folder: time.sleep(60), "hang"),
    "memory": (lambda number, folder: np.ones(1 << 30), "traceback"),  # 8 GiB
}


@pytest.mark.parametrize("kind", BAD)
def test_each_kind_of_outcome_is_told(kind):
    case, verdict = BAD[kind]
    cases = {"before": BAD["fine"][0], kind: case, "after": BAD["fine"][0]}
    outcomes = list(play(cases, ((name, 0) for name in cases), patience=2))
    assert [outcome.verdict for outcome in outcomes] == ["loaded", verdict, "loaded"]
    assert outcomes[1].failed == (verdict not in ("loaded", "refused"))


@pytest.mark.parametrize(("what", "cases"), [("files", 60), ("settings", 30)])
def test_nothing_but_one_clear_line(what, cases):
    outcomes = list(fuzz(what, cases=cases))
    failed = [f"{o.kind} {o.number}: {o.verdict}\n{o.detail}" for o in outcomes if o.failed]
    assert not failed, "\n\n".join(failed)
    assert len(outcomes) == cases and {o.verdict for o in outcomes} == {"loaded", "refused"}
