"""``PlanEnv`` for Gymnasium. ``import nfv_torchrl.gym.plans`` registers ``nfv_torchrl/Plans-v0``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

import gymnasium
import numpy as np

from nfv_torchrl.gym.single import NFVGymEnv
from nfv_torchrl.gym.vector import NFVVectorEnv
from nfv_torchrl.gym.worlds import ScenarioLike, Worlds
from nfv_torchrl.plans.menus import Menus
from nfv_torchrl.plans.playing import play_menus
from nfv_torchrl.rewards import Reward, admission_regret
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario

PLANS_ID = "nfv_torchrl/Plans-v0"


class PlanWorlds(Worlds):
    """``Worlds`` in which an action is a walk of the request's menu, or reject, the last.

    Args:
        scenario: as for ``Worlds``; reject is always possible.
        seeds: as for ``Worlds``.
        reward: None is ``admission_regret``.
        one_hot: makes no difference.
        threads: not used.
    """

    def __init__(
        self, scenario: ScenarioLike, seeds: Sequence[int], *, reward: Reward | None, one_hot: bool, threads: int = 1
    ) -> None:
        made = paper_scenario() if scenario is None else scenario
        made = made if isinstance(made, Scenario) else Scenario.from_config(made)
        super().__init__(made.replace(admission_control=True), seeds, reward=reward or admission_regret, one_hot=False)
        self.menus = Menus()
        self.menus.prepare(self.simulator.world)
        self._least_cost = np.full(len(seeds), np.nan)
        self._stale = np.ones(len(seeds), np.bool_)
        size = self.menus.shape(self.simulator.world).size
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(self.menus.level) + 1)

    def begin(self, rows: Iterable[int], seeds: Sequence[int | None] | None = None) -> None:
        """See ``Worlds``."""
        super().begin(rows, seeds)
        self._stale[:] = True

    def _act(self, actions: np.ndarray) -> None:
        self._make()
        choices = np.ascontiguousarray(actions, np.int64)
        room = play_menus(self.simulator.world, self.menus.menu, choices, self._least_cost)
        self.simulator.make_room(*room)
        self._stale[:] = True

    def _outcome(self) -> Mapping[str, np.ndarray]:
        return {**super()._outcome(), "least_cost": self._least_cost}

    def _make(self) -> None:
        """Make the menus of what the networks are now, unless that is done already."""
        rows = np.flatnonzero(self._stale)
        if rows.size:
            self.menus.make(self.simulator.world, rows)
            self._stale[:] = False

    def observations(self) -> np.ndarray:
        """See ``Worlds``."""
        self._make()
        return self.menus.flat.copy()

    def masks(self) -> np.ndarray:
        """See ``Worlds``; reject is always valid."""
        self._make()
        return self.menus.menu.mask.copy()


class PlanGymEnv(NFVGymEnv):
    """One network that answers one request a step, by one of the walks of its menu or by a refusal.

    Observation (float32 [P]), actions (a walk for each price level and reject, the last), requests and rewards are
    those of environment 0 of a ``PlanEnv`` with the same seed; the rest is as for ``NFVGymEnv``.
    """

    worlds: ClassVar[type[Worlds]] = PlanWorlds


class PlanVectorEnv(NFVVectorEnv):
    """B environments like ``PlanGymEnv``, made and stepped together; the rest is as for ``NFVVectorEnv``."""

    worlds: ClassVar[type[Worlds]] = PlanWorlds


gymnasium.register(
    id=PLANS_ID,
    entry_point="nfv_torchrl.gym.plans:PlanGymEnv",
    vector_entry_point="nfv_torchrl.gym.plans:PlanVectorEnv",
    order_enforce=False,
    disable_env_checker=True,
)
