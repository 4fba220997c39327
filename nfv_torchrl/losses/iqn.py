"""Implicit quantile networks: distributional Q-learning at levels that are drawn anew for every row."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_argmax
from nfv_torchrl.losses.quantile import MeanValue, pick, quantile_huber
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Count, Positive, Quantiles, Share, StopKey


class IQN(MaskedLoss):
    r"""Quantile regression at random levels, over valid actions.

    $$
    \sum_{i=1}^{N} \frac{1}{N'} \sum_{j=1}^{N'}
    \Big|\tau_i - \mathbb{1}[u_{ij} < 0]\Big| \frac{L_\kappa(u_{ij})}{\kappa}, \quad
    u_{ij} = r + \gamma (1 - d') \bar Z_{\tau'_j}(s', a^*) - Z_{\tau_i}(s, a), \quad \tau_i, \tau'_j \sim U[0, 1]
    $$

    with $L_\kappa$ the Huber loss and $a^* = \arg\max_{a' \in A_p(s')} \frac{1}{K} \sum_k \bar Z_{\hat\tau_k}(s', a')$,
    the mean over levels taken first and the maximum over valid actions only (Dabney, Ostrovski, Silver, Munos,
    "Implicit Quantile Networks for Distributional Reinforcement Learning", ICML 2018, eqs. 2 and 3). With ``double``
    the online network chooses $a^*$.

    The paper draws the levels $\hat\tau_k$ of a choice, too. Here they are the fixed $(2 k - 1) / 2 K$, so that acting
    is deterministic: two evaluations agree, and the greedy action is a function of the weights alone.

    Args:
        network: factory of a network that takes levels, as ``ImplicitQuantileNetwork`` does.
        sizes: sizes of observation and actions.
        samples: N.
        target_samples: N'.
        quantiles: K.
        kappa: where the Huber loss turns from a parabola into a line.
        gamma: discount per step.
        double: choose the next action by the online network.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss`` []. Logs
    ``quantile_spread`` []: mean distance from the lowest to the highest drawn quantile of the actions taken.

    Raises:
        ScenarioError: the network takes no levels.
    """

    out_keys = ["loss", "quantile_spread"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        samples: Count = 8,
        target_samples: Count = 8,
        quantiles: Quantiles = 16,
        kappa: Positive = 1.0,
        gamma: Share = 1.0,
        double: bool = False,
        stop_at: StopKey = "request_done",
    ) -> None:
        made = network(sizes, outputs=quantiles)
        if not made.takes_levels:
            raise ScenarioError(
                f"{type(made).__name__} takes no levels of quantiles; use network=implicit for loss=iqn"
            )
        super().__init__(made, stop_at=stop_at)
        self.samples, self.target_samples = samples, target_samples
        self.kappa, self.gamma, self.double = kappa, gamma, double
        self.adopt(made, actor=greedy_actor(MeanValue(made), sizes.actions, made.in_keys))

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of transitions."""
        action = self.action(tensordict)
        levels = torch.rand(len(action), self.samples, device=action.device)
        taken = pick(self.outputs("value_network", tensordict, levels), action)
        with torch.no_grad():
            goal = self._target(tensordict)
        self.prioritise(tensordict, goal.mean(-1) - taken.mean(-1))
        loss = self.mean(quantile_huber(taken, goal, levels, self.kappa), tensordict)
        spread = (taken.amax(-1) - taken.amin(-1)).mean().detach()
        return TensorDict({"loss": loss, "quantile_spread": spread})

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """r + gamma (1 - d') Z_j(s', a*), [batch, N']."""
        after = tensordict.get("next")
        judges = self.outputs("value_network", after, target=not self.double)
        best = masked_argmax(judges.mean(-1), self.mask(after))
        levels = torch.rand(len(best), self.target_samples, device=best.device)
        quantiles = self.outputs("value_network", after, levels, target=True)
        return self.returns(tensordict, pick(quantiles, best), self.gamma)
