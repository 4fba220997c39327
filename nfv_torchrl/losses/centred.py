"""Discounted Q-learning across requests on rewards less their running mean."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.across_requests import AcrossRequests
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import AtLeastOne, Count, Distance, Share


class CentredDQN(AcrossRequests):
    r"""Double Q-learning with a discount per request. At a request's end the running mean of rewards is subtracted.

    $$
    y = r - e \bar r_m + \gamma^e (1 - d') \bar Q(s', a^*), \quad
    \bar r_m = \frac{\text{what requests of service m earned}}{\text{how many of them ended}}
    $$

    with e = 1 for a step that ends a request and 0 for the others (Naik, Wan, Tomar, Sutton, "Reward Centering", RLC
    2024, the simple form). Both sums of $\bar r_m$ run over what was collected and forget with time constant
    ``rate_over``. With the default reward, $r - \bar r$ is the acceptance less its running mean, but for costs.
    With n > 1 the sum is that of ``AcrossRequests``.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        gamma: discount per request; 1 within it.
        rate_over: time constant of the running mean, requests.
        n: most rewards to sum.
        double: choose the next action by the online network, else by the target network.
        by_service: a mean for each service type, instead of one for all.
        environments: means of their own for so many environments, see ``AcrossRequests``; ``rate_over`` counts the
            requests of one of them.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.

    Keys, what it writes and what it logs: see ``AcrossRequests``.
    """

    earned: Tensor
    ended: Tensor

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 0.999,
        rate_over: AtLeastOne = 20_000,
        n: Count = 1,
        double: bool = True,
        by_service: bool = False,
        environments: Count = 1,
        loss_function: Distance = "l2",
    ) -> None:
        if not 0 <= gamma <= 1:
            raise ScenarioError(f"loss.gamma is {gamma}; a discount lies from 0 to 1")
        if rate_over < 1:
            raise ScenarioError(f"loss.rate_over is {rate_over}; the mean is taken over at least 1 request")
        super().__init__(
            network,
            sizes,
            n=n,
            double=double,
            by_service=by_service,
            environments=environments,
            loss_function=loss_function,
        )
        self.gamma, self.rate_over = gamma, rate_over
        self.register_buffer("earned", torch.zeros_like(self.rate))
        self.register_buffer("ended", torch.zeros_like(self.rate))

    def request_discount(self, after: TensorDictBase) -> Tensor | float:
        """One factor per request: see ``AcrossRequests``."""
        return self.gamma

    def collected(self, after: TensorDictBase) -> None:
        """Bring the running means up to date."""
        ended = self._totals(self.ends(after).to(self.rate.dtype))
        earned = self._totals(self._by_rate(after))
        keep = (1.0 - ended.sum(-1, keepdim=True) / self.rate_over).clamp(min=0.0)
        self.earned.mul_(keep).add_(earned)
        self.ended.mul_(keep).add_(ended)
        self.rate.copy_(self.earned / self.ended.clamp(min=1.0))

    def _totals(self, values: Tensor) -> Tensor:
        """Sums of ``values`` [B, T, M] over all steps, of each environment where there are several: shaped as rates."""
        values = values.to(self.rate.device)
        if self.environments == 1:
            return values.flatten(0, -2).sum(0)
        environment = torch.arange(len(values), device=values.device) % self.environments
        return torch.zeros_like(self.rate).index_add_(0, environment, values.sum(1))

    def _by_rate(self, after: TensorDictBase) -> Tensor:
        """The reward of each step in the column of its service, 0 in the others, [B, T, M]."""
        reward = after.get(self.tensor_keys.reward)
        if not self.by_service:
            return reward
        service = after.get(("outcome", "service")).squeeze(-1)
        return reward * torch.nn.functional.one_hot(service, self.rate.shape[-1])
