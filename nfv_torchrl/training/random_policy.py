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
    """Reads ``action_mask`` bool [..., A], writes ``action`` int64 [...]. Every row of a mask has a valid action."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["action_mask"], ["action"]
        self._rng = generator(seed, Stream.EXPLORATION)
        self._states = np.zeros(0, np.uint64)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("action_mask")
        flat = mask.reshape(-1, mask.shape[-1])
        if self._states.size < len(flat):
            self._states = self._rng.integers(1, 2**63, len(flat)).astype(np.uint64)
        actions = torch.empty(mask.shape[:-1], dtype=torch.int64)
        pick_from_mask(flat.cpu().numpy(), self._states, actions.reshape(-1).numpy())
        return tensordict.set("action", actions.to(mask.device))
