"""The environment for Gymnasium, for libraries such as MaskablePPO of sb3-contrib that know nothing of TorchRL.

``import nfv_torchrl.gym`` registers ``nfv_torchrl/NFV-v0``::

    env = gymnasium.make("nfv_torchrl/NFV-v0", scenario={"substrate": {"nodes": 20}}, seed=1)

It is a class of its own over the simulator rather than ``NFVEnv`` through ``EnvBase.register_gym``: maskable agents
call ``action_masks()`` on the environment, which a registered TorchRL environment does not have, and a single network
needs none of the tensors in between.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from nfv_torchrl import rewards
from nfv_torchrl.scenario.config import ScenarioConfig
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import OUTCOME

ENV_ID = "nfv_torchrl/NFV-v0"


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

    Raises:
        ScenarioError: the config is wrong.
    """

    def __init__(
        self,
        scenario: Scenario | Mapping[str, Any] | ScenarioConfig | None = None,
        *,
        reward: rewards.Reward | None = None,
        one_hot: bool = True,
        seed: int = 0,
    ) -> None:
        if scenario is None:
            scenario = paper_scenario()
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.from_config(scenario)
        self.simulator = Simulator(self.scenario, 1, one_hot=one_hot)
        self.reward = rewards.prepared(reward, self.simulator)
        self.cost_scale = rewards.cost_scale(self.simulator.tables, self.simulator.world.env["net"])
        self._seed = seed
        self._episode = -1
        size = self.simulator.world.seen.flat.shape[1]
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(self.simulator.num_actions)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the next horizon of the seed's stream on an empty network, or with ``seed`` the first of another."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed, self._episode = seed, -1
        self._episode += 1
        key = (0, self._episode)
        workload = self.scenario.workload(self._seed, *key)
        self.simulator.start(0, workload, self.scenario.failure_timeline(self._seed, *key))
        return self._observation(), self._info()

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One step of the walk of the request in hand."""
        self.simulator.step(np.array([action], np.int64))
        reward = float(self.reward(self.simulator.outcome, self.cost_scale)[0])
        done = bool(self.simulator.world.env["done"][0])
        return self._observation(), reward, done, False, self._info()

    def action_masks(self) -> np.ndarray:
        """The actions that are valid now, bool [2 N V + 1], as MaskablePPO asks for them. At least one is valid."""
        return self.simulator.world.seen.mask[0].copy()

    def _observation(self) -> np.ndarray:
        return self.simulator.world.seen.flat[0].copy()

    def _info(self) -> dict[str, Any]:
        outcome = self.simulator.world.outcome[0]
        return {
            "action_mask": self.action_masks().astype(np.int8),
            "request_done": bool(outcome[OUTCOME.request_done]),
            "accepted": bool(outcome[OUTCOME.accepted]),
            "rejection_reason": int(outcome[OUTCOME.reason]),
            "request_cost": float(outcome[OUTCOME.request_cost]),
        }


gymnasium.register(id=ENV_ID, entry_point="nfv_torchrl.gym:NFVGymEnv")
