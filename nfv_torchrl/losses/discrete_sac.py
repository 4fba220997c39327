"""Soft actor-critic for discrete actions."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_expectation, masked_log_softmax, masked_softmax
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.settings.values import Positive, Share, StopKey


class DiscreteSAC(MaskedLoss):
    r"""A stochastic policy, two Q-networks and a learned temperature. All expectations are over valid actions.

    $$
    \begin{aligned}
    J_Q &= \sum_{k=1,2} \big(Q_k(s, a) - r - \gamma (1 - d') V(s')\big)^2, \quad
    V(s') = \sum_{a' \in A_p(s')} \pi(a'|s') \big[\min_k \bar Q_k(s', a') - \alpha \log \pi(a'|s')\big] \\
    J_\pi &= \sum_{a \in A_p(s)} \pi(a|s) \big[\alpha \log \pi(a|s) - \min_k Q_k(s, a)\big] \\
    J_\alpha &= \log \alpha \, \big(H(\pi(\cdot|s)) - c \log |A_p(s)|\big)
    \end{aligned}
    $$

    (Christodoulou, "Soft Actor-Critic for Discrete Action Settings", 2019, eqs. 3, 10 to 12). The target entropy is a
    share c of the most that the state's own mask allows, since that number changes from node to node; a state with
    one valid action has entropy 0 and asks for 0. Q is not differentiated in $J_\pi$, nor the policy in
    $J_Q$ and $J_\alpha$.

    The policy explores by itself: ``exploration=none``. In an evaluation it takes its most probable action.

    Args:
        network: factory of the policy's and the Q-networks.
        sizes: sizes of observation and actions.
        gamma: discount per step; below 1, because every further step is paid alpha times its entropy, more than a step
            of a small service costs, so that undiscounted values make walks wander.
        entropy_share: c.
        alpha: initial temperature, small beside the differences between values.
        learn_alpha: False keeps it.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss_qvalue``, ``loss_actor`` and
    ``loss_alpha``, all []. Logs ``alpha`` [] and ``entropy`` [], the mean entropy of the policy, nats.
    """

    out_keys = ["loss_qvalue", "loss_actor", "loss_alpha", "alpha", "entropy"]  # noqa: RUF012  as TorchRL has it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 0.95,
        entropy_share: Share = 0.1,
        alpha: Positive = 0.01,
        learn_alpha: bool = True,
        stop_at: StopKey = "request_done",
    ) -> None:
        if alpha <= 0:
            raise ScenarioError(f"loss.alpha is {alpha}; the temperature must be above 0")
        policy, critics = network(sizes), TwoNetworks(network(sizes), network(sizes))
        super().__init__(policy, stop_at=stop_at)
        self.gamma, self.entropy_share = gamma, entropy_share
        self.log_alpha = nn.Parameter(torch.tensor(math.log(alpha)), requires_grad=learn_alpha)
        self.adopt(policy, actor=stochastic_actor(policy, sizes.actions), name="actor_network", target=False)
        self.adopt(critics)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The three losses of a batch of transitions."""
        mask = self.mask(tensordict)
        alpha = self.log_alpha.detach().exp()
        values = self.outputs("value_network", tensordict)
        taken = values.gather(-2, self.action(tensordict).unsqueeze(-1).expand(-1, 1, 2)).squeeze(-2)
        with torch.no_grad():
            goal = self.returns(tensordict, self._soft_value(tensordict.get("next"), alpha), self.gamma)
        log_probability, probability = self._policy(tensordict)
        lowest = values.detach().amin(-1)
        regret = masked_expectation(probability, alpha * log_probability - lowest, mask)
        entropy = -masked_expectation(probability, log_probability, mask).detach()
        wanted = self.entropy_share * mask.sum(-1, keepdim=True).log()
        self.prioritise(tensordict, taken - goal)
        return TensorDict(
            {
                "loss_qvalue": self.mean((taken - goal).square().sum(-1), tensordict),
                "loss_actor": self.mean(regret, tensordict),
                "loss_alpha": self.mean(self.log_alpha * (entropy - wanted), tensordict),
                "alpha": alpha,
                "entropy": entropy.mean(),
            }
        )

    def _policy(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Log-probabilities and probabilities of all actions, [batch, A]."""
        logits, mask = self.outputs("actor_network", tensordict), self.mask(tensordict)
        return masked_log_softmax(logits, mask), masked_softmax(logits, mask)

    def _soft_value(self, after: TensorDictBase, alpha: Tensor) -> Tensor:
        """V of the next state, [batch, 1]."""
        log_probability, probability = self._policy(after)
        lowest = self.outputs("value_network", after, target=True).amin(-1)
        return masked_expectation(probability, lowest - alpha * log_probability, self.mask(after))


class TwoNetworks(nn.Module):
    """Two networks side by side: values [..., A, 2]."""

    def __init__(self, first: QNetwork, second: QNetwork) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, *inputs: Tensor) -> Tensor:
        """Values of all actions by both."""
        return torch.stack((self.first(*inputs), self.second(*inputs)), -1)


def stochastic_actor(network: QNetwork, actions: int) -> ProbabilisticActor:
    """The softmax policy of a network's outputs over the valid actions; its mode is the greedy one."""
    module = TensorDictModule(network, in_keys=list(network.in_keys), out_keys=["logits"])
    return ProbabilisticActor(
        module,
        in_keys={"logits": "logits", "mask": "action_mask"},
        out_keys=["action"],
        distribution_class=MaskedCategorical,
        spec=Categorical(actions),
    )
