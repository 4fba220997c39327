"""``NFVVectorEnv``: B networks for Gymnasium, stepped together by one simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from nfv_torchrl import rewards
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.gym.picture import FPS, MODES, NetworkPicture, check_mode
from nfv_torchrl.gym.worlds import ScenarioLike, Worlds


class NFVVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B environments like ``NFVGymEnv``, without a Python loop over them.

    Environment b is ``NFVGymEnv`` with ``seed + b``. So it is, step by step and to the bit, what
    ``make_vec(vectorization_mode="sync")`` makes of 64 single ones after ``reset(seed=...)``, and far faster.

    Autoreset mode ``SAME_STEP``: where a horizon ends, ``terminated`` is true, and observation and ``info`` are already
    those of the next one. The last observation is in ``info["final_obs"]`` (object [B]: an array [P] or None), what the
    last step brought in ``info["final_info"]``.

    Args:
        num_envs: B.
        scenario: as for ``NFVGymEnv``.
        reward: as for ``NFVGymEnv``.
        one_hot: as for ``NFVGymEnv``.
        seed: seed of environment 0, until ``reset(seed=...)`` names another.
        render_mode: as for ``NFVGymEnv``.
        threads: threads that split the batch inside the simulator; results do not depend on it.

    Raises:
        ScenarioError: the config is wrong.
    """

    metadata = {  # noqa: RUF012  as in gymnasium.vector.VectorEnv
        "render_modes": MODES,
        "render_fps": FPS,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    worlds: ClassVar[type[Worlds]] = Worlds

    def __init__(
        self,
        num_envs: int = 1,
        scenario: ScenarioLike = None,
        *,
        reward: rewards.Reward | None = None,
        one_hot: bool = True,
        seed: int = 0,
        render_mode: str | None = None,
        threads: int = 1,
    ) -> None:
        if num_envs < 1:
            raise ScenarioError(f"num_envs is {num_envs}; at least one environment is needed")
        self.num_envs, self.render_mode = num_envs, check_mode(render_mode)
        self._worlds = self.worlds(scenario, self._seeds(seed), reward=reward, one_hot=one_hot, threads=threads)
        self.scenario, self.simulator = self._worlds.scenario, self._worlds.simulator
        self.single_observation_space = self._worlds.observation_space
        self.single_action_space = self._worlds.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._picture: NetworkPicture | None = None

    def _seeds(self, seed: int) -> list[int]:
        return [seed + b for b in range(self.num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin the next horizon of every environment, or with ``seed`` the first of another stream.

        Args:
            seed: of environment 0, the others count up from it; or one for each, None among them goes on.
            options: ``reset_mask`` bool [B]: begin these only.

        Raises:
            ScenarioError: another number of seeds than of environments, or no mask.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        if isinstance(seed, int | np.integer):
            seeds: Sequence[int | None] | None = self._seeds(int(seed))
        else:
            seeds = None if seed is None else list(seed)
        if seeds is not None and len(seeds) != self.num_envs:
            raise ScenarioError(f"seed: {len(seeds)} seeds for {self.num_envs} environments; give one for each")
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ScenarioError(f"reset_mask: bool [{self.num_envs}] is needed, not {mask.dtype} {list(mask.shape)}")
        self._worlds.begin(np.flatnonzero(mask).tolist(), seeds)
        return self._worlds.observations(), self._info(mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every environment; see ``NFVGymEnv`` and, for the ends of horizons, the class.

        Args:
            actions: int64 [B].

        Returns:
            observations float32 [B, P], rewards float64 [B], terminated and truncated bool [B], info.

        Raises:
            gymnasium.error.ResetNeeded: before the first ``reset``.
        """
        reward = self._worlds.step(np.asarray(actions, np.int64))
        ended = self._worlds.done()
        final: dict[str, Any] = {}
        if ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            rows, seen = np.flatnonzero(ended).tolist(), self._worlds.observations()
            for b in rows:
                last[b] = seen[b].copy()
            final = {"final_obs": last, "_final_obs": ended.copy()}
            final |= {"final_info": self._info(ended), "_final_info": ended.copy()}
            self._worlds.begin(rows)
        everywhere = np.ones(self.num_envs, bool)
        return self._worlds.observations(), reward, ended, np.zeros_like(ended), self._info(everywhere) | final

    def action_masks(self) -> np.ndarray:
        """The actions that are valid now, bool [B, 2 N V + 1]. At least one is valid in every environment."""
        return self._worlds.masks()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The networks as they are now, B pictures as of ``NFVGymEnv.render``. None without a render mode."""
        if self.render_mode is None:
            return None
        if self._picture is None:
            self._picture = NetworkPicture(self.simulator)
        return tuple(self._picture.draw(b) for b in range(self.num_envs))

    def _info(self, rows: np.ndarray) -> dict[str, Any]:
        """In Gymnasium's form: arrays that are zero outside ``rows`` bool [B], and ``_name``, which says where."""
        infos: dict[str, Any] = {}
        whole = bool(rows.all())
        for name, values in self._worlds.infos().items():
            if not whole:
                values[~rows] = 0
            infos[name], infos[f"_{name}"] = values, rows.copy()
        return infos
