"""The clock of a training: what it counts, and what it leaves out."""

from __future__ import annotations

import time

import pytest
from numba import njit
from numba.core.event import end_event, start_event

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.training import clock as clocks
from nfv_torchrl.training.clock import COMPILING, TrainingClock


@pytest.fixture
def now(monkeypatch):
    """Processor time, which a test sets."""
    seconds = [100.0]
    monkeypatch.setattr(clocks.time, "process_time", lambda: seconds[0])

    def at(value: float) -> None:
        seconds[0] = value

    return at


def test_between_start_and_stop_without_what_numba_does(now):
    clock = TrainingClock()
    now(110)
    assert clock.seconds == 0  # not started yet
    clock.start()
    clock.start()
    now(112)
    assert clock.seconds == 2
    start_event(COMPILING)
    now(120)
    start_event(COMPILING)  # a function within another
    now(130)
    end_event(COMPILING)
    now(131)
    end_event(COMPILING)
    assert clock.seconds == 2
    now(134)
    assert clock.seconds == 5
    clock.stop()
    clock.stop()
    now(140)
    start_event(COMPILING)  # in an evaluation
    end_event(COMPILING)
    now(150)
    assert clock.seconds == 5
    clock.start()
    now(151)
    assert clock.seconds == 6
    clock.stop()


def test_what_numba_compiles_is_left_out():
    clock, begun = TrainingClock(), time.process_time()

    @njit
    def twice(x):
        return x + x

    clock.start()
    assert twice(2) == 4 and twice(2.0) == 4.0
    clock.stop()
    assert clock.seconds < 0.3 * (time.process_time() - begun)


def test_it_goes_on_from_its_state(now):
    clock, again = TrainingClock(), TrainingClock()
    clock.start()
    now(103)
    again.load_state_dict(clock.state_dict())
    clock.stop()
    again.start()
    now(104)
    assert again.seconds == 4
    again.stop()
    for state in ({}, {"seconds": float("nan")}, {"seconds": "3"}, {"seconds": 1.0, "more": 1}):
        with pytest.raises(CheckpointError, match="clock"):
            again.load_state_dict(state)
