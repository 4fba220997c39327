"""What a policy passes on to its next step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from nfv_torchrl.simulator import Simulator
from nfv_torchrl.state_checks import check_keys, check_tensor


class MemoryObservation:
    """Key ``memory`` float32 [B, size]: what the policy wrote to ``("next", "memory")`` with its last step.

    Zeros at the beginning of a horizon; the end of a request leaves it alone. ``NFVEnv`` keeps it with its own state,
    so that a resumed run goes on with the same memory. A policy that writes nothing there sees zeros.

    Args:
        size: H.
    """

    key = "memory"

    def __init__(self, size: int) -> None:
        self.size = size
        self._kept: Tensor | None = None

    def _values(self, batch: int) -> Tensor:
        if self._kept is None or len(self._kept) != batch:
            self._kept = torch.zeros(batch, self.size)
        return self._kept

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        return {self.key: Unbounded((simulator.batch_size, self.size), dtype=torch.float32)}

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        return {self.key: self._values(simulator.batch_size).clone()}

    def keep(self, tensordict: TensorDictBase, done: Tensor) -> None:
        """Take over what a step's ``tensordict`` [B] holds below ``next``; ``done`` bool [B, 1] forgets."""
        written = tensordict.get(("next", self.key), None)
        if written is not None:
            self._kept = written.detach().cpu().masked_fill(done, 0.0)

    def forget(self, rows: np.ndarray, batch: int) -> None:
        """Set the memory of the environments ``rows`` to zeros."""
        self._values(batch)[torch.from_numpy(rows)] = 0.0

    def state_dict(self) -> dict:
        """The memory of every environment."""
        return {} if self._kept is None else {self.key: self._kept.clone()}

    def check_state(self, state: Any, batch: int) -> dict[str, Tensor]:
        """``state`` if it is one of ``batch`` environments.

        Raises:
            CheckpointError: it is not.
        """
        check_keys("env.memories", state, (self.key,) if state else ())
        for value in state.values():
            check_tensor(f"env.memories.{self.key}", value, torch.float32, (batch, self.size))
        return dict(state)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from ``state_dict()``."""
        self._kept = state[self.key].clone() if self.key in state else None
