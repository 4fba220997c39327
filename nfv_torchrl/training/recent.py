"""Replay that prefers what came last."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from nfv_torchrl.settings.values import AtLeastOne


class RecentSampler(Sampler):
    r"""Draws items by a power law of their age, with replacement.

    Of n items the one that is a-th from the newest (0: the newest) is drawn with probability

    $$
    \Big(\frac{a + 1}{n}\Big)^{1 / k} - \Big(\frac{a}{n}\Big)^{1 / k}
    $$

    with k the ``preference``: 1 is uniform, and with 2 half of what is drawn is among the newest quarter. The idea is
    from Wang, Ross, "Boosting Soft Actor-Critic: Emphasizing Recent Experience without Forgetting the Past", 2019: the
    newest items come from the policy that is being learned, the others keep it from forgetting. There are no weights
    that would make up for the choice, since the choice is meant. torch's global random numbers decide.

    It belongs to a writer that goes round the memory (``TensorDictRoundRobinWriter``), which is where ages come from.

    Args:
        preference: k.
    """

    def __init__(self, preference: AtLeastOne = 2.0) -> None:
        self.preference = preference
        self._newest = -1

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Places in ``storage``, int64 [batch_size], and nothing to say of them."""
        size = len(storage)
        # In float64: of float32 numbers from 0 to 1 the smallest are too far apart for large memories.
        shares = torch.rand(batch_size, dtype=torch.float64) ** self.preference
        ages = (shares * size).long().clamp_(max=size - 1)
        places = (self._newest - ages) % size
        return places.to(storage.device), {}

    def extend(self, index: Tensor) -> None:
        """Items were written at ``index`` int64 [n], the last of which is the newest."""
        self._newest = int(index[-1])

    def add(self, index: int) -> None:
        """One item was written at ``index``."""
        self._newest = int(index)

    def state_dict(self) -> dict[str, int]:
        """Where the newest item is."""
        return {"newest": self._newest}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on from ``state_dict()``."""
        self._newest = state["newest"]

    def _empty(self) -> None:
        self._newest = -1

    def dumps(self, path: str | Path) -> None:
        """Not needed: checkpoints use ``state_dict``."""
        raise NotImplementedError

    def loads(self, path: str | Path) -> None:
        """Not needed: checkpoints use ``state_dict``."""
        raise NotImplementedError
