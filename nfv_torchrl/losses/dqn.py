"""Deep Q-learning, the paper's loss, and double Q-learning."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives import DQNLoss, distance_loss

from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import Acting
from nfv_torchrl.losses.some_values import serves, some_values
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Distance, Share, StopKey


class DQN(Acting, DQNLoss):
    r"""Mean squared temporal-difference error over valid actions.

    $$
    \big(r + \gamma (1 - d') \max_{a' \in A_p(s')} \bar Q(s', a') - Q(s, a)\big)^2
    $$

    with $\bar Q$ the target network and $d'$ the end of the request, so that nothing is learned across
    requests (section "DQN-AR" of the paper; Mnih et al., "Human-level control through deep reinforcement learning",
    Nature 518, 2015). With ``double`` the online network chooses $a'$ and the target network values it (van
    Hasselt, Guez, Silver, "Deep Reinforcement Learning with Double Q-learning", AAAI 2016).

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        gamma: discount per step.
        double: choose the next action by the online network.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation, ``reward`` float32 [1] and ``stop_at`` bool [1]. Writes ``loss`` []. Logs nothing else.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        double: bool = False,
        loss_function: Distance = "l2",
        stop_at: StopKey = "request_done",
    ) -> None:
        actor = greedy_actor(network(sizes), sizes.actions)
        super().__init__(
            actor, action_space="categorical", delay_value=True, double_dqn=double, loss_function=loss_function
        )
        self.set_keys(done=stop_at, terminated=stop_at)
        self.make_value_estimator(gamma=gamma)
        self.act_by(actor)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of a batch of transitions; see ``MaskedLoss`` for the keys of a prioritised memory."""
        if serves(self._network, tensordict):
            return self._forward_some(tensordict)
        values = super().forward(tensordict)
        priority = tensordict.get(self.tensor_keys.priority)
        tensordict.set(self.tensor_keys.priority, priority.sqrt())  # the size of the error; TorchRL writes its square
        return values

    @property
    def _network(self) -> nn.Module:
        """The Q-network inside the functional actor; its parameters are elsewhere."""
        actor: Any = self.value_network
        return actor[0].module

    def _forward_some(self, tensordict: TensorDictBase) -> TensorDict:
        """The same, to within rounding, where only the values that are asked for are computed."""
        online = some_values(self._network, self.value_network_params)
        seen, keys = tensordict.get("observation"), self.tensor_keys
        first = online.first(seen)
        taken = online.of(online.hidden(first), tensordict.get(keys.action).reshape(-1))
        with torch.no_grad():
            after = tensordict.get("next")
            observation, mask = after.get("observation"), after.get("action_mask")
            target = some_values(self._network, self.target_value_network_params.data)
            hidden = target.hidden(target.first(observation))
            if self.double_dqn:
                best = online.best(online.hidden(online.first_after(first, seen, observation)), mask)
            else:
                best = target.best(hidden, mask)
            next_value = target.of(hidden, best).unsqueeze(-1)
            goal = self.value_estimator.value_estimate(tensordict, next_value=next_value).squeeze(-1)
            tensordict.set(keys.priority, (goal - taken).abs().unsqueeze(-1))
        loss = distance_loss(taken, goal, self.loss_function)
        weights = tensordict.get(keys.priority_weight, None) if self.use_prioritized_weights else None
        return TensorDict({"loss": self._reduce_loss(loss, tensordict=tensordict, weights=weights)})
