"""Deep Q-learning with memory, from sequences of steps."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import distance_loss

from nfv_torchrl.losses.sequences import SequenceLoss, sequence_priority
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.settings.values import Distance, Natural, Share, StopKey


class RecurrentDQN(SequenceLoss):
    r"""Mean squared temporal-difference error of a Q-network with memory, over sequences across requests.

    $$
    \big(r_t + \gamma (1 - d_{t+1}) \max_{a' \in A_p(s_{t+1})} \bar Q(o_{\le t+1}, a')
    - Q(o_{\le t}, a_t)\big)^2
    $$

    summed back through the whole sequence: the gradient of a later request's error reaches what was remembered of
    earlier ones. It is the value-based form of the recurrent policy gradient that the paper names as future work
    (Hausknecht, Stone, "Deep Recurrent Q-Learning for Partially Observable MDPs", 2015). Sequences begin with the
    memory stored when they were collected; ``burn_in`` steps only bring it up to date with the present weights
    (Kapturowski et al., "Recurrent Experience Replay in Distributed Reinforcement Learning", ICLR 2019). Online and
    target network both run over the sequence from there; with ``double`` the online network chooses $a'$.

    Args:
        network: factory of a network with ``unroll``, as ``GRUNetwork`` has it.
        sizes: sizes of observation and actions.
        gamma: discount per step.
        double: choose the next action by the online network.
        burn_in: first steps of a sequence that are not learned from.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests. The memory goes
            across requests in either case.

    Rows are sequences, see ``SequenceLoss``: ``buffer.size`` and ``buffer.batch_size`` count them.

    Writes ``loss`` [] and, to log, ``td_error`` [], the mean absolute error.

    Raises:
        ScenarioError: the network has no memory, negative ``burn_in``.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        double: bool = True,
        burn_in: Natural = 0,
        loss_function: Distance = "l2",
        stop_at: StopKey = "request_done",
    ) -> None:
        made = network(sizes)
        super().__init__(made, burn_in=burn_in, stop_at=stop_at)
        self.adopt(made, actor=recurrent_actor(made, sizes.actions))
        self.gamma, self.double, self.loss_function = gamma, double, loss_function

    def _values(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Values float32 [batch, T + 1 - burn_in, A] under ``params``, invalid actions at their lowest."""
        values = self.unrolled(tensordict, params)
        return values.masked_fill(~tensordict.get("action_mask")[:, self.burn_in :], torch.finfo(values.dtype).min)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of sequences made by ``prepare``."""
        k = self.burn_in
        values = self._values(tensordict, self.value_network_params)
        chosen = values[:, :-1].gather(-1, tensordict.get("action")[:, k:].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            target = self._values(tensordict, self.target_value_network_params.data)[:, 1:]
            best = (values[:, 1:] if self.double else target).argmax(-1, keepdim=True)
            ahead = self.gamma * ~tensordict.get("stop")[:, k:] * target.gather(-1, best).squeeze(-1)
            target_value = tensordict.get("reward")[:, k:] + ahead
        error = (chosen - target_value).detach().abs()
        self.prioritise(tensordict, sequence_priority(error))
        loss = self.mean(distance_loss(chosen, target_value, self.loss_function), tensordict)
        return TensorDict({"loss": loss, "td_error": error.mean()})


def recurrent_actor(network: QNetwork, actions: int) -> QValueActor:
    """The greedy policy of a Q-network with memory: as ``greedy_actor``, but it writes ``("next", "memory")`` too."""
    keys = ["action_value", ("next", "memory")]
    module = TensorDictModule(network, in_keys=list(network.in_keys), out_keys=keys)
    return QValueActor(module, spec=Categorical(actions), action_space="categorical", action_mask_key="action_mask")
