"""MaskablePPO of sb3-contrib trained on the Gymnasium environments, and evaluated as every other agent is."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import torch
from torch import nn

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.gym import ENV_ID
from nfv_torchrl.methods import CompiledNetwork
from nfv_torchrl.networks import MLPNetwork, Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.clock import TrainingClock
from nfv_torchrl.training.references import mean_metrics
from nfv_torchrl.training.setup import set_threads

MASK = "feasible"
"""Which actions are valid, as in the presets of the other agents."""
WIDTHS = (64, 64)
"""The hidden layers of ``MlpPolicy`` as it comes; its activation is Tanh."""


def train_maskable_ppo(cell: Cell, store: CellStore) -> dict[str, Any]:
    """Train with the settings of the cell, the others being those of sb3-contrib; returns the curve ``eval``.

    Its points are those of the other trainings: ``frames``, ``processor_seconds`` (``TrainingClock``) and ``aar``, the
    mean over the workloads of ``eval_seeds`` with the most probable valid action. They come every so many rollouts that
    there are ``evaluations`` of them, after one of the untrained policy. Needs the extra ``sb3``.
    """
    from sb3_contrib import MaskablePPO
    from stable_baselines3.common.logger import Logger

    from nfv_torchrl.gym.sb3 import SB3VecEnv

    spec, settings = cell.spec, cell.spec["settings"]
    set_threads(1)
    scenario = Scenario.from_config({**spec["scenario"], "mask": MASK})
    envs = gymnasium.make_vec(ENV_ID, num_envs=settings["num_envs"], scenario=scenario, seed=spec["seed"])
    model = MaskablePPO(
        "MlpPolicy",
        SB3VecEnv(envs),
        n_steps=settings["steps"],
        batch_size=settings["batch_size"],
        seed=spec["seed"],
        device="cpu",
    )
    model.set_logger(Logger(None, []))  # its own one leaves a folder in /tmp
    rollout = settings["steps"] * settings["num_envs"]
    rollouts, count = math.ceil(settings["frames"] / rollout), settings["evaluations"]
    clock, points, done = TrainingClock(), [], 0
    for until in sorted({rollouts * number // count for number in range(count + 1)}):
        clock.start()
        if until:
            model.learn((until - done) * rollout, reset_num_timesteps=False)
        clock.stop()
        done = until
        scores = mean_metrics(run_method(scenario, compiled(model, scenario), spec["eval_seeds"]))
        points.append({"frames": int(model.num_timesteps), "processor_seconds": clock.seconds, "aar": scores["aar"]})
    envs.close()
    return {"eval": points}


def compiled(model: Any, scenario: Scenario) -> CompiledNetwork:
    """The policy of a MaskablePPO with ``MlpPolicy``, as it is now, by its most probable valid action."""
    network = MLPNetwork(Sizes.of(Simulator(scenario, 1, one_hot=True)), hidden=WIDTHS, activation="Tanh")
    mine = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
    theirs = [layer for layer in model.policy.mlp_extractor.policy_net if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        for layer, trained in zip(mine, [*theirs, model.policy.action_net], strict=True):
            layer.load_state_dict(trained.state_dict())
    return CompiledNetwork(network, name="maskable_ppo", one_hot=True)
