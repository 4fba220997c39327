"""Munchausen Q-learning: the agent's own log-policy as part of the reward."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import distance_loss

from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_expectation, masked_log_softmax, masked_softmax
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Distance, Positive, Share, StopKey


class MunchausenDQN(MaskedLoss):
    r"""Soft Q-learning whose reward is raised where the policy was sure of the action taken. Valid actions only.

    $$
    \Big(r + \alpha \big[\tau \ln \pi(a|s)\big]_{l_0}^0 + \gamma (1 - d') \sum_{a' \in A_p(s')} \pi(a'|s')
    \big(\bar Q(s', a') - \tau \ln \pi(a'|s')\big) - Q(s, a)\Big)^2, \quad
    \pi(a|s) = \frac{e^{\bar Q(s, a) / \tau}}{\sum_{b \in A_p(s)} e^{\bar Q(s, b) / \tau}}
    $$

    with $\bar Q$ the target network and $[x]_{l_0}^0 = \min(0, \max(l_0, x))$ (Vieillard, Pietquin, Geist, "Munchausen
    Reinforcement Learning", NeurIPS 2020, eq. 1 and section 3: M-DQN). The log-policy widens the gap between the best
    valid action and the others and keeps the new policy near the last one; clipping it bounds what a hopeless action
    costs. Both softmaxes run over the valid actions of their own state, so a state with one valid action adds nothing.
    The policy acts greedily.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        alpha: share of the log-policy in the reward; 0 is soft Q-learning.
        temperature: tau, small beside the differences between values: the soft value pays for every step in which
            several actions are about as good, so that a large one makes walks longer.
        clip: $-l_0$, the most that the log-policy times the temperature takes from a reward.
        gamma: discount per step.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss`` []. Logs ``entropy`` [], the
    mean entropy of the policy, nats, and ``log_policy`` [], the mean of the clipped term without its alpha.
    """

    out_keys = ["loss", "entropy", "log_policy"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        alpha: Share = 0.9,
        temperature: Positive = 0.01,
        clip: Positive = 1.0,
        gamma: Share = 0.95,
        loss_function: Distance = "l2",
        stop_at: StopKey = "request_done",
    ) -> None:
        q_network = network(sizes)
        super().__init__(q_network, stop_at=stop_at)
        self.alpha, self.temperature, self.clip = alpha, temperature, clip
        self.gamma, self.loss_function = gamma, loss_function
        self.adopt(q_network, actor=greedy_actor(q_network, sizes.actions))

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of transitions."""
        action, mask = self.action(tensordict), self.mask(tensordict)
        taken = self.outputs("value_network", tensordict).gather(-1, action)
        with torch.no_grad():
            values = self.outputs("value_network", tensordict, target=True) / self.temperature
            log_probability = masked_log_softmax(values, mask)
            bonus = (self.temperature * log_probability.gather(-1, action)).clamp(-self.clip, 0.0)
            goal = self.returns(tensordict, self._soft_value(tensordict.get("next")), self.gamma) + self.alpha * bonus
            entropy = -masked_expectation(masked_softmax(values, mask), log_probability, mask)
        self.prioritise(tensordict, goal - taken)
        loss = self.mean(distance_loss(taken, goal, self.loss_function), tensordict)
        return TensorDict({"loss": loss, "entropy": entropy.mean(), "log_policy": bonus.mean()})

    def _soft_value(self, after: TensorDictBase) -> Tensor:
        """Sum over the valid actions of pi (Q - tau ln pi), [batch, 1]."""
        values, mask = self.outputs("value_network", after, target=True), self.mask(after)
        scaled = values / self.temperature
        own = values - self.temperature * masked_log_softmax(scaled, mask)
        return masked_expectation(masked_softmax(scaled, mask), own, mask)
