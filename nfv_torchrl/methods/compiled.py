"""How the greedy policy of a trained network acts in an evaluation: compiled where it can be, else through torch."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import QValueActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.deciding import deciding_network
from nfv_torchrl.methods.base import Method
from nfv_torchrl.methods.candidate_play import CandidatePlay, is_highest
from nfv_torchrl.methods.lookahead_play import LookaheadPlay
from nfv_torchrl.methods.policy import PolicyMethod
from nfv_torchrl.methods.watching import EVERY, MOST, Watch
from nfv_torchrl.networks import CandidateNetwork, LookaheadNetwork, QNetwork
from nfv_torchrl.networks.scoring import compiled_scorer, scores_of, shared_score
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
def _highest(world, b, scorer, values):
    """The valid action of the highest score in environment b.

    ``values`` float32 [2]: its value, and the highest of another valid action (NaN if there is none).
    """
    scores_of(world, b, scorer)
    best = np.int64(world.seen.valid[b, 0])
    values[0] = values[1] = np.float32(-np.inf)
    for k in range(world.env[b].mask_count):
        action = np.int64(world.seen.valid[b, k])
        score = scorer.now[action]
        if is_highest(score, values):
            best = action
    shared = shared_score(world, b, scorer)
    values[0] += shared
    values[1] += shared
    if world.env[b].mask_count < 2:
        values[1] = np.float32(np.nan)
    return best


@kernel
def choose_highest(world, scorer, actions, values):
    """Fill ``actions`` int64 [B] with the valid action of the highest score of each environment, ``values`` [B, 2]."""
    for b in range(actions.size):
        actions[b] = _highest(world, b, scorer, values[b])


@kernel
def play_highest(world, b, scorer, begun, values):
    """Play environment b to the end of its horizon, or until the simulator's pools run low (then call again).

    ``begun``: steps made before. ``values`` float32 [MOST, 2]: those of every EVERY-th step, the last ones.
    Returns whether it is over, and the steps made.
    """
    steps = begun
    while world.env[b].done == 0:
        if not has_room(world, b):
            return False, steps
        while True:
            action = _highest(world, b, scorer, values[steps // EVERY % values.shape[0]])
            step_env(world, b, action)
            steps += 1
            if world.outcome[b, OUTCOME.request_done] > 0.0:
                break
    return True, steps


class CompiledNetwork:
    """A network that scores all actions from the flat observation, as a method that takes the valid one of the highest
    score, whole horizons in a call.

    The same choice as that of ``PolicyMethod``, but for scores that agree to within rounding. The weights are those at
    the time it is made.

    Args:
        network: what decides: see ``compiled_scorer``.
        output: which of several outputs per action decides; None: their mean.
        name: see ``PolicyMethod``.
        one_hot: see ``PolicyMethod``.
        mask: see ``PolicyMethod``.
        decides_admission: see ``PolicyMethod``.

    Attributes:
        watch: some of the scores that decided, in the last run.

    Raises:
        ScenarioError: a network that ``compiled_scorer`` does not take.
    """

    def __init__(
        self,
        network: QNetwork,
        output: int | None = None,
        *,
        name: str = "policy",
        one_hot: bool = True,
        mask: str | None = None,
        decides_admission: bool = False,
    ) -> None:
        self.name, self.one_hot = name, one_hot
        self.mask, self.decides_admission = mask, decides_admission
        self._scorer = compiled_scorer(network, output)
        self.watch = Watch()

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        batch = simulator.batch_size
        self._values = np.zeros((batch, 2), np.float32)
        self._scorer = self._scorer._replace(memory=np.zeros((batch, self._scorer.memory.shape[1]), np.float32))
        self.act(simulator)  # the first call may compile
        self._scorer.memory[:] = 0.0
        self.watch.clear()

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        actions = np.zeros(simulator.batch_size, np.int64)
        choose_highest(simulator.world, self._scorer, actions, self._values)
        return actions

    def play(self, simulator: Simulator, b: int) -> None:
        """Answer all requests of environment b, whose horizon has begun."""
        values, over, steps = np.full((MOST, 2), np.nan, np.float32), False, 0
        while not over:
            over, steps = play_highest(simulator.world, b, self._scorer, steps, values)
            if not over:
                simulator.make_room_for(b)
        self.watch.add(values[: -(-steps // EVERY)])


def fastest_method(actor: TensorDictModuleBase, network: QNetwork, *, one_hot: bool, **options: Any) -> Method:
    """The same decisions as those of ``acting_method``, compiled wherever the network can be.

    What others measure as an agent's decision time is that of ``acting_method``, which goes through torch.
    """
    deciding = deciding_network(actor)
    if deciding is not None and deciding[0] is network:
        with contextlib.suppress(ScenarioError):
            return CompiledNetwork(*deciding, one_hot=one_hot, **options)
    return acting_method(actor, network, one_hot=one_hot, **options)


def acting_method(actor: Any, network: QNetwork, *, one_hot: bool, **options: Any) -> Method:
    """The method of ``actor``, whose network is ``network``; ``options`` are those that both kinds of method have.

    Networks that value rows are compiled where they can be: one output, no noise, and nothing between them and the
    choice.
    """
    deciding = deciding_network(actor)
    if deciding is not None and deciding[0] is network and isinstance(actor, QValueActor):
        for compiled in (CompiledCandidates, CompiledLookahead):
            with contextlib.suppress(ScenarioError):
                return compiled(network, **options)  # type: ignore[arg-type]  # it refuses other networks
    return PolicyMethod(actor, network.observations(), one_hot=one_hot, **options)
