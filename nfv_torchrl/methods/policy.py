"""The method of a TorchRL actor: its greedy action, step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nfv_torchrl.losses.actors import scorer
from nfv_torchrl.methods.watching import Watch
from nfv_torchrl.observations import ObservationPart, read_observation
from nfv_torchrl.simulator import Simulator


class PolicyMethod:
    """The greedy actions of a TorchRL actor.

    Args:
        actor: reads the keys of ``NFVEnv`` that it was trained on, writes ``action`` int64 [B]. What it writes below
            ``next`` (a recurrent state) is given back to it with the next step.
        parts: the parts of the observation that it reads, as given to ``NFVEnv``.
        name: what tables and folders call it.
        one_hot: as given to ``NFVEnv``.
        mask: the mask that it was trained with, None: the scenario's.
        decides_admission: whether it was trained with ``admission_control`` while the scenario may not have it.
        device: where the actor lives.

    Attributes:
        watch: some of the scores that decided, in the last run; none of an actor of another kind.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        parts: Sequence[ObservationPart] = (),
        *,
        name: str = "policy",
        one_hot: bool = True,
        mask: str | None = None,
        decides_admission: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        self.actor, self.name, self.parts, self.one_hot = actor, name, tuple(parts), one_hot
        self.mask, self.decides_admission, self.device = mask, decides_admission, device
        self._scorer = scorer(actor)
        self._carried: TensorDictBase | None = None
        self.watch = Watch()

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._carried = None
        self.act(simulator)  # the first call allocates and may compile
        self._carried = None
        self.watch.clear()

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        if self._scorer is not None:
            return self._highest(simulator, self._scorer)
        seen = read_observation(simulator, self.parts)
        if self.device is not None:
            seen = seen.to(self.device)
        if self._carried is not None:
            seen.update(self._carried)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            answer = self.actor(seen)
        self._carried = answer.get("next", None)
        return answer.get("action").cpu().numpy()

    def _highest(self, simulator: Simulator, scores: TensorDictModule) -> np.ndarray:
        """The valid action of the highest score; without the actor's own bookkeeping, a step costs half as much."""
        view = simulator.world.seen
        mask = torch.from_numpy(view.mask)
        seen: dict[str, Any] = {"observation": torch.from_numpy(view.flat), "action_mask": mask}
        for part in self.parts:
            seen.update(part.read(simulator))
        inputs = [_take(seen, key) for key in scores.in_keys]
        if self.device is not None:
            inputs = [value.to(self.device) for value in inputs]
        with torch.no_grad():
            values = scores.module(*inputs).cpu()
        values = values.masked_fill(~mask, -torch.inf)
        if self.watch.due():
            live = torch.from_numpy(simulator.world.env["done"] == 0)
            self.watch.add(values[live].topk(2).values.numpy())
        return values.argmax(-1).numpy()


def _take(seen: Mapping[str, Any], key: str | tuple[str, ...]) -> torch.Tensor:
    """The value of a key, nested or not."""
    if isinstance(key, str):
        return seen[key]
    nested: TensorDict = seen[key[0]]
    return nested.get(key[1:])
