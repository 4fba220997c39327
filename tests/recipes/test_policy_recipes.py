"""Policy gradient, NFVdeep and the recurrent DQN, run for real at tiny size."""

from __future__ import annotations

import pytest
import torch
from forked import forked_workers
from inprocess import call
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY_SCENARIO

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PlannerMethod, load_policy
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.vocabulary import without_row

TINY = [
    *TINY_SCENARIO,
    "scenario.horizon=20",
    "collector.num_envs=4",
    "collector.steps=8",
    "collector.total_frames=192",
    "logger.interval=2",
    "logger.figures=false",
    "eval.interval=6",
    "eval.seeds=[1000]",
    "saving.interval=3",
    "segment=2",
]
BUFFER = ["buffer.size=20", "buffer.batch_size=4", "buffer.warmup_frames=32", "learner.updates=2"]
RUNS = {
    "ppo": ("policy_gradient", ["pg_loss=ppo", "learner.minibatch=12"]),
    "a2c": ("policy_gradient", ["pg_loss=a2c"]),
    "reinforce": ("policy_gradient", ["pg_loss=reinforce"]),
    "ClipPPOLoss": (
        "policy_gradient",
        ["loss._target_=torchrl.objectives.ClipPPOLoss", "+loss.clip_value=0.2"],
    ),
    "A2CLoss": ("policy_gradient", ["loss._target_=torchrl.objectives.A2CLoss"]),
    "ReinforceLoss": ("policy_gradient", ["loss._target_=torchrl.objectives.ReinforceLoss"]),
    "ppo on candidates": ("policy_gradient", ["network=candidate"]),
    "recurrent ppo": ("policy_gradient", ["pg_loss=recurrent_ppo", "network.hidden=8", "learner.minibatch=2"]),
    "rdpg": ("dqn", ["preset=rdpg", *BUFFER, "network.hidden=8", "loss.burn_in=2"]),
    "ppo, two workers": ("policy_gradient", ["collector=multi_sync"]),
    "nfvdeep": ("policy_gradient", ["env=nfvdeep"]),
    "gru": ("dqn", ["preset=recurrent", *BUFFER, "loss.burn_in=2"]),
}
LOGGED = {"ppo": "train/kl_approx", "a2c": "train/entropy", "reinforce": "train/loss_value", "gru": "train/td_error"}
LOGGED |= {"recurrent ppo": "train/kl_approx", "rdpg": "train/loss_qvalue"}


@pytest.mark.parametrize("name", RUNS)
@forked_workers()
def test_it_trains_resumes_to_the_bit_and_loads(name, tmp_path):
    recipe, overrides = RUNS[name]
    folder = tmp_path / "run"
    call(recipe, f"run_dir={folder}", *TINY, *overrides)
    checkpoints = CheckpointFolder(folder)
    whole = load_file(checkpoints.files()[-1])
    checkpoints.files()[-1].unlink()
    call(recipe, f"run_dir={folder}", *TINY, *overrides, "resume=true")
    again = load_file(checkpoints.files()[-1])
    assert again["progress"]["frames"] == 192
    assert_same(whole["loss"], again["loss"])
    assert_same(whole["env"], again["env"])
    assert all(torch.isfinite(value).all() for value in whole["loss"].values())

    scenario = Scenario.from_config(whole["config"]["scenario"])
    method = load_policy(folder / "best.pt", scenario)
    once, twice = (run_method(scenario, method, [1000])[0] for _ in range(2))
    assert (once.accepted == twice.accepted).all() and (once.step_node == twice.step_node).all()
    assert isinstance(method, PlannerMethod) == (name == "nfvdeep")

    events = EventAccumulator(str(folder))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"train/aar", "eval/aar", LOGGED.get(name, "train/gradient_norm")} <= set(tags)
    assert not without_row(tags)


def test_a_file_of_nfvdeep_is_refused_on_another_network(tmp_path):
    folder = tmp_path / "run"
    call("policy_gradient", "env=nfvdeep", f"run_dir={folder}", *TINY, "collector.total_frames=32")
    config = load_file(CheckpointFolder(folder).files()[-1])["config"]["scenario"]
    config["substrate"]["nodes"] = 6
    with pytest.raises(CheckpointError, match="6 actions"):
        load_policy(folder / "best.pt", Scenario.from_config(config))


def test_nfvdeep_shows_its_own_observation_alone(tmp_path, capsys):
    with pytest.raises(SystemExit):
        call("policy_gradient", "env=nfvdeep", "network=candidate", f"run_dir={tmp_path / 'run'}", *TINY)
    assert "use network=mlp" in capsys.readouterr().err


def assert_same(a, b):
    """Nested states are equal to the bit."""
    if isinstance(a, torch.Tensor):
        assert torch.equal(a.reshape(-1).view(torch.uint8), b.reshape(-1).view(torch.uint8))
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b
