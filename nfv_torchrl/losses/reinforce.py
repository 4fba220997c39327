"""REINFORCE with a learned baseline."""

from __future__ import annotations

from functools import partial

from torchrl.objectives import ReinforceLoss

from nfv_torchrl.losses.policy_gradient import PolicyGradient
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Share, StopKey


class Reinforce(PolicyGradient):
    r"""The score-function gradient of the return.

    $$
    L = -\log \pi(a | s) \, \big(G - V(s)\big) + \big(V(s) - G\big)^2
    $$

    with $G$ the return from the step to the end of the request (Williams, "Simple Statistical Gradient-Following
    Algorithms for Connectionist Reinforcement Learning", Machine Learning 8, 1992). A smaller ``lmbda`` trades the
    return's variance for the critic's bias. Learns from each row once, a batch in parts: for the last
    of them the policy is some steps younger than the one that acted.

    Args and keys: see ``PolicyGradient`` (the objective is made here); ``lmbda`` is 1 by default.

    Writes ``loss_actor`` and ``loss_value`` [].
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        lmbda: Share = 1.0,
        stop_at: StopKey = "request_done",
    ) -> None:
        objective = partial(
            ReinforceLoss,
            loss_critic_type="l2",
            functional=False,
        )
        super().__init__(network, sizes, objective, gamma=gamma, lmbda=lmbda, stop_at=stop_at)
