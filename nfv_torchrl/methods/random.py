"""Methods that choose at random among the actions of the mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel


@kernel
def pick_uniform(env, valid, states, actions):
    """One of the valid actions of every environment; ``states`` uint64 [B] (xorshift, never 0) are advanced."""
    for b in range(actions.size):
        x = states[b]
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
        states[b] = x
        actions[b] = valid[b, np.int64((x >> np.uint64(33)) % np.uint64(env[b].mask_count))]


class RandomMethod:
    """``random``: uniform over the mask; ``random_feasible`` with ``mask="feasible"``.

    Each environment draws from a generator of its workload seed, so that a run does not depend on which others are
    made together with it.
    """

    decides_admission = False
    one_hot = False

    def __init__(self, *, name: str = "random", mask: str | None = None) -> None:
        self.name, self.mask = name, mask

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        states = [generator(seed, Stream.EXPLORATION).integers(1, 2**63) for seed in seeds]
        self._states = np.array(states, np.uint64)
        none = np.zeros(0, np.int64)
        pick_uniform(simulator.world.env, simulator.world.seen.valid, self._states, none)

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions = np.empty(simulator.batch_size, np.int64)
        pick_uniform(simulator.world.env, simulator.world.seen.valid, self._states, actions)
        return actions
