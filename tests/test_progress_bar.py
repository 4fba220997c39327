"""The line that says how far a command is."""

import io
import re
import time

import pytest

from nfv_torchrl import progress_bar
from nfv_torchrl.progress_bar import ProgressBar


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    """Seconds that pass only when told, for the bar and for tqdm."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(time, "time", lambda: self.now)

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def bar_with(clock, **settings):
    bar = ProgressBar(**settings)
    bar._time = clock  # tqdm took the real one when it was imported
    bar.start_t = bar.last_print_t = clock.now
    return bar


def test_a_log_file_gets_a_plain_line_every_ten_seconds(clock):
    log = io.StringIO()
    bar = bar_with(clock, total=600_000, unit="frame", desc="dqn", file=log)
    for _ in range(60):
        clock.now += 1
        bar.update(1000)
    lines = log.getvalue().splitlines()
    assert len(lines) == 6
    assert "\r" not in log.getvalue()
    assert lines[1] == "dqn:   3%, 20.0k of 600k frames, 00:20 gone, 09:40 left, 1.00k frames/s"


def test_work_of_less_than_ten_seconds_leaves_no_line(clock):
    log = io.StringIO()
    bar = bar_with(clock, total=3, unit="run", file=log)
    for _ in range(3):
        clock.now += 1
        bar.update()
    bar.close()
    assert log.getvalue() == ""


def test_evaluations_do_not_throw_off_the_time_left(clock):
    bar = bar_with(clock, total=100, unit="frame", pauses=4, file=io.StringIO())
    with bar.pause():  # the evaluation of the untrained policy
        clock.now += 30
    clock.now += 50  # the first update compiles
    bar.update()
    for _ in range(49):
        clock.now += 2
        bar.update()
    with bar.pause():
        clock.now += 10
    # 50 frames of 2 s, and two evaluations that take as long as the last one: the first had more to do.
    assert bar._seconds_left() == pytest.approx(50 * 2 + 2 * 10)


def test_more_than_the_total_keeps_its_percentage(clock):
    log = Terminal()
    bar = bar_with(clock, total=600_000, unit="frame", file=log)
    bar.reach(599_040)
    clock.now += 1
    bar.say("AAR 0.981")
    bar.reach(600_064)
    bar.close()
    assert re.search(r"100%\|\S+\| 600k/600k frames, 00:01 gone, nothing left, .*, AAR 0.981", log.getvalue())


def test_items_are_counted_and_a_broken_loop_closes_the_bar(clock):
    log = io.StringIO()
    seen = []
    bar = bar_with(clock, items=range(4), unit="cell", file=log)
    for item in bar:
        clock.now += 20
        seen.append(item)
    assert seen == [0, 1, 2, 3]
    assert log.getvalue().splitlines()[-1] == "100%, 4 of 4 cells, 01:20 gone, nothing left, 20.0 s/cell"


def test_a_bar_within_another_leaves_plain_lines_too(clock):
    log = io.StringIO()
    outer = bar_with(clock, total=2, unit="frame", desc="dqn", file=log)
    inner = bar_with(clock, total=2, unit="request", desc="references", file=log)
    clock.now += 20
    inner.update(2)
    inner.close()
    outer.update(2)
    assert [line.split(":")[0] for line in log.getvalue().splitlines()] == ["references", "references", "dqn"]
    assert "\x1b" not in log.getvalue()


def test_without_a_number_of_items_there_is_no_percentage(clock):
    log = io.StringIO()
    bar = bar_with(clock, unit="request", desc="greedy", file=log)
    clock.now += progress_bar.SECONDS_BETWEEN_LINES
    bar.update(20_000)
    assert log.getvalue() == "greedy: 20.0k requests, 00:10 gone, ? requests/s\n"


def wait_for_lines(log, count):
    """At most ten seconds: a machine may be busy."""
    until = time.monotonic() + 10
    while len(log.getvalue().splitlines()) < count and time.monotonic() < until:
        time.sleep(0.02)
    assert len(log.getvalue().splitlines()) >= count


def test_a_unit_that_takes_long_leaves_lines_and_a_closed_bar_none(monkeypatch):
    monkeypatch.setattr(progress_bar, "SECONDS_BETWEEN_LINES", 0.05)
    log = io.StringIO()
    outer = ProgressBar(total=2, unit="cell", desc="losses", file=log)
    outer.say("at work: dqn seed 0")
    with ProgressBar(total=2, unit="request", desc="references", file=log):
        before = len(log.getvalue().splitlines())
        wait_for_lines(log, before + 2)
        inner = log.getvalue().splitlines()[before:]
        assert all(line.startswith("references: ") for line in inner)  # the innermost speaks
    before = len(log.getvalue().splitlines())
    wait_for_lines(log, before + 2)
    outer.close()
    lines = log.getvalue().splitlines()
    expected = r"losses:   0%, 0 of 2 cells.*, at work: dqn seed 0$"
    assert all(re.match(expected, line) for line in lines[before:])
    time.sleep(0.1)
    assert log.getvalue().splitlines() == lines
