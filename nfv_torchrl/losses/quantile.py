"""Distributional Q-learning by quantile regression."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_argmax
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.settings.values import Positive, Quantiles, Share, StopKey


class QuantileDQN(MaskedLoss):
    r"""QR-DQN: the distribution of returns by M quantiles, over valid actions.

    $$
    \sum_{i=1}^{M} \frac{1}{M} \sum_{j=1}^{M}
    \Big|\hat\tau_i - \mathbb{1}[u_{ij} < 0]\Big| \frac{L_\kappa(u_{ij})}{\kappa}, \quad
    u_{ij} = r + \gamma (1 - d') \bar\theta_j(s', a^*) - \theta_i(s, a), \quad \hat\tau_i = \frac{2i - 1}{2M}
    $$

    with $L_\kappa$ the Huber loss and $a^* = \arg\max_{a' \in A_p(s')} \frac{1}{M} \sum_j
    \bar\theta_j(s', a')$, the mean over quantiles taken first and the maximum over valid actions only (Dabney,
    Rowland, Bellemare, Munos, "Distributional Reinforcement Learning with Quantile Regression", AAAI 2018, eqs. 9 to
    13, algorithm 1). With ``double`` the online network chooses $a^*$.

    Args:
        network: factory of a network with several outputs per action.
        sizes: sizes of observation and actions.
        quantiles: M.
        kappa: where the Huber loss turns from a parabola into a line.
        gamma: discount per step.
        double: choose the next action by the online network.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss`` []. Logs
    ``quantile_spread`` []: mean distance from the lowest to the highest quantile of the actions taken.
    """

    out_keys = ["loss", "quantile_spread"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        quantiles: Quantiles = 16,
        kappa: Positive = 1.0,
        gamma: Share = 1.0,
        double: bool = False,
        stop_at: StopKey = "request_done",
    ) -> None:
        if quantiles < 2 or kappa <= 0:
            raise ScenarioError(f"loss: quantiles is {quantiles} and kappa {kappa}; at least 2 and above 0 are needed")
        quantile_network = network(sizes, outputs=quantiles)
        super().__init__(quantile_network, stop_at=stop_at)
        self.gamma, self.kappa, self.double = gamma, kappa, double
        actor = greedy_actor(MeanValue(quantile_network), sizes.actions, quantile_network.in_keys)
        self.adopt(quantile_network, actor=actor)
        levels = (2 * torch.arange(quantiles) + 1) / (2 * quantiles)
        self.register_buffer("levels", levels, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of transitions."""
        taken = pick(self.outputs("value_network", tensordict), self.action(tensordict))
        with torch.no_grad():
            goal = self._target(tensordict)
        self.prioritise(tensordict, goal.mean(-1) - taken.mean(-1))
        loss = self.mean(quantile_huber(taken, goal, self.levels, self.kappa), tensordict)
        spread = (taken.amax(-1) - taken.amin(-1)).mean().detach()
        return TensorDict({"loss": loss, "quantile_spread": spread})

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """r + gamma (1 - d') theta_j(s', a*), [batch, M]."""
        after = tensordict.get("next")
        quantiles = self.outputs("value_network", after, target=True)
        judges = self.outputs("value_network", after) if self.double else quantiles
        best = masked_argmax(judges.mean(-1), self.mask(after))
        return self.returns(tensordict, pick(quantiles, best), self.discount(tensordict))

    def discount(self, tensordict: TensorDictBase) -> float | Tensor:
        """Of what follows the rows' rewards: one number, or float32 [batch, 1]."""
        return self.gamma


class MeanValue(nn.Module):
    """The mean over a network's outputs per action: [..., A, M] to [..., A]."""

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> Tensor:
        """Mean values of all actions."""
        return self.network(*inputs).mean(-1)


def pick(values: Tensor, action: Tensor) -> Tensor:
    """The outputs of one action: ``values`` [batch, A, M], ``action`` int64 [batch, 1] to [batch, M]."""
    places: Sequence[int] = (*action.shape, values.shape[-1])
    return values.gather(-2, action.unsqueeze(-1).expand(places)).squeeze(-2)


def quantile_huber(taken: Tensor, goal: Tensor, levels: Tensor, kappa: float) -> Tensor:
    """Summed over the quantiles ``taken`` [batch, M] at ``levels`` [M] or [batch, M], mean over the samples ``goal``
    [batch, M']: [batch]."""
    error = goal.unsqueeze(-2) - taken.unsqueeze(-1)
    size = error.abs()
    huber = torch.where(size <= kappa, 0.5 * error**2, kappa * (size - 0.5 * kappa))
    weight = (levels.unsqueeze(-1) - (error.detach() < 0).to(levels.dtype)).abs()
    return (weight * huber / kappa).mean(-1).sum(-1)
