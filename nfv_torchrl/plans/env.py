"""``PlanEnv``: one decision a request, among exact walks, as a batched TorchRL environment over the same simulator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Unbounded

from nfv_torchrl.env import ActionSpec, NFVEnv, batch_shape
from nfv_torchrl.observations import ObservationPart, gather
from nfv_torchrl.plans.menus import Menus
from nfv_torchrl.plans.playing import play_menus
from nfv_torchrl.rewards import Reward, admission_regret
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator.state import World

FULLEST = (0.8, 1.0)
"""Used share of the VMs above which large requests are refused while a network is loaded: drawn from this range."""


class PlanEnv(NFVEnv):
    """B networks that answer one request a step: by one of the walks of its menu, or by a refusal.

    A menu (``planners/menu.py``) holds the cheapest walk at each of K price levels, exact, each walk once. The walk
    chosen is played step by step in the simulator of ``NFVEnv``, through the same checks and the same ledger.

    Args:
        scenarios: as for ``NFVEnv``. Those of one batch may differ in ``colocation``. Reject is always possible.
        batch_size: B.
        menus: price levels; default 0, 1, 4, 16 and 64 mean unit costs of the network's VMs.
        reward: as for ``NFVEnv``; default ``admission_regret``. ``outcome`` has ``least_cost``, too: the cost ($) of
            the cheapest walk of the request just answered, NaN if there was none. Its ``step_cost`` is that of all
            steps of the walk, and ``passed`` that of its last.
        observations: further keys to emit; default none.
        stagger: as for ``NFVEnv``, but a network is loaded only up to a use that is drawn from ``FULLEST`` each time:
            a policy that chooses its requests hardly ever meets an over-full one.
        segment: as for ``NFVEnv``.
        seed: as for ``NFVEnv``.
        threads: not used; menus are made by one thread.

    Keys: those of ``NFVEnv`` but for (shapes after the batch dimension)
        ``observation`` float32 [P]: numbers of the network and the request, then a row for each walk, zeros where there
        is none (``MenuShape``; P depends on K and the number of services alone). ``action_mask`` bool [K + 1] and
        ``action`` int64 []: the walk at level k, K refuses. A walk that is the same at two levels is valid at the lower
        one only. ``request_done`` is true after every step, but for a horizon that is over.

    An example, eight networks that take the cheapest walk of each request::

        env = PlanEnv(paper_scenario(), batch_size=8)
        cheapest = TensorDictModule(lambda mask: mask.int().argmax(-1), ["action_mask"], ["action"])
        env.rollout(100, cheapest)["next", "outcome", "accepted"]

    Raises:
        ScenarioError: scenarios that do not fit together.
    """

    def __init__(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int | Sequence[int] = 1,
        *,
        menus: Menus | None = None,
        reward: Reward | None = None,
        observations: Sequence[ObservationPart] = (),
        stagger: bool = False,
        segment: int | None = None,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        scenarios = (scenarios,) if isinstance(scenarios, Scenario) else tuple(scenarios)
        self.menus = menus or Menus()
        colocation = [scenario.colocation for scenario in scenarios]
        batch = batch_shape(batch_size).numel()
        self._colocation = np.array([colocation[b % len(scenarios)] for b in range(batch)])
        self._stale = np.ones(batch, np.bool_)
        self._least_cost = np.full(batch, np.nan)
        # Walks are searched by each environment's own rules. The step checks allow what any of them allows.
        together = [scenario.replace(admission_control=True, colocation=any(colocation)) for scenario in scenarios]
        super().__init__(
            together,
            batch_size,
            reward=reward or admission_regret,
            one_hot=False,
            observations=observations,
            stagger=stagger,
            segment=segment,
            seed=seed,
            threads=threads,
        )
        if stagger:
            self._loader = Loader(self.simulator, fullest=FULLEST, labels=self.menus.labels)

    @property
    def num_actions(self) -> int:
        """The number of price levels, and one more for refusing."""
        return len(self.menus.level) + 1

    def _make_specs(self) -> None:
        self.menus.prepare(self.simulator.world)
        super()._make_specs()
        batch = self.batch_size
        spec = self.observation_spec.clone()
        spec["observation"] = Unbounded((*batch, self.menus.flat.shape[1]), dtype=torch.float32)
        spec["action_mask"] = Binary(self.num_actions, shape=(*batch, self.num_actions), dtype=torch.bool)
        self.observation_spec = spec
        self.action_spec = ActionSpec(self.num_actions, shape=batch, dtype=torch.int64)

    def _worlds(self, rows: np.ndarray) -> Iterator[tuple[World, np.ndarray]]:
        """The world by the rules of some of the environments ``rows``, and these; until there are no others."""
        world = self.simulator.world
        for colocation in (False, True):
            mine = rows[self._colocation[rows] == colocation]
            if mine.size:
                yield world._replace(rules=world.rules._replace(colocation=colocation)), mine

    def _act(self, actions: np.ndarray) -> None:
        choices = np.ascontiguousarray(actions, np.int64)
        room = play_menus(self.simulator.world, self.menus.menu, choices, self._least_cost)
        self.simulator.make_room(*room)
        self._stale[:] = True

    def _outcome(self) -> Mapping[str, np.ndarray]:
        return {**super()._outcome(), "least_cost": self._least_cost}

    def _observe(self) -> TensorDict:
        rows = np.flatnonzero(self._stale)
        for world, mine in self._worlds(rows):
            self.menus.make(world, mine)
        self._stale[:] = False
        flat, mask = torch.from_numpy(self.menus.flat).clone(), torch.from_numpy(self.menus.menu.mask).clone()
        seen = gather({"observation": flat, "action_mask": mask}, self.simulator.batch_size)
        for part in self.parts:
            seen.update(part.read(self.simulator))
        return seen

    def _start(self, rows: np.ndarray) -> None:
        rules = self.simulator.world.rules
        for world, mine in self._worlds(rows):
            # What loads a network keeps to its rules. Pools may have grown since this world was made.
            self.simulator.world = self.simulator.world._replace(rules=world.rules)
            super()._start(mine)
        self.simulator.world = self.simulator.world._replace(rules=rules)
        self._stale[rows] = True

    def _load(self, state_dict) -> None:
        """See ``NFVEnv``; menus follow from the world."""
        self._stale[:] = True
        super()._load(state_dict)
