"""REINFORCE with a learned baseline."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ReinforceLoss

from nfv_torchrl.losses.policy_gradient import PolicyGradient


class Reinforce(PolicyGradient):
    r"""The score-function gradient of the return.

    .. math:: L = -\log \pi(a | s) \, \big(G - V(s)\big) + \big(V(s) - G\big)^2

    with :math:`G` the return from the step to the end of the request (Williams, "Simple Statistical Gradient-Following
    Algorithms for Connectionist Reinforcement Learning", Machine Learning 8, 1992). A smaller ``lmbda`` trades the
    return's variance for the critic's bias. Learns from each batch once: the policy must be the one that acted.

    Args and keys: see ``PolicyGradient``; ``lmbda`` is 1 by default.

    Writes ``loss_actor`` and ``loss_value`` [].
    """

    def __init__(self, *args, lmbda: float = 1.0, **kwargs) -> None:
        super().__init__(*args, lmbda=lmbda, **kwargs)

    def make_objective(self, actor: ProbabilisticActor, critic: TensorDictModule) -> ReinforceLoss:
        """See ``PolicyGradient``."""
        return ReinforceLoss(actor, critic, loss_critic_type="l2", functional=False)
