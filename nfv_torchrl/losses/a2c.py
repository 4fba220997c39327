"""Advantage actor-critic."""

from __future__ import annotations

from functools import partial

from torchrl.objectives import A2CLoss

from nfv_torchrl.losses.policy_gradient import PolicyGradient
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import NotNegative, Share, StopKey


class A2C(PolicyGradient):
    r"""The synchronous form of asynchronous advantage actor-critic.

    $$
    L = -\log \pi(a | s) \, A(s, a) + c_V \big(V(s) - \hat V(s)\big)^2 - c_H H[\pi(\cdot | s)]
    $$

    with the entropy $H$ over valid actions only (Mnih et al., "Asynchronous Methods for Deep Reinforcement
    Learning", ICML 2016). Learns from each row once, as REINFORCE here does.

    Args and keys: see ``PolicyGradient`` (the objective is made here), and
        entropy_coeff: c_H.
        critic_coeff: c_V.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and, to log, ``entropy``, all [].
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        lmbda: Share = 0.95,
        stop_at: StopKey = "request_done",
        entropy_coeff: NotNegative = 0.01,
        critic_coeff: NotNegative = 0.5,
    ) -> None:
        objective = partial(
            A2CLoss,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
        super().__init__(network, sizes, objective, gamma=gamma, lmbda=lmbda, stop_at=stop_at)
