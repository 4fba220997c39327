"""B networks for Stable-Baselines3, without a Python loop over them. Needs the extra ``sb3``.

::

    import gymnasium
    from sb3_contrib import MaskablePPO
    from nfv_torchrl.gym import ENV_ID
    from nfv_torchrl.gym.sb3 import SB3VecEnv

    envs = SB3VecEnv(gymnasium.make_vec(ENV_ID, num_envs=64))
    MaskablePPO("MlpPolicy", envs, n_steps=64, batch_size=1024).learn(200_000)
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.gym.vector import NFVVectorEnv

try:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
except ImportError as error:
    raise ScenarioError(
        "nfv_torchrl.gym.sb3 needs Stable-Baselines3: pip install -c constraints.txt -e '.[sb3]', "
        "or pip install stable-baselines3 sb3-contrib"
    ) from error

__all__ = ["DummyVecEnv", "SB3VecEnv"]

OF_A_REQUEST = ("accepted", "rejection_reason", "request_cost")


class SB3VecEnv(VecEnv):
    """``NFVVectorEnv`` as Stable-Baselines3 wants it. Masks come through ``env_method("action_masks")``.

    ``infos`` is a list of B dicts. One has ``accepted``, ``rejection_reason`` and ``request_cost`` where the step
    answered a request, and ``terminal_observation`` and ``TimeLimit.truncated`` (false) where it ended a horizon.
    Rewards and lengths of episodes are written by ``VecMonitor`` of Stable-Baselines3, around this.

    Args:
        envs: the environments, as ``gymnasium.make_vec("nfv_torchrl/NFV-v0", num_envs=64)`` makes them.

    Raises:
        ScenarioError: other environments, or wrapped ones.
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv) -> None:
        if not isinstance(envs, NFVVectorEnv):
            raise ScenarioError(
                f"SB3VecEnv is for an NFVVectorEnv, not a {type(envs).__name__}; make one with gymnasium.make_vec"
            )
        self.envs = envs
        self._actions = np.zeros(envs.num_envs, np.int64)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin a horizon in every environment, of the seeds that ``seed`` named; returns observations [B, P]."""
        observations, info = self.envs.reset(seed=self._seeds)
        self.reset_infos = [{"action_mask": mask} for mask in info["action_mask"]]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Take the ``actions`` int [B] of the next ``step_wait``."""
        self._actions = np.asarray(actions, np.int64)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One step. Returns observations float32 [B, P], rewards float32 [B], dones bool [B] and infos."""
        observations, rewards, dones, _, info = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        _tell_of_requests(infos, info)
        if "final_obs" in info:
            _tell_of_requests(infos, info["final_info"])
            for b in np.flatnonzero(dones).tolist():
                infos[b] |= {"terminal_observation": info["final_obs"][b], "TimeLimit.truncated": False}
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> list[np.ndarray | None]:
        """A picture of every network, if the environments were made with ``render_mode="rgb_array"``."""
        return list(self.envs.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of each environment: most are those of the whole; ``action_masks`` is of each its own."""
        rows = list(self._get_indices(indices))
        if attr_name == "action_masks":
            return [partial(self._mask, b) for b in rows]
        return [getattr(self.envs, attr_name)] * len(rows)

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refused: the environments are one object.

        Raises:
            ScenarioError: always.
        """
        raise ScenarioError(f"{attr_name}: environments of one simulator share their settings; name it in make_vec")

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """``action_masks`` (bool [A] each) or ``render`` (a picture each).

        Raises:
            AttributeError: another method.
        """
        rows = list(self._get_indices(indices))
        if method_name == "action_masks":
            return list(self.envs.action_masks()[rows])
        if method_name == "render":
            images = self.get_images()
            return [images[b] for b in rows]
        raise AttributeError(f"{method_name}: environments of one simulator have action_masks and render only")

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Never: there are no single environments to wrap."""
        return [False for _ in self._get_indices(indices)]

    def _mask(self, b: int) -> np.ndarray:
        return self.envs.action_masks()[b]


def _tell_of_requests(infos: list[dict[str, Any]], info: dict[str, Any]) -> None:
    for b in np.flatnonzero(info["request_done"]).tolist():
        infos[b] |= {name: info[name][b].item() for name in OF_A_REQUEST}
