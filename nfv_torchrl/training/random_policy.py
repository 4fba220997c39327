"""A uniformly random masked policy: what a collector runs before anything has been learned, and in benchmarks."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.simulator.compiled import kernel


@kernel
def pick_from_mask(mask, states, actions):
    """A uniformly random True of each row of ``mask`` bool [B, A]; ``states`` uint64 [B] (xorshift) are advanced."""
    for b in range(mask.shape[0]):
        x = states[b]
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
        states[b] = x
        count = 0
        for k in range(mask.shape[1]):
            count += mask[b, k]
        left = np.int64((x >> np.uint64(33)) % np.uint64(count))
        for k in range(mask.shape[1]):
            if mask[b, k]:
                if left == 0:
                    actions[b] = k
                    break
                left -= 1


class RandomPolicy(TensorDictModuleBase):
    """Reads ``action_mask`` bool [B, A], writes ``action`` int64 [B]. Every row of a mask has a valid action."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["action_mask"], ["action"]
        self._rng = generator(seed, Stream.EXPLORATION)
        self._states = np.zeros(0, np.uint64)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("action_mask")
        rows = mask.shape[0]
        if self._states.size < rows:
            self._states = self._rng.integers(1, 2**63, rows).astype(np.uint64)
        actions = torch.empty(rows, dtype=torch.int64)
        pick_from_mask(mask.cpu().numpy(), self._states, actions.numpy())
        return tensordict.set("action", actions.to(mask.device))
