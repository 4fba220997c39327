"""The candidate network inside a compiled loop: rows of features, a small perceptron, the highest score acts."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks.candidate import CandidateNetwork
from nfv_torchrl.networks.compiled import compiled_perceptron, score_row
from nfv_torchrl.observations.candidates import write_row
from nfv_torchrl.observations.costs_to_go import costs_to_go
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room, request_cost
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME, World


@part
def is_highest(score, values):
    """Whether ``score`` is above all before it; ``values`` float32 [2] keeps the two highest."""
    if score > values[0]:
        values[1] = values[0]
        values[0] = score
        return True
    if score > values[1]:
        values[1] = score
    return False


@part
def _choose(world, b, to_go, weights, sizes, activation, row, now, after, values):
    """The valid action of the highest score.

    ``values`` float32 [2]: its score, and the highest of another valid action (NaN if there is none).
    """
    best = np.int64(world.seen.valid[b, 0])
    values[0] = values[1] = np.float32(-np.inf)
    for k in range(world.env[b].mask_count):
        action = np.int64(world.seen.valid[b, k])
        row[:] = 0.0
        write_row(world, b, to_go, action, row)
        score = score_row(weights, sizes, activation, row, now, after)
        if is_highest(score, values):
            best = action
    if world.env[b].mask_count < 2:
        values[1] = np.float32(np.nan)
    return best


@kernel
def play_candidates(world, b, to_go, weights, sizes, activation, row, now, after, values, costs):
    """Play environment b to the end of its horizon; ``costs`` float64 [R] as in ``planners.learned_prices``.

    Returns FINISHED, or NO_ROOM if the simulator's pools run low; call again to go on.
    """
    e = world.env[b]
    while e.done == 0:
        if not has_room(world, b):
            return NO_ROOM
        request = e.cursor
        while True:
            action = _choose(world, b, to_go, weights, sizes, activation, row, now, after, values)
            step_env(world, b, action)
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
        costs[request] = request_cost(world, b)
    return FINISHED


@kernel
def choose_candidates(world, to_go, weights, sizes, activation, row, now, after, actions, values):
    """Fill ``actions`` int64 [B] with the valid action of the highest score of each environment, ``values`` [B, 2]."""
    for b in range(actions.size):
        actions[b] = _choose(world, b, to_go, weights, sizes, activation, row, now, after, values[b])


class CandidatePlay:
    """A ``CandidateNetwork`` as a compiled player.

    Raises:
        ScenarioError: a network with several outputs, noisy layers or another activation than ReLU and Tanh.
    """

    def __init__(self, network: CandidateNetwork) -> None:
        # Not a class derived from it, which may compute something else.
        if type(network) is not CandidateNetwork or network.outputs != 1 or network.noisy:
            raise ScenarioError("network: a compiled one is a CandidateNetwork with one output and no noise")
        self._weights, self._sizes, self._activation, self._now, self._after = compiled_perceptron(network.layers)
        self._features = network.features

    def prepare(self, world: World) -> None:
        """See ``Player``."""
        self._to_go = costs_to_go(world.tables, world.rules)
        self._row = np.zeros(self._features, np.float32)
        self._values = np.zeros(2, np.float32)

    def play(self, simulator: Simulator, b: int, costs: np.ndarray) -> None:
        """See ``Player``."""
        fixed = (self._to_go, *self._network(), self._values)
        while play_candidates(simulator.world, b, *fixed, costs) == NO_ROOM:
            simulator.make_room_for(b)

    def choose(self, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
        """The valid action of the highest output of each environment, int64 [B], and two outputs float32 [B, 2]: its
        own, and the highest of another valid action (NaN where there is none)."""
        actions = np.empty(simulator.batch_size, np.int64)
        values = np.empty((simulator.batch_size, 2), np.float32)
        choose_candidates(simulator.world, self._to_go, *self._network(), actions, values)
        return actions, values

    def _network(self) -> tuple:
        return self._weights, self._sizes, self._activation, self._row, self._now, self._after
