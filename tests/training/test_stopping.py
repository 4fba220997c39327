"""Signals: a run saves and ends, a command cleans up and ends with the signal's code."""

from __future__ import annotations

import os
import signal

import pytest
from inprocess import call
from tiny import TINY_SCENARIO, TINY_TRAINING

from nfv_torchrl.training.cli import STOPS, clear_errors
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.setup import StopRequest


@pytest.mark.parametrize("number", STOPS)
def test_a_run_is_asked_to_stop_and_handlers_come_back(number):
    before = [signal.getsignal(each) for each in STOPS]
    with StopRequest() as stop:
        assert not stop.asked
        os.kill(os.getpid(), number)
        assert stop.asked
        for again in (signal.SIGTERM, signal.SIGUSR1):  # clusters repeat themselves
            os.kill(os.getpid(), again)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert [signal.getsignal(each) for each in STOPS] == before


RECIPES = {
    "dqn": ["preset=mlp", *TINY_TRAINING],
    "policy_gradient": ["collector.num_envs=4", "collector.steps=8", "collector.total_frames=960", "eval.interval=0"],
    "evolution": ["generations=3", "generation.tasks=1", "eval.interval=0", "strategy.population=4", "parallel.jobs=1"],
}


@pytest.mark.parametrize("name", RECIPES)
def test_a_signal_that_comes_again_while_a_run_saves_does_not_stop_it(name, tmp_path, monkeypatch, capsys):
    save = RunFolder.save

    def save_among_signals(folder, state, frames):
        for number in (signal.SIGTERM, signal.SIGUSR1):
            os.kill(os.getpid(), number)
        save(folder, state, frames)

    monkeypatch.setattr(RunFolder, "save", save_among_signals)
    call(
        name,
        f"run_dir={tmp_path / 'run'}",
        *TINY_SCENARIO,
        *RECIPES[name],
        "saving.interval=1",
        "logger.references=false",
    )
    assert "Stopped and saved" in capsys.readouterr().out
    assert list((tmp_path / "run").glob("checkpoint_*.pt"))


@pytest.mark.parametrize(("number", "name"), [(2, "SIGINT"), (10, "SIGUSR1"), (15, "SIGTERM")])
def test_a_command_cleans_up_and_ends_with_the_code_of_the_signal(number, name, capsys):
    cleaned = []

    @clear_errors
    def main() -> None:
        try:
            os.kill(os.getpid(), number)
        finally:
            cleaned.append(True)

    with pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == 128 + number and cleaned
    assert capsys.readouterr().err == f"\nStopped by {name}.\n"
