"""What evolution can shape: a network, the method that acts by it, and its compiled play of whole horizons.

They are learned without a loss, so a policy file names them by themselves.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.methods.base import Method
from nfv_torchrl.methods.candidate_play import CandidatePlay
from nfv_torchrl.methods.planned import PlannerMethod
from nfv_torchrl.methods.policy import PolicyMethod
from nfv_torchrl.networks import CandidateNetwork, NetworkFactory, Sizes
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.planners.learned_prices import LearnedPrices
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.values import Count
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import World


class Player(Protocol):
    """Plays whole horizons with fixed weights."""

    def prepare(self, world: World) -> None:
        """Called once for the world of a simulator, before it plays there."""

    def play(self, simulator: Simulator, b: int, costs: np.ndarray) -> None:
        """Answer all requests of environment b, whose horizon has begun.

        ``costs`` float64 [R] receives what each request cost ($), NaN if it was not accepted.
        """


class Evolvable(nn.Module):
    """A policy whose parameters evolution sets, as one vector float32 [P].

    A subclass is made as ``MyPolicy(network, sizes, **hyperparameters)`` with a factory of the network.

    Attributes:
        network: holds the parameters; its ``any_size`` says whether it fits any scenario.
    """

    network: nn.Module

    def vector(self) -> np.ndarray:
        """All parameters, float32 [P]."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().cpu().numpy().astype(np.float32)

    def set_vector(self, vector: np.ndarray) -> None:
        """Set all parameters from [P] numbers, rounded to float32."""
        values = torch.from_numpy(np.ascontiguousarray(vector, np.float32))
        nn.utils.vector_to_parameters(values, self.parameters())

    def with_vector(self, vector: np.ndarray) -> Evolvable:
        """A copy with other parameters."""
        other = copy.deepcopy(self)
        other.set_vector(vector)
        return other

    def player(self) -> Player:
        """The policy as a compiled player."""
        raise NotImplementedError

    def settings(self, scenario: Scenario) -> Scenario:
        """The scenario with the settings that this policy needs."""
        raise NotImplementedError

    def method(self, name: str) -> Method:
        """The method by which it acts in an evaluation; ``name`` is for tables and folders."""
        raise NotImplementedError


class PricePolicy(Evolvable):
    """Learned prices and a learned refusal inside the exact search (``planners/learned_prices.py``).

    Args:
        network: factory of a ``PriceNetwork``; it is called without sizes, as it fits any network.
        sizes: not used; any policy is made with them.
        labels: limit on the exact search for one request, see ``ExactPlanner``. None: no limit.

    Raises:
        ScenarioError: labels < 1.
    """

    network: PriceNetwork

    def __init__(
        self, network: Callable[[], PriceNetwork], sizes: Sizes | None = None, *, labels: Count | None = None
    ) -> None:
        super().__init__()
        self.network = network()
        self.labels = labels
        self._planner()  # refuses a limit that is none

    def player(self) -> Player:
        """See ``Evolvable``."""
        return self._planner()

    def settings(self, scenario: Scenario) -> Scenario:
        """The scenario with ``admission_control``, since refusals are decisions of the policy."""
        return scenario.replace(admission_control=True)

    def method(self, name: str) -> PlannerMethod:
        """See ``Evolvable``."""
        return PlannerMethod(self._planner(), name=name)

    def _planner(self) -> LearnedPrices:
        return LearnedPrices(self.network.weights(), labels=self.labels)


class CandidatePolicy(Evolvable):
    """The candidate network acts step by step and takes the highest score. ``reject`` is one of its candidates.

    Args:
        network: factory of a ``CandidateNetwork`` with ReLU or Tanh layers.
        sizes: of observation and actions.

    Raises:
        ScenarioError: another network.
    """

    network: CandidateNetwork

    def __init__(self, network: NetworkFactory, sizes: Sizes) -> None:
        super().__init__()
        made = network(sizes)
        if not isinstance(made, CandidateNetwork):
            raise ScenarioError(f"policy: {type(made).__name__} is no CandidateNetwork; set network=candidate")
        self.network = made
        self._actions = sizes.actions

    def player(self) -> Player:
        """See ``Evolvable``."""
        return CandidatePlay(self.network)

    def settings(self, scenario: Scenario) -> Scenario:
        """It chooses among steps that can succeed, and may always reject."""
        return scenario.replace(admission_control=True, mask="feasible")

    def method(self, name: str) -> PolicyMethod:
        """See ``Evolvable``."""
        return PolicyMethod(
            greedy_actor(self.network, self._actions),
            self.network.observations(),
            one_hot=False,
            name=name,
            mask="feasible",
            decides_admission=True,
        )
