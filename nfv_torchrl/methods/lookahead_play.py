"""The look-ahead network inside a compiled loop: rows of what is offered now, two learned prices, the highest value
acts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.methods.candidate_play import is_highest
from nfv_torchrl.methods.watching import EVERY, MOST
from nfv_torchrl.networks.compiled import CompiledPerceptron, compiled_perceptron, outputs_of
from nfv_torchrl.networks.lookahead import DEAD, TIE, LookaheadNetwork
from nfv_torchrl.observations.ahead import Looking, look_from
from nfv_torchrl.observations.candidates import candidate_rows
from nfv_torchrl.observations.lookahead import FEATURES, ROW, fill_rows
from nfv_torchrl.observations.standing import FACTORS, STATE, state_scales
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room
from nfv_torchrl.search.walks import OVERFLOW
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import World


class Deciding(NamedTuple):
    """What decides between rows; V is the same for all of them."""

    prices: CompiledPerceptron
    w_acc: float
    w_cost: float
    rows: np.ndarray  # float32 [C, F]
    state: np.ndarray  # float32 [S]


@part
def _way(own, spare, cost, regret):
    return own.w_acc - own.w_cost * (cost - 1.0) - spare * regret


@part
def _choose(world, b, ahead, scales, own, values):
    """The valid action of the highest value.

    ``values`` float32 [2]: its value less V, and the highest of another valid action (NaN if there is none).
    """
    for k in range(world.env[b].mask_count):
        for column in range(own.rows.shape[1]):
            own.rows[k, column] = 0.0
    for k in range(own.state.size):
        own.state[k] = 0.0
    count = fill_rows(world, b, ahead, scales, own.rows, own.state)
    net = own.prices
    for k in range(FACTORS, own.state.size):
        net.now[k - FACTORS] = own.state[k]
    outputs_of(net.weights, net.sizes, net.activation, net.now, net.after)
    spare = max(np.float64(net.now[0]), 0.0)
    bid = np.float64(net.now[1]) * own.state[STATE.demand] * own.state[STATE.stay]
    best = np.int64(world.seen.valid[b, 0])
    values[0] = values[1] = np.float32(-np.inf)
    for k in range(count):
        row = own.rows[k]
        score = -DEAD
        if row[ROW.reject] > 0.0:
            score = 0.0
        elif row[ROW.fits] > 0.0:
            score = _way(own, spare, row[ROW.cost], row[ROW.priced_regret])
            score = max(score, _way(own, spare, row[ROW.spare_cost], row[ROW.spare_regret]))
            score -= bid + TIE * (1.0 - row[ROW.planned])
        if is_highest(np.float32(score), values):
            best = np.int64(world.seen.valid[b, k])
    if count < 2:
        values[1] = np.float32(np.nan)
    return best


@kernel
def choose_lookahead(world, ahead, scales, own, actions, values):
    """Fill ``actions`` int64 [B] and ``values`` float32 [B, 2], by what ``Ahead`` knows."""
    for b in range(actions.size):
        actions[b] = _choose(world, b, ahead, scales, own, values[b])


@kernel
def play_lookahead(world, b, ahead, scales, own, begun, values):
    """Play environment b to the end of its horizon, or until something runs low (provide it and call again).

    ``begun``: steps made before. ``values`` float32 [MOST, 2]: those of every EVERY-th step, the last ones.
    Returns FINISHED, NO_ROOM (in the simulator's pools) or OVERFLOW (of the search's scratch), and the steps made.
    """
    steps = begun
    while world.env[b].done == 0:
        if world.env[b].steps == 0 and not has_room(world, b):
            return NO_ROOM, steps
        if look_from(world, b, ahead) == OVERFLOW:
            return OVERFLOW, steps
        action = _choose(world, b, ahead, scales, own, values[steps // EVERY % values.shape[0]])
        step_env(world, b, action)
        steps += 1
    return FINISHED, steps


class LookaheadPlay:
    """A ``LookaheadNetwork`` as a compiled player, with the weights that it has now.

    Raises:
        ScenarioError: a network with several outputs, or another activation than ReLU and Tanh.
    """

    def __init__(self, network: LookaheadNetwork) -> None:
        # Not a class derived from it, which may compute something else.
        if type(network) is not LookaheadNetwork or network.outputs != 1:
            raise ScenarioError("network: a compiled one is a LookaheadNetwork with one output")
        self._network, self._prices = network, compiled_perceptron(network.prices)

    def prepare(self, world: World) -> None:
        """Allocate what playing in the simulator of ``world`` needs."""
        network = self._network
        self._looking = Looking(exact=network.exact, price=network.at)
        self._scales = state_scales(world.tables, network.at_once)
        rows = np.zeros((candidate_rows(world.tables, world.rules), len(FEATURES)), np.float32)
        state = np.zeros(len(STATE), np.float32)
        self._own = Deciding(self._prices, network.w_acc, network.w_cost, rows, state)

    def play(self, simulator: Simulator, b: int) -> np.ndarray:
        """Answer all requests of environment b. Returns some of the values that decided, as ``choose`` has them."""
        looking = self._looking
        looking.prepare(simulator.world)
        values, state, steps = np.full((MOST, 2), np.nan, np.float32), NO_ROOM, 0
        while state != FINISHED:
            state, steps = play_lookahead(simulator.world, b, looking.ahead, self._scales, self._own, steps, values)
            if state == NO_ROOM:
                simulator.make_room_for(b)
            elif state == OVERFLOW:
                looking.grow(simulator.world)
        return values[: -(-steps // EVERY)]

    def choose(self, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
        """The valid action of the highest value of each environment, int64 [B], and two values float32 [B, 2], less V:
        its own, and the highest of another valid action (NaN where there is none)."""
        world = simulator.world
        actions = np.empty(simulator.batch_size, np.int64)
        values = np.empty((simulator.batch_size, 2), np.float32)
        choose_lookahead(world, self._looking.look(world), self._scales, self._own, actions, values)
        return actions, values
