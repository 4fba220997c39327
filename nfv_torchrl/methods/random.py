"""Methods that choose at random among the actions of the mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.search.playing import has_room
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME


@part
def _pick(world, b, states):
    """One of the valid actions of environment b, whose state is advanced."""
    x = states[b]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    states[b] = x
    return np.int64(world.seen.valid[b, np.int64((x >> np.uint64(33)) % np.uint64(world.env[b].mask_count))])


@kernel
def pick_uniform(world, states, actions):
    """One of the valid actions of every environment; ``states`` uint64 [B] (xorshift, never 0) are advanced."""
    for b in range(actions.size):
        actions[b] = _pick(world, b, states)


@kernel
def play_uniform(world, b, states):
    """Play environment b to the end of its horizon, or until the simulator's pools run low (then call again).

    Returns whether it is over.
    """
    while world.env[b].done == 0:
        if not has_room(world, b):
            return False
        while True:
            step_env(world, b, _pick(world, b, states))
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
    return True


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
        pick_uniform(simulator.world, self._states, np.zeros(0, np.int64))  # compiles

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions = np.empty(simulator.batch_size, np.int64)
        pick_uniform(simulator.world, self._states, actions)
        return actions

    def play(self, simulator: Simulator, b: int) -> None:
        """See ``WholePlay``."""
        while not play_uniform(simulator.world, b, self._states):
            simulator.make_room_for(b)
