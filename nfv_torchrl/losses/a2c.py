"""Advantage actor-critic."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import A2CLoss

from nfv_torchrl.losses.policy_gradient import PolicyGradient


class A2C(PolicyGradient):
    r"""The synchronous form of asynchronous advantage actor-critic.

    .. math:: L = -\log \pi(a | s) \, A(s, a) + c_V \big(V(s) - \hat V(s)\big)^2 - c_H H[\pi(\cdot | s)]

    with the entropy :math:`H` over valid actions only (Mnih et al., "Asynchronous Methods for Deep Reinforcement
    Learning", ICML 2016). Learns from each batch once.

    Args and keys: see ``PolicyGradient``, and
        entropy_coeff: c_H.
        critic_coeff: c_V.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and, to log, ``entropy``, all [].
    """

    def make_objective(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        *,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 0.5,
    ) -> A2CLoss:
        """See ``PolicyGradient``."""
        return A2CLoss(
            actor,
            critic,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
