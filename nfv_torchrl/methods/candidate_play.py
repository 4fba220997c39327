"""The candidate network inside a compiled loop: rows of features, a small perceptron, the highest score acts."""

from __future__ import annotations

import numpy as np
from torch import nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks.candidate import CandidateNetwork
from nfv_torchrl.observations.candidates import candidate_shape, finish_costs, reference_costs, write_row
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room, request_cost
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME, World

RELU, TANH = 0, 1


@part
def _score(weights, sizes, activation, row, now, after):
    """Output of the perceptron for ``row``; ``now`` and ``after`` are room for its widest layer."""
    for k in range(sizes[0]):
        now[k] = row[k]
    at = 0
    layers = sizes.size - 1
    for layer in range(layers):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        bias = at + inputs * outputs
        for o in range(outputs):
            after[o] = weights[bias + o]
        # Outputs innermost: the compiler turns that loop into vector instructions, and half of the inputs are zero.
        for i in range(inputs):
            value = now[i]
            if value != 0.0:
                first = at + i * outputs
                for o in range(outputs):
                    after[o] += weights[first + o] * value
        at = bias + outputs
        for o in range(outputs):
            if layer == layers - 1:
                now[o] = after[o]
            elif activation == RELU:
                now[o] = max(after[o], np.float32(0.0))
            else:
                now[o] = np.tanh(after[o])
    return now[0]


@part
def _choose(world, b, to_go, references, weights, sizes, activation, row, now, after):
    """The valid action of the highest score."""
    best = np.int64(world.seen.valid[b, 0])
    highest = -np.inf
    for k in range(world.env[b].mask_count):
        action = np.int64(world.seen.valid[b, k])
        row[:] = 0.0
        write_row(world, b, to_go, references, action, row)
        score = _score(weights, sizes, activation, row, now, after)
        if score > highest:
            highest = score
            best = action
    return best


@kernel
def play_candidates(world, b, to_go, references, weights, sizes, activation, row, now, after, costs):
    """Play environment b to the end of its horizon; ``costs`` float64 [R] as in ``planners.learned_prices``.

    Returns FINISHED, or NO_ROOM if the simulator's pools run low; call again to go on.
    """
    e = world.env[b]
    while e.done == 0:
        if not has_room(world, b):
            return NO_ROOM
        request = e.cursor
        while True:
            action = _choose(world, b, to_go, references, weights, sizes, activation, row, now, after)
            step_env(world, b, action)
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
        costs[request] = request_cost(world, b)
    return FINISHED


@kernel
def choose_candidates(world, to_go, references, weights, sizes, activation, row, now, after, actions):
    """Fill ``actions`` int64 [B] with the valid action of the highest score of each environment."""
    for b in range(actions.size):
        actions[b] = _choose(world, b, to_go, references, weights, sizes, activation, row, now, after)


class CandidatePlay:
    """A ``CandidateNetwork`` as a compiled player.

    Raises:
        ScenarioError: a network with several outputs, noisy layers or another activation than ReLU and Tanh.
    """

    def __init__(self, network: CandidateNetwork) -> None:
        linear = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
        others = {type(layer) for layer in network.layers} - {nn.Linear}
        known = {nn.ReLU: RELU, nn.Tanh: TANH}
        if network.outputs != 1 or len(others) > 1 or not others <= set(known):
            raise ScenarioError("network: a compiled candidate network has one output and ReLU or Tanh layers")
        self._activation = known[next(iter(others))] if others else RELU
        self._sizes = np.array([linear[0].in_features, *(layer.out_features for layer in linear)], np.int64)
        parts = [part.detach().cpu().numpy().ravel() for layer in linear for part in (layer.weight.T, layer.bias)]
        self._weights = np.concatenate(parts).astype(np.float32)  # [inputs, outputs] of each layer, then its bias
        widest = int(self._sizes.max())
        self._now, self._after = np.zeros(widest, np.float32), np.zeros(widest, np.float32)

    def prepare(self, world: World) -> None:
        """See ``Player``."""
        self._to_go = finish_costs(world.tables, world.rules)
        self._references = reference_costs(world.tables, self._to_go)
        self._row = np.zeros(candidate_shape(world.tables)[1], np.float32)

    def play(self, simulator: Simulator, b: int, costs: np.ndarray) -> None:
        """See ``Player``."""
        network = (self._weights, self._sizes, self._activation, self._row, self._now, self._after)
        while play_candidates(simulator.world, b, self._to_go, self._references, *network, costs) == NO_ROOM:
            simulator.make_room_for(b)

    def choose(self, simulator: Simulator) -> np.ndarray:
        """The valid action of the highest output of each environment, int64 [B]."""
        network = (self._weights, self._sizes, self._activation, self._row, self._now, self._after)
        actions = np.empty(simulator.batch_size, np.int64)
        choose_candidates(simulator.world, self._to_go, self._references, *network, actions)
        return actions
