"""``NFVGymEnv``: one network for Gymnasium."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np

from nfv_torchrl import rewards
from nfv_torchrl.gym.picture import FPS, MODES, NetworkPicture, check_mode
from nfv_torchrl.gym.worlds import ScenarioLike, Worlds


class NFVGymEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One network that answers one request after the other. Each action is a step of Algorithm 3.

    The observation (float32 [P], in [0, 1]) and the actions (2 N V and ``reject``, the last) are those of ``NFVEnv``,
    as are the requests: with the same seed, it is environment 0 of an ``NFVEnv``. An episode is one horizon; at its end
    ``terminated`` is true, as there is nothing after it; ``truncated`` never is. An action outside the mask answers the
    request with ``invalid_action``.

    ``info`` has ``action_mask`` (int8 [2 N V + 1], fit for ``action_space.sample(mask)``) and of the last step
    ``request_done``, ``accepted`` (bool), ``rejection_reason`` (int: a ``Reason``, -1 for none) and ``request_cost``
    ($, of a request accepted with that step).

    Args:
        scenario: a scenario, or its config as a mapping; default the paper's.
        reward: see ``nfv_torchrl.rewards``; default ``admission_step_cost``.
        one_hot: append one-hot service type, current node, egress and function index to the observation.
        seed: seed of the requests until ``reset(seed=...)`` names another.
        render_mode: ``rgb_array``, or None for no pictures.

    Raises:
        ScenarioError: the config is wrong.
    """

    metadata = {"render_modes": MODES, "render_fps": FPS}  # noqa: RUF012  as in gymnasium.Env
    worlds: ClassVar[type[Worlds]] = Worlds

    def __init__(
        self,
        scenario: ScenarioLike = None,
        *,
        reward: rewards.Reward | None = None,
        one_hot: bool = True,
        seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = check_mode(render_mode)
        self._worlds = self.worlds(scenario, [seed], reward=reward, one_hot=one_hot)
        self.scenario, self.simulator = self._worlds.scenario, self._worlds.simulator
        self.observation_space, self.action_space = self._worlds.observation_space, self._worlds.action_space
        self._picture: NetworkPicture | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the next horizon of the seed's stream on an empty network, or with ``seed`` the first of another."""
        super().reset(seed=seed)
        self._worlds.begin([0], [seed])
        return self._worlds.observations()[0], self._info()

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One step of the walk of the request in hand.

        Raises:
            gymnasium.error.ResetNeeded: before the first ``reset``.
        """
        reward = float(self._worlds.step(np.array([action], np.int64))[0])
        return self._worlds.observations()[0], reward, bool(self._worlds.done()[0]), False, self._info()

    def action_masks(self) -> np.ndarray:
        """The actions that are valid now, bool [2 N V + 1], as MaskablePPO asks for them. At least one is valid."""
        return self._worlds.masks()[0]

    def render(self) -> np.ndarray | None:
        """The network as it is now, uint8 [height, width, 3]: see ``NetworkPicture``. None without a render mode."""
        if self.render_mode is None:
            return None
        if self._picture is None:
            self._picture = NetworkPicture(self.simulator)
        return self._picture.draw(0)

    def _info(self) -> dict[str, Any]:
        infos = self._worlds.infos()
        return {name: values[0] if values.ndim > 1 else values[0].item() for name, values in infos.items()}
