"""Numbers that are not finite end a run with the step and the setting, and reach no file."""

import re

import numpy as np
import pytest
import torch
from inprocess import call
from tiny import TINY_SCENARIO, TINY_TRAINING

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError, TrainingError
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.finite import check_fitness, check_learning, check_weights
from nfv_torchrl.training.progress import Progress

AT = Progress(frames=640, updates=7)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_losses_and_norms(value):
    good = {"loss": torch.tensor(1.0), "gradient_norm": torch.tensor(2.0), "td_error": torch.tensor(value)}
    check_learning(good, AT)
    for name in ("loss", "loss_value", "gradient_norm"):
        with pytest.raises(TrainingError, match=rf"learner.lr: {name} is {value} at update 7, frame 640"):
            check_learning(good | {name: torch.tensor(value)}, AT)


def test_weights():
    module = torch.nn.Linear(2, 2)
    check_weights(module, "loss", AT)
    with torch.no_grad():
        module.bias[1] = float("nan")
    with pytest.raises(TrainingError, match=r"weights of loss \(bias\) are not finite at update 7, frame 640"):
        check_weights(module, "loss", AT)


def test_fitness():
    check_fitness([0.0, -1.0], 3)
    with pytest.raises(TrainingError, match="fitness: candidate 1 of generation 3 has fitness nan"):
        check_fitness([0.0, float("nan")], 3)


def test_a_reward_of_ones_own():
    def broken(outcome, scale):
        return np.where(outcome["request_done"] > 0, np.nan, 0.0)

    env = NFVEnv(paper_scenario(5, horizon=10), 4, reward=broken)
    with pytest.raises(ScenarioError, match="reward: broken returned nan"):
        env.rollout(100, break_when_any_done=False)


def test_a_run_that_goes_astray_keeps_its_last_good_checkpoint(tmp_path, capsys):
    folder = tmp_path / "run"
    settings = [f"run_dir={folder}", *TINY_SCENARIO, *TINY_TRAINING, "logger.interval=1000", "saving.interval=1"]
    with pytest.raises(SystemExit):
        call("dqn", "preset=mlp", *settings, "learner.lr=1e30", "learner.max_grad_norm=null")
    said = capsys.readouterr().err
    assert re.search(r"error: learner.lr: .* at update \d+, frame \d+; try a smaller learner.lr", said)
    kept = load_file(CheckpointFolder(folder).files()[-1])
    assert all(torch.isfinite(value).all() for value in kept["loss"].values())
