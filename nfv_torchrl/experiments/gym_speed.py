"""How fast MaskablePPO of sb3-contrib is on the Gymnasium environments, one and many; rows for a table."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium

from nfv_torchrl.experiments.loaded import make_scenario, median_rates
from nfv_torchrl.gym import ENV_ID, NFVGymEnv
from nfv_torchrl.scenario.scenario import Scenario

FRAMES = 2048
"""Frames of a rollout, over all environments: the default of Stable-Baselines3 for one."""
MINIBATCHES = (64, 1024)
"""Rows of an update: the default of Stable-Baselines3, and one that suits many environments."""


def run_gym(config: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of MaskablePPO's speeds, from empty networks, with the defaults of Stable-Baselines3 but for the minibatch.

    Raises:
        ScenarioError: Stable-Baselines3 is not installed.
    """
    from nfv_torchrl.gym.sb3 import DummyVecEnv, SB3VecEnv

    for nodes in config["nodes"]:
        scenario = make_scenario(config, nodes, 1000)
        ways: list[tuple[str, int, Callable[[], Any]]] = [("gymnasium.make", 1, partial(_single, scenario))]
        for batch in config["batch_sizes"]:
            if batch > 1:
                single: list[Callable[[], gymnasium.Env]] = [partial(NFVGymEnv, scenario, seed=b) for b in range(batch)]
                ways.append(("DummyVecEnv", batch, partial(DummyVecEnv, single)))
                ways.append(("SB3VecEnv", batch, partial(_together, SB3VecEnv, batch, scenario)))
        for name, batch, make in ways:
            yield {"N": nodes, "environments": name, "B": batch} | _speeds(config, make, batch)


def _single(scenario: Scenario) -> gymnasium.Env:
    return gymnasium.make(ENV_ID, scenario=scenario)


def _together(adapter: Callable[[Any], Any], batch: int, scenario: Scenario) -> Any:
    return adapter(gymnasium.make_vec(ENV_ID, num_envs=batch, scenario=scenario))


def _speeds(config: dict[str, Any], make: Callable[[], Any], batch: int) -> dict[str, float]:
    """Frames per second of processor time: of rollouts alone, and of ``learn`` with each size of minibatch."""
    from sb3_contrib import MaskablePPO
    from stable_baselines3.common.logger import Logger

    steps = max(min(FRAMES, config["frames"]) // batch, 2)
    row: dict[str, float] = {}
    for size in MINIBATCHES:
        envs = make()
        model = MaskablePPO("MlpPolicy", envs, n_steps=steps, batch_size=size, device="cpu", seed=0)
        model.set_logger(Logger(None, []))  # its own one leaves a folder in /tmp
        frames = steps * batch
        _, callback = model._setup_learn(frames)

        def collect(model=model, callback=callback, frames=frames) -> int:
            model.collect_rollouts(model.env, callback, model.rollout_buffer, steps)
            return frames

        def learn(model=model, frames=frames) -> int:
            model.learn(frames, reset_num_timesteps=False)
            return frames

        if not row:
            row["collecting, frames/s"], _ = median_rates(config, collect)
        row[f"learn, minibatch {size}"], _ = median_rates(config, learn)
        envs.close()
    return row
