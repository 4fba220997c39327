"""The interface of a part of the observation, and how parts make the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

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


@runtime_checkable
class KnowingPart(Protocol):
    """A part that knows more of the request in hand than the simulator's outcome says."""

    def known(self) -> Mapping[str, Any]:
        """Float64 [B] by name, for rewards: of the requests that were in hand at the last ``read``."""
        ...


Specs = dict[str, TensorSpec]
Values = dict[str, torch.Tensor]


CPU = torch.device("cpu")


def gather(values: Mapping[str, Any], batch: int) -> TensorDict:
    """``values`` by key, batch size [B], on the CPU. Mappings among them become nested.

    They are taken as they are: ``TensorDict(values)`` looks at the shape and the device of each one, which takes longer
    than a step of the simulator. Only what this package has made itself may come here.
    """
    return TensorDict._new_unsafe(values, batch_size=torch.Size([batch]), device=CPU)


def read_observation(simulator: Simulator, parts: Sequence[ObservationPart]) -> TensorDict:
    """What a controller sees now, batch size [B]: ``observation``, ``action_mask`` and the keys of ``parts``.

    The tensors are fresh: later steps write into the simulator's arrays, not into them.
    """
    view = simulator.world.seen
    seen = {"observation": torch.from_numpy(view.flat).clone(), "action_mask": torch.from_numpy(view.mask).clone()}
    whole = gather(seen, simulator.batch_size)
    for part in parts:
        whole.update(part.read(simulator))
    return whole
