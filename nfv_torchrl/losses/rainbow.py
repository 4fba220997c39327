"""Rainbow: the extensions of deep Q-learning, all together."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from nfv_torchrl.losses.n_step import n_step_transitions
from nfv_torchrl.losses.quantile import QuantileDQN
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Count, Positive, Quantiles, Share, StopKey


class Rainbow(QuantileDQN):
    r"""n-step double quantile regression; with dueling noisy networks and a prioritised memory it is Rainbow.

    $$
    \sum_{i=1}^{M} \frac{1}{M} \sum_{j=1}^{M}
    \Big|\hat\tau_i - \mathbb{1}[u_{ij} < 0]\Big| \frac{L_\kappa(u_{ij})}{\kappa}, \quad
    u_{ij} = \sum_{l=0}^{k-1} \gamma^l r_{t+l} + \gamma^k (1 - d_{t+k}) \bar\theta_j(s_{t+k}, a^*) - \theta_i(s_t, a_t)
    $$

    with $a^* = \arg\max_{a' \in A_p(s_{t+k})} \frac{1}{M} \sum_j \theta_j(s_{t+k}, a')$ by the online network (double)
    and k = n, or fewer steps where the request, the horizon or the collected batch ends sooner (Hessel et al.,
    "Rainbow: Combining Improvements in Deep Reinforcement Learning", AAAI 2018). Of the six extensions, three are in
    this loss: double Q-learning, n-step returns and the distribution of returns. The other three are settings of their
    own, and ``preset=rainbow`` sets them all: ``network=dueling`` with ``noisy: true``, whose mean advantage is taken
    over valid actions only and which explores without epsilon, and a memory that draws rows by their errors.

    Hessel et al. learn the distribution on 51 fixed returns between two bounds. Here it is learned by quantiles (see
    ``QuantileDQN``), because such bounds would have to be chosen anew for each reward and clip returns where they are
    chosen badly. A row's priority is the size of its mean error.

    Args:
        network: factory of a network with several outputs per action.
        sizes: sizes of observation and actions.
        n: most rewards to sum.
        quantiles: M.
        kappa: where the Huber loss turns from a parabola into a line.
        gamma: discount per step.
        double: choose the next action by the online network.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: those of ``QuantileDQN``, whose ``next`` is k steps on and whose ``reward`` is the sum, and
    ``steps_to_next_obs`` int64 [1], k. ``prepare`` makes them from a batch [B, T], time in dimension 1. What it writes
    and logs: see ``QuantileDQN``.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        n: Count = 3,
        quantiles: Quantiles = 16,
        kappa: Positive = 1.0,
        gamma: Share = 1.0,
        double: bool = True,
        stop_at: StopKey = "request_done",
    ) -> None:
        super().__init__(network, sizes, quantiles=quantiles, kappa=kappa, gamma=gamma, double=double, stop_at=stop_at)
        self.n = n

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads."""
        return [*super().in_keys, "steps_to_next_obs"]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Transitions of up to n steps, [B, T] flattened."""
        return n_step_transitions(data, super().in_keys, stop_at=self.tensor_keys.done, n=self.n, gamma=self.gamma)

    def discount(self, tensordict: TensorDictBase) -> Tensor:
        """gamma to the power of k."""
        return self.gamma ** tensordict.get("steps_to_next_obs")
