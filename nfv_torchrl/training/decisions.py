"""What one decision of a policy is: a hop, a function of the chain (NFVdeep) or a whole plan; a recipe's ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import q_network
from nfv_torchrl.methods import Method, PlannerMethod, fastest_method
from nfv_torchrl.methods.planned import planner_method
from nfv_torchrl.networks import Sizes
from nfv_torchrl.nfvdeep import NFVdeepEnv, NFVdeepPlanner
from nfv_torchrl.plans import MenuPlanner, Menus, PlanEnv
from nfv_torchrl.rewards import Reward
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator


def _simulator(scenarios: Scenario | Sequence[Scenario], *, one_hot: bool = False) -> Simulator:
    """One environment on each of the scenarios."""
    worlds = [scenarios] if isinstance(scenarios, Scenario) else scenarios
    return Simulator(worlds, len(worlds), one_hot=one_hot)


class HopDecisions:
    """One hop a decision, with the next function placed there or not: ``NFVEnv``, the walk of Algorithm 3."""

    def __init__(self) -> None:
        """Nothing to set."""

    def sizes(self, scenarios: Scenario | Sequence[Scenario], *, one_hot: bool) -> Sizes:
        """Sizes of what the policy sees and chooses from."""
        return Sizes.of(_simulator(scenarios, one_hot=one_hot))

    def environment(
        self, scenarios: Scenario | Sequence[Scenario], batch_size: int, loss: Any, *, reward: Reward, **options: Any
    ) -> NFVEnv:
        """The environment that ``loss`` learns in; ``options`` are those of ``NFVEnv``."""
        parts = q_network(loss).observations()
        return NFVEnv(scenarios, batch_size, reward=reward, observations=parts, **options)

    def method(self, loss: Any, *, one_hot: bool) -> Method:
        """How the policy being learned answers requests in an evaluation."""
        return fastest_method(loss.actor, q_network(loss), one_hot=one_hot)


class FunctionDecisions:
    """One function a decision, shortest routes between: ``NFVdeepEnv`` (Xiao et al., "NFVdeep", IWQoS 2019).

    Args:
        planner: turns the policy's choices into plans.
    """

    def __init__(self, planner: NFVdeepPlanner) -> None:
        self.planner = planner

    def sizes(self, scenarios: Scenario | Sequence[Scenario], *, one_hot: bool) -> Sizes:
        """Sizes of what the policy sees and chooses from.

        Raises:
            ScenarioError: with ``one_hot``.
        """
        if one_hot:
            raise ScenarioError("one_hot: true; env=nfvdeep has an observation of its own, set one_hot=false")
        return self.planner.sizes(_simulator(scenarios))

    def environment(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int,
        loss: Any,
        *,
        reward: Reward,
        one_hot: bool = False,
        **options: Any,
    ) -> NFVdeepEnv:
        """The environment that ``loss`` learns in; ``options`` are those of ``NFVdeepEnv``.

        Raises:
            ScenarioError: the network needs more than the flat observation.
        """
        if q_network(loss).observations():
            kind = type(q_network(loss)).__name__
            raise ScenarioError(f"network: {kind} needs more than the observation of env=nfvdeep; use network=mlp")
        return NFVdeepEnv(scenarios, batch_size, planner=self.planner, reward=reward, **options)

    def method(self, loss: Any, *, one_hot: bool = False) -> Method:
        """How the policy being learned answers requests in an evaluation."""
        return PlannerMethod(self.planner.follow(loss.actor), name="nfvdeep")


class PlanDecisions:
    """A whole plan a decision: ``PlanEnv``, among exact walks at several price levels.

    Args:
        planner: makes the walks, and turns the policy's choices into plans in evaluations.
    """

    def __init__(self, planner: MenuPlanner) -> None:
        self.planner = planner

    def sizes(self, scenarios: Scenario | Sequence[Scenario], *, one_hot: bool = False) -> Sizes:
        """Sizes of what the policy sees and chooses from; ``one_hot`` makes no difference."""
        worlds = [scenarios] if isinstance(scenarios, Scenario) else scenarios
        # Networks of one size do for that, whatever the rules of each.
        return self.planner.sizes(_simulator(worlds[0]))

    def environment(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int,
        loss: Any,
        *,
        reward: Reward,
        one_hot: bool = False,
        **options: Any,
    ) -> PlanEnv:
        """The environment that ``loss`` learns in; ``options`` are those of ``PlanEnv``."""
        made = self.planner.menus
        menus = Menus(made.level.tolist(), made.steepness, labels=made.labels, most_nodes=made.most_nodes)
        parts = q_network(loss).observations()
        return PlanEnv(scenarios, batch_size, menus=menus, reward=reward, observations=parts, **options)

    def method(self, loss: Any, *, one_hot: bool = False) -> Method:
        """How the policy being learned answers requests in an evaluation."""
        return planner_method(self.planner.follow(loss.actor), name="plans")
