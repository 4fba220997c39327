"""How the greedy policy of a trained network acts in an evaluation: compiled where it can be, else through torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torchrl.modules import QValueActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.methods.base import Method
from nfv_torchrl.methods.candidate_play import CandidatePlay
from nfv_torchrl.methods.policy import PolicyMethod
from nfv_torchrl.networks import CandidateNetwork, QNetwork
from nfv_torchrl.simulator import Simulator


class CompiledCandidates:
    """A ``CandidateNetwork`` as a method that takes the valid action of the highest output, in one compiled loop.

    The same choice as that of ``PolicyMethod`` with ``greedy_actor``, but for outputs that agree to within rounding,
    and many times as fast. The weights are those at the time it is made.

    Args:
        network: what decides.
        name: see ``PolicyMethod``.
        mask: see ``PolicyMethod``.
        decides_admission: see ``PolicyMethod``.

    Raises:
        ScenarioError: a network that ``CandidatePlay`` does not take.
    """

    one_hot = False

    def __init__(
        self,
        network: CandidateNetwork,
        *,
        name: str = "policy",
        mask: str | None = None,
        decides_admission: bool = False,
    ) -> None:
        self.name, self.mask, self.decides_admission = name, mask, decides_admission
        self._play = CandidatePlay(network)

    def prepare(self, simulator: Simulator, seeds: Sequence[int]) -> None:
        """See ``Method``."""
        self._play.prepare(simulator.world)
        self._play.choose(simulator)  # the first call may compile

    def act(self, simulator: Simulator) -> np.ndarray:
        """See ``Method``."""
        return self._play.choose(simulator)


def acting_method(actor: Any, network: QNetwork, *, one_hot: bool, **options: Any) -> Method:
    """The method of ``actor``, whose network is ``network``; ``options`` are those that both kinds of method have."""
    if isinstance(actor, QValueActor) and isinstance(network, CandidateNetwork):
        try:
            return CompiledCandidates(network, **options)
        except ScenarioError:  # noise, several outputs or another activation: torch can do them
            pass
    return PolicyMethod(actor, network.observations(), one_hot=one_hot, **options)
