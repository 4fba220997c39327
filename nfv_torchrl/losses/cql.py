"""Conservative Q-learning, for learning from recorded transitions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_argmax, masked_logsumexp
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import NotNegative, Share, StopKey


class CQL(MaskedLoss):
    r"""Deep Q-learning that keeps the values of valid actions low if they were not recorded.

    $$
    \tfrac12 \big(r + \gamma (1 - d') \bar Q(s', a^*) - Q(s, a)\big)^2
    + \alpha \Big(\log \sum_{b \in A_p(s)} e^{Q(s, b)} - Q(s, a)\Big), \quad
    a^* = \arg\max_{a' \in A_p(s')} \bar Q(s', a')
    $$

    (Kumar, Zhou, Tucker, Levine, "Conservative Q-Learning for Offline Reinforcement Learning", NeurIPS 2020, eq. 4,
    CQL(H)). Both the sum and the maximum run over valid actions only. Without the second term the maximum would
    choose actions whose values were never corrected by data. With ``double`` the online network chooses
    $a^*$.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        alpha: weight of the conservative term; 0 is deep Q-learning.
        gamma: discount per step.
        double: choose the next action by the online network.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss_td`` [] and
    ``loss_conservative`` [], the latter with its alpha. Logs ``agreement`` []: the share of recorded actions that
    the greedy policy would take, too.
    """

    out_keys = ["loss_td", "loss_conservative", "agreement"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        alpha: NotNegative = 1.0,
        gamma: Share = 1.0,
        double: bool = False,
        stop_at: StopKey = "request_done",
    ) -> None:
        q_network = network(sizes)
        super().__init__(q_network, stop_at=stop_at)
        self.alpha, self.gamma, self.double = alpha, gamma, double
        self.adopt(q_network, actor=greedy_actor(q_network, sizes.actions))

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The two losses of a batch of transitions."""
        values, mask, action = self.outputs("value_network", tensordict), self.mask(tensordict), self.action(tensordict)
        taken = values.gather(-1, action)
        with torch.no_grad():
            after = tensordict.get("next")
            next_values = self.outputs("value_network", after, target=True)
            judges = self.outputs("value_network", after) if self.double else next_values
            best = masked_argmax(judges, self.mask(after))
            goal = self.returns(tensordict, next_values.gather(-1, best), self.gamma)
            agreement = (masked_argmax(values, mask) == action).float().mean()
        self.prioritise(tensordict, goal - taken)
        return TensorDict(
            {
                "loss_td": 0.5 * self.mean((goal - taken).square(), tensordict),
                "loss_conservative": self.alpha * self.mean(masked_logsumexp(values, mask) - taken, tensordict),
                "agreement": agreement,
            }
        )
