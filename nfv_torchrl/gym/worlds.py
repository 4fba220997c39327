"""What the Gymnasium environments have in common: B networks, each with horizons of its own seed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from nfv_torchrl import rewards
from nfv_torchrl.scenario.config import ScenarioConfig
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.scenario.streams import check_seed
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import OUTCOME

ScenarioLike = Scenario | Mapping[str, Any] | ScenarioConfig | None
"""A scenario, its config, or None for the paper's."""


class Worlds:
    """B networks. Network b plays the horizons of its own seed one after the other, as environment 0 of an ``NFVEnv``.

    Args:
        scenario: a scenario, or its config as a mapping; None is the paper's.
        seeds: one for each network.
        reward: see ``nfv_torchrl.rewards``; None is ``admission_step_cost``.
        one_hot: append one-hot service type, current node, egress and function index to the observation.
        threads: threads that split the batch inside the simulator.

    Raises:
        ScenarioError: the config or a seed is wrong.
    """

    def __init__(
        self,
        scenario: ScenarioLike,
        seeds: Sequence[int],
        *,
        reward: rewards.Reward | None,
        one_hot: bool,
        threads: int = 1,
    ) -> None:
        scenario = paper_scenario() if scenario is None else scenario
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.from_config(scenario)
        self.simulator = Simulator(self.scenario, len(seeds), one_hot=one_hot, threads=threads)
        self.reward = rewards.prepared(reward, self.simulator)
        self.cost_scale = rewards.cost_scale(self.simulator.tables, self.simulator.world.env["net"])
        self.seeds, self.episodes = list(seeds), [-1] * len(seeds)
        for seed in seeds:
            check_seed(seed)
        size = self.simulator.world.seen.flat.shape[1]
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(self.simulator.num_actions)

    def begin(self, rows: Iterable[int], seeds: Sequence[int | None] | None = None) -> None:
        """The next horizon of each network of ``rows``; of those with a new seed (``seeds`` [B]) its first."""
        for b in rows:
            seed = None if seeds is None else seeds[b]
            if seed is not None:
                check_seed(seed)
                self.seeds[b], self.episodes[b] = seed, -1
            self.episodes[b] += 1
            key = (0, self.episodes[b])
            workload = self.scenario.workload(self.seeds[b], *key)
            self.simulator.start(b, workload, self.scenario.failure_timeline(self.seeds[b], *key))

    def step(self, actions: np.ndarray) -> np.ndarray:
        """One step of every network with ``actions`` int64 [B]; returns rewards float64 [B]."""
        if min(self.episodes) < 0:
            raise gymnasium.error.ResetNeeded("call reset() before the first step")
        self._act(actions)
        return np.array(self.reward(self._outcome(), self.cost_scale), np.float64)

    def _act(self, actions: np.ndarray) -> None:
        """Carry out ``actions`` int64 [B]."""
        self.simulator.step(actions)

    def _outcome(self) -> Mapping[str, np.ndarray]:
        """What the last step brought, for the reward, float64 [B] by name."""
        return self.simulator.outcome

    def done(self) -> np.ndarray:
        """Horizons that are over, bool [B]."""
        return self.simulator.world.env["done"] > 0

    def observations(self) -> np.ndarray:
        """What is seen now, float32 [B, P], in an array of its own."""
        return self.simulator.world.seen.flat.copy()

    def masks(self) -> np.ndarray:
        """The actions that are valid now, bool [B, A], in an array of its own."""
        return self.simulator.world.seen.mask.copy()

    def infos(self) -> dict[str, np.ndarray]:
        """``action_mask`` int8 [B, A], and of the last step, [B] each, what ``NFVGymEnv`` says of it."""
        outcome = self.simulator.world.outcome
        return {
            "action_mask": self.masks().astype(np.int8),
            "request_done": outcome[:, OUTCOME.request_done] > 0,
            "accepted": outcome[:, OUTCOME.accepted] > 0,
            "rejection_reason": outcome[:, OUTCOME.reason].astype(np.int64),
            "request_cost": outcome[:, OUTCOME.request_cost].copy(),
        }
