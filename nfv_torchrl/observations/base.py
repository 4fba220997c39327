"""The interface of a part of the observation."""

from __future__ import annotations

from typing import Protocol

import torch
from torchrl.data import TensorSpec

from nfv_torchrl.simulator import Simulator


class ObservationPart(Protocol):
    """Some keys of ``NFVEnv``'s observation."""

    def specs(self, simulator: Simulator) -> dict:
        """The spec of every key, each of shape [B, ...]."""
        ...

    def read(self, simulator: Simulator) -> dict:
        """Every key's value now, in tensors that later steps do not write into."""
        ...


Specs = dict[str, TensorSpec]
Values = dict[str, torch.Tensor]
