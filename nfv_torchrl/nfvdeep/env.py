"""``NFVdeepEnv``: the decisions of NFVdeep as a batched TorchRL environment over the same simulator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Unbounded

from nfv_torchrl.env import ActionSpec, NFVEnv
from nfv_torchrl.nfvdeep.draft_checks import restore_drafts
from nfv_torchrl.nfvdeep.drafts import advance, begin_env, make_drafts
from nfv_torchrl.nfvdeep.planner import NFVdeepPlanner, check_requests
from nfv_torchrl.nfvdeep.reward import Profit
from nfv_torchrl.observations import gather
from nfv_torchrl.rewards import Reward
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.state_checks import check_arrays


class NFVdeepEnv(NFVEnv):
    """B networks whose requests are planned one function a decision, then played step by step in the simulator.

    A decision puts the next function on a node; ``NFVdeepPlanner`` says what follows from it. Nothing is reserved
    before the plan is complete. Then it is walked like any method's, through the same step checks and the same ledger.

    Args:
        scenarios: as for ``NFVEnv``; reject is always possible in the simulator, so that a failed plan can be refused.
        batch_size: as for ``NFVEnv``.
        planner: how plans are made of decisions.
        reward: as for ``NFVEnv``; default ``Profit``.
        stagger: as for ``NFVEnv``.
        segment: as for ``NFVEnv``.
        seed: as for ``NFVEnv``.
        threads: as for ``NFVEnv``.

    Keys: those of ``NFVEnv`` but for (shapes after the batch dimension)
        ``observation`` float32 [4 N + 4]: free VM capacity of each node and free capacity of its links, less what the
        plan in hand uses, as shares of the largest node's; load (of the largest), rate (of the largest), delay left (of
        the tolerable) and functions left (of the longest chain); one-hot node the walk is at (at first the ingress) and
        egress. ``action_mask`` bool [N + 1] and ``action`` int64 []: the node of the next function, N refuses; it is
        valid only where no node is left, unless the planner may refuse.
    """

    def __init__(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int | Sequence[int] = 1,
        *,
        planner: NFVdeepPlanner | None = None,
        reward: Reward | None = None,
        stagger: bool = False,
        segment: int | None = None,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        scenarios = (scenarios,) if isinstance(scenarios, Scenario) else scenarios
        self.planner = planner or NFVdeepPlanner()
        scenarios = [scenario.replace(admission_control=True) for scenario in scenarios]
        super().__init__(
            scenarios,
            batch_size,
            reward=reward or Profit(),
            one_hot=False,
            observations=(),
            stagger=stagger,
            segment=segment,
            seed=seed,
            threads=threads,
        )

    @property
    def num_actions(self) -> int:
        """The number of nodes, and one more for refusing."""
        return self.drafts.mask.shape[1]

    def _make_specs(self) -> None:
        world = self.simulator.world
        check_requests(world)
        self.drafts = make_drafts(world.tables, world.rules, self.simulator.batch_size)
        super()._make_specs()
        batch = self.batch_size
        spec = self.observation_spec.clone()
        spec["observation"] = Unbounded((*batch, self.drafts.flat.shape[1]), dtype=torch.float32)
        spec["action_mask"] = Binary(self.num_actions, shape=(*batch, self.num_actions), dtype=torch.bool)
        self.observation_spec = spec
        self.action_spec = ActionSpec(self.num_actions, shape=batch, dtype=torch.int64)

    def _act(self, actions: np.ndarray) -> None:
        choices = np.ascontiguousarray(actions, np.int64)
        room = advance(self.simulator.world, self.planner.options, self.drafts, choices)
        self.simulator.make_room(*room)

    def _observe(self) -> TensorDict:
        flat, mask = torch.from_numpy(self.drafts.flat).clone(), torch.from_numpy(self.drafts.mask).clone()
        return gather({"observation": flat, "action_mask": mask}, self.simulator.batch_size)

    def _start(self, rows: np.ndarray) -> None:
        super()._start(rows)
        for b in rows.tolist():
            begin_env(self.simulator.world, self.planner.options, self.drafts, b)

    def state_dict(self, *args, **kwargs) -> dict:
        """As that of ``NFVEnv``, and the plans under construction."""
        drafts = {name: torch.from_numpy(array.copy()) for name, array in self.drafts._asdict().items()}
        return super().state_dict(*args, **kwargs) | {"drafts": drafts}

    def _state_keys(self) -> set[str]:
        return super()._state_keys() | {"drafts"}

    def _load(self, state_dict) -> None:
        """See ``NFVEnv``."""
        super()._load(state_dict)
        saved = check_arrays("env.drafts", state_dict["drafts"])
        world, started = self.simulator.world, self._episode >= 0
        self.drafts = restore_drafts(world, self.planner.options, self.drafts, saved, started)
