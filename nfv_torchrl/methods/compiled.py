"""How the greedy policy of a trained network acts in an evaluation: compiled where it can be, else through torch."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import QValueActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import scorer
from nfv_torchrl.methods.base import Method
from nfv_torchrl.methods.candidate_play import CandidatePlay, is_highest
from nfv_torchrl.methods.lookahead_play import LookaheadPlay
from nfv_torchrl.methods.policy import PolicyMethod
from nfv_torchrl.methods.watching import EVERY, MOST, Watch
from nfv_torchrl.networks import CandidateNetwork, LookaheadNetwork, MLPNetwork, QNetwork
from nfv_torchrl.networks.compiled import compiled_perceptron, outputs_of
from nfv_torchrl.search.playing import has_room
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME


class CompiledRows:
    """A network that values rows as a method that takes the valid action of the highest value, compiled.

    The same choice as that of ``PolicyMethod`` with ``greedy_actor``, but for values that agree to within rounding, and
    many times as fast. The weights are those at the time it is made.

    Args:
        play: chooses for all environments of a simulator.
        name: see ``PolicyMethod``.
        mask: see ``PolicyMethod``.
        decides_admission: see ``PolicyMethod``.

    Attributes:
        watch: some of the values that decided, in the last run.
    """

    one_hot = False

    def __init__(
        self,
        play: CandidatePlay | LookaheadPlay,
        *,
        name: str = "policy",
        mask: str | None = None,
        decides_admission: bool = False,
    ) -> None:
        self.name, self.mask, self.decides_admission = name, mask, decides_admission
        self._play = play
        self.watch = Watch()

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._play.prepare(simulator.world)
        self._play.choose(simulator)  # the first call may compile
        self.watch.clear()

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions, values = self._play.choose(simulator)
        if self.watch.due():
            self.watch.add(values[simulator.world.env["done"] == 0])
        return actions


class CompiledCandidates(CompiledRows):
    """``CompiledRows`` of a ``CandidateNetwork``; ``options`` are its ``name``, ``mask`` and ``decides_admission``.

    Raises:
        ScenarioError: a network that ``CandidatePlay`` does not take.
    """

    def __init__(self, network: CandidateNetwork, **options: Any) -> None:
        super().__init__(CandidatePlay(network), **options)


class CompiledLookahead(CompiledRows):
    """``CompiledRows`` of a ``LookaheadNetwork``, whole horizons in a call; the values that it watches are less V.

    Raises:
        ScenarioError: a network that ``LookaheadPlay`` does not take.
    """

    def __init__(self, network: LookaheadNetwork, **options: Any) -> None:
        self._whole = LookaheadPlay(network)
        super().__init__(self._whole, **options)

    def play(self, simulator: Simulator, b: int) -> None:
        """See ``WholePlay``."""
        self.watch.add(self._whole.play(simulator, b))


@part
def _highest(world, b, network, values):
    """The valid action of the highest output of environment b.

    ``values`` float32 [2]: its output, and the highest of another valid action (NaN if there is none).
    """
    weights, sizes, activation, now, after = network
    for i in range(sizes[0]):
        now[i] = world.seen.flat[b, i]
    outputs_of(weights, sizes, activation, now, after)
    best = np.int64(world.seen.valid[b, 0])
    values[0] = values[1] = np.float32(-np.inf)
    for k in range(world.env[b].mask_count):
        action = np.int64(world.seen.valid[b, k])
        score = now[action]
        if is_highest(score, values):
            best = action
    if world.env[b].mask_count < 2:
        values[1] = np.float32(np.nan)
    return best


@kernel
def choose_highest(world, network, actions, values):
    """Fill ``actions`` int64 [B] with the valid action of the highest output of each environment, ``values`` [B, 2]."""
    for b in range(actions.size):
        actions[b] = _highest(world, b, network, values[b])


@kernel
def play_highest(world, b, network, begun, values):
    """Play environment b to the end of its horizon, or until the simulator's pools run low (then call again).

    ``begun``: steps made before. ``values`` float32 [MOST, 2]: those of every EVERY-th step, the last ones.
    Returns whether it is over, and the steps made.
    """
    steps = begun
    while world.env[b].done == 0:
        if not has_room(world, b):
            return False, steps
        while True:
            action = _highest(world, b, network, values[steps // EVERY % values.shape[0]])
            step_env(world, b, action)
            steps += 1
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
    return True, steps


class CompiledMLP:
    """An ``MLPNetwork`` as a method that takes the valid action of the highest output, whole horizons in a call.

    The same choice as that of ``PolicyMethod``, but for outputs that agree to within rounding. The weights are those at
    the time it is made.

    Args:
        network: what decides.
        name: see ``PolicyMethod``.
        one_hot: see ``PolicyMethod``.

    Attributes:
        watch: some of the outputs that decided, in the last run.

    Raises:
        ScenarioError: another network, several outputs for an action, or another activation than ReLU and Tanh.
    """

    mask: str | None = None
    decides_admission = False

    def __init__(self, network: QNetwork, *, name: str = "policy", one_hot: bool = True) -> None:
        if not isinstance(network, MLPNetwork) or network.outputs != 1:
            raise ScenarioError("network: a compiled perceptron is an MLPNetwork with one output for each action")
        self.name, self.one_hot = name, one_hot
        self._network = compiled_perceptron(network.layers)
        self.watch = Watch()

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._values = np.zeros((simulator.batch_size, 2), np.float32)
        self.act(simulator)  # the first call may compile
        self.watch.clear()

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions = np.zeros(simulator.batch_size, np.int64)
        choose_highest(simulator.world, self._network, actions, self._values)
        return actions

    def play(self, simulator: Simulator, b: int) -> None:
        """Answer all requests of environment b, whose horizon has begun."""
        values, over, steps = np.full((MOST, 2), np.nan, np.float32), False, 0
        while not over:
            over, steps = play_highest(simulator.world, b, self._network, steps, values)
            if not over:
                simulator.make_room_for(b)
        self.watch.add(values[: -(-steps // EVERY)])


def fastest_method(actor: TensorDictModuleBase, network: QNetwork, *, one_hot: bool) -> Method:
    """The same decisions as ``acting_method``, compiled wherever the network can be: for evaluations in a training.

    What others measure as an agent's decision time is that of ``acting_method``, which goes through torch.
    """
    scores = scorer(actor)
    if scores is not None and scores.module is network and list(scores.in_keys) == ["observation"]:
        with contextlib.suppress(ScenarioError):
            return CompiledMLP(network, one_hot=one_hot)
    return acting_method(actor, network, one_hot=one_hot)


def acting_method(actor: Any, network: QNetwork, *, one_hot: bool, **options: Any) -> Method:
    """The method of ``actor``, whose network is ``network``; ``options`` are those that both kinds of method have."""
    if isinstance(actor, QValueActor) and isinstance(network, CandidateNetwork):
        try:
            return CompiledCandidates(network, **options)
        except ScenarioError:  # noise, several outputs or another activation: torch can do them
            pass
    if isinstance(actor, QValueActor) and isinstance(network, LookaheadNetwork):
        with contextlib.suppress(ScenarioError):
            return CompiledLookahead(network, **options)
    return PolicyMethod(actor, network.observations(), one_hot=one_hot, **options)
