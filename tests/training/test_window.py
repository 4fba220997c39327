"""The totals of a training window by hand: three requests answered, two slots closed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from nfv_torchrl.training.window import TrainingWindow
from nfv_torchrl.vocabulary import TABLE

ROWS = {  # a web request accepted, a video one refused for its delay, a web one accepted in the warm-up, a step between
    "accepted": [1, 0, 1, 0],
    "request_cost": [80, 0, 500, 0],
    "request_delay": [30, 0, 90, 0],
    "request_hops": [4, 0, 9, 0],
    "slots_closed": [1, 0, 0, 1],
    "slot_cost": [100, 0, 0, 300],
    "slot_vm_use": [0.25, 0, 0, 0.75],
    "slot_link_use": [0.125, 0, 0, 0.25],
    "interrupted": [0, 0, 0, 1],
    "service": [0, 1, 0, 1],
    "reason": [-1, 2, -1, -1],
    "request_slot": [5, 5, 1, 6],
}


def window_of(rows: slice) -> TrainingWindow:
    window = TrainingWindow(("web", "video"), warmup=2)
    outcome = {name: torch.tensor(values, dtype=torch.float32)[rows, None] for name, values in ROWS.items()}
    done = torch.tensor([True, True, True, False])[rows, None]
    window.add(TensorDict({"next": {"outcome": outcome, "request_done": done}}, [len(done)]))
    return window


def test_every_ratio_by_hand():
    reasons = (
        "link_capacity",
        "vm_capacity",
        "step_limit",
        "no_feasible_action",
        "rejected_by_policy",
        "invalid_action",
    )
    expected = {
        "train/aar": 1 / 2,
        "train/aar/web": 1,
        "train/aar/video": 0,
        "train/anuc": (100 + 300) / 2,
        "train/cost_per_accepted": 80,
        "train/rejected/delay": 1 / 2,
        **{f"train/rejected/{reason}": 0 for reason in reasons},
        "train/mean_hops": 4,
        "train/mean_delay_ms": 30,
        "train/vm_utilisation": 1 / 2,
        "train/link_utilisation": 0.1875,
        "train/interrupted": 1,
    }
    assert window_of(slice(0, 4)).metrics() == pytest.approx(expected)


def test_what_has_no_data_is_left_out():
    assert window_of(slice(2, 3)).metrics() == {}
    refused = window_of(slice(1, 2)).metrics()
    assert refused["train/aar"] == refused["train/aar/video"] == 0
    assert not {"train/aar/web", "train/cost_per_accepted", "train/anuc", "train/interrupted"} & {*refused}


def test_a_row_with_two_totals_is_a_scalar(monkeypatch):
    row = replace(TABLE["mean_hops"], name="hops_per_request", train=("request_hops", "arrived"))
    monkeypatch.setitem(TABLE, row.name, row)
    assert window_of(slice(0, 4)).metrics()["train/hops_per_request"] == 4 / 2
