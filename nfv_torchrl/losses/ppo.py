"""Proximal policy optimisation."""

from __future__ import annotations

from functools import partial

from torchrl.objectives import ClipPPOLoss

from nfv_torchrl.losses.policy_gradient import PolicyGradient
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import NotNegative, Positive, Share, StopKey


class PPO(PolicyGradient):
    r"""The clipped surrogate, which lets a batch be learned from several times.

    $$
    L = -\min\big(\rho A, \mathrm{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A\big)
    + c_V \big(V(s) - \hat V(s)\big)^2 - c_H H[\pi(\cdot | s)], \qquad \rho = \pi(a | s) / \pi_{old}(a | s)
    $$

    with the entropy $H$ over valid actions only (Schulman et al., "Proximal Policy Optimization Algorithms",
    arXiv:1707.06347, eq. 9).

    Args and keys: see ``PolicyGradient`` (the objective is made here), and
        clip_epsilon: epsilon.
        entropy_coeff: c_H.
        critic_coeff: c_V.
        normalize_advantage: advantages of a minibatch to mean 0 and deviation 1.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and, to log, ``entropy``, ``kl_approx``,
    ``clip_fraction`` and ``ESS`` (effective sample size), all [].
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        lmbda: Share = 0.95,
        stop_at: StopKey = "request_done",
        clip_epsilon: Positive = 0.2,
        entropy_coeff: NotNegative = 0.01,
        critic_coeff: NotNegative = 0.5,
        normalize_advantage: bool = True,
    ) -> None:
        objective = partial(
            ClipPPOLoss,
            clip_epsilon=clip_epsilon,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            normalize_advantage=normalize_advantage,
            loss_critic_type="l2",
            functional=False,
        )
        super().__init__(network, sizes, objective, gamma=gamma, lmbda=lmbda, stop_at=stop_at)
