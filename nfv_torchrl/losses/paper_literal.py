"""The paper's Algorithm 2, read word by word."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.networks import NetworkFactory, Sizes

ACCEPTED = ("next", "outcome", "accepted")


class PaperLiteral(MaskedLoss):
    r"""Mean squared distance of Q from the reward alone, where the step did not accept a request.

    $$
    \big(1 - x\big) \big(r - Q(s, a)\big)^2
    $$

    with x = 1 for a step by which a request was accepted and 0 for the others: "If a request accepted, perform
    Algorithm 1, else perform gradient descent step on mean square error of $(r^{t,j}_k - Q(s^{t,j}, a^{t,j}_k;
    \theta))^2$" (Algorithm 2 of the paper). There is no next value, hence no discount and no target network: what is
    learned is the reward of one step. And what acceptance is worth is never learned: the value of an accepting step
    stays what the network happens to say.

    The algorithm samples a minibatch in each step and asks of one step whether it accepted. Here each row of the
    minibatch is asked, so that it does not matter how many steps there are for an update. The paper's text ("DQN-AR")
    describes ordinary deep Q-learning, which is ``DQN``; this loss shows what the difference is worth.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` ``reward``
    float32 [1] and ``("outcome", "accepted")`` bool [1]. The mask is for the actor alone. Writes ``loss`` [] and, into
    the batch, ``td_error`` float32 [1], 0 for a row that is not learned from. Logs ``accepting`` []: the share of rows
    not learned from.
    """

    out_keys = ["loss", "accepting"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(self, network: NetworkFactory, sizes: Sizes) -> None:
        q_network = network(sizes)
        super().__init__(q_network)
        self.adopt(q_network, actor=greedy_actor(q_network, sizes.actions), target=False)

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads."""
        keys = self.tensor_keys
        return [*self.network_keys, keys.action_mask, keys.action, ("next", keys.reward), ACCEPTED]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of steps."""
        taken = self.outputs("value_network", tensordict).gather(-1, self.action(tensordict))
        accepted = tensordict.get(ACCEPTED)
        error = torch.where(accepted, 0.0, tensordict.get(("next", self.tensor_keys.reward)) - taken)
        self.prioritise(tensordict, error)
        return TensorDict({"loss": self.mean(error.square(), tensordict), "accepting": accepted.float().mean()})
