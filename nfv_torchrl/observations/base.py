"""The interface of a part of the observation, and how parts make the whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from tensordict import TensorDict
from torchrl.data import TensorSpec

from nfv_torchrl.simulator import Simulator


class ObservationPart(Protocol):
    """Some keys of ``NFVEnv``'s observation."""

    def specs(self, simulator: Simulator) -> dict:
        """The spec of every key, each of shape [B, ...]."""
        ...

    def read(self, simulator: Simulator) -> dict:
        """The present value of every key, in tensors that later steps do not write into."""
        ...


Specs = dict[str, TensorSpec]
Values = dict[str, torch.Tensor]


def read_observation(simulator: Simulator, parts: Sequence[ObservationPart]) -> TensorDict:
    """What a controller sees now, batch size [B]: ``observation``, ``action_mask`` and the keys of ``parts``.

    The tensors are fresh: later steps write into the simulator's arrays, not into them.
    """
    view = simulator.world.seen
    seen = {"observation": torch.from_numpy(view.flat).clone(), "action_mask": torch.from_numpy(view.mask).clone()}
    for part in parts:
        seen.update(part.read(simulator))
    return TensorDict(seen, batch_size=[simulator.batch_size])
