"""What a network thought of its decisions, for histograms: some of the outputs that decided."""

from __future__ import annotations

from collections import deque

import numpy as np

EVERY, MOST = 16, 4096
"""One decision in so many is looked at, and so many of the last ones are kept."""


class Watch:
    """Pairs of outputs: that of the action taken, and the highest of another valid one (NaN where there was none)."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything: a run begins."""
        self._kept: deque[np.ndarray] = deque(maxlen=MOST)
        self._calls = 0

    def due(self) -> bool:
        """Whether the decision that comes now is to be looked at; to be asked at each."""
        self._calls += 1
        return self._calls % EVERY == 1

    def add(self, pairs: np.ndarray) -> None:
        """Keep ``pairs`` float32 [n, 2]."""
        self._kept.extend(np.array(pairs))

    @property
    def pairs(self) -> np.ndarray:
        """What was kept, float32 [n, 2]."""
        return np.array(self._kept, np.float32).reshape(-1, 2)
