"""What the policy-gradient losses share: a masked categorical actor, a critic, and advantages within a request."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.modules import NoisyLinear as TorchRLNoisyLinear
from torchrl.objectives import LossModule, ValueEstimators

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.networks.layers import NoisyLinear

LOWEST = torch.finfo(torch.float32).min
"""Log-odds of an invalid action. With minus infinity its 0 * log 0 would be NaN in the entropy's gradient."""


def masked_actor(network: QNetwork, actions: int, lowest: float = LOWEST) -> ProbabilisticActor:
    """The policy pi(a | s), proportional to exp(logits) over the valid actions, ``actions`` with reject.

    It samples while it explores (``ExplorationType.RANDOM``) and takes the most probable valid action otherwise.
    Reads the network's ``in_keys`` and ``action_mask``; writes ``logits`` float32 [..., A], ``action`` int64 [...] and
    ``action_log_prob`` float32 [...]. ``lowest``: the log-odds of invalid actions.
    """
    if hasattr(network, "unroll"):
        raise ScenarioError("network: one with memory learns from sequences: use pg_loss=recurrent_ppo")
    return masked_policy(TensorDictModule(network, in_keys=list(network.in_keys), out_keys=["logits"]), actions, lowest)


def refuse_noise(network: nn.Module) -> None:
    """A policy gradient needs the probability with which the policy that acted took its action.

    Raises:
        ScenarioError: a layer draws random numbers: each call is another policy.
    """
    noisy = (NoisyLinear, TorchRLNoisyLinear, nn.modules.dropout._DropoutNd)
    drawing = next((type(layer).__name__ for layer in network.modules() if isinstance(layer, noisy)), None)
    if drawing is not None:
        raise ScenarioError(
            f"network: its layers {drawing} draw random numbers, so no two calls are the same policy, and policy "
            "gradients explore by sampling actions: leave out network.noisy=true, or set network=mlp"
        )


def masked_policy(module: TensorDictModule, actions: int, lowest: float = LOWEST) -> ProbabilisticActor:
    """The same policy, of a ``module`` that writes ``logits``."""
    return ProbabilisticActor(
        module,
        in_keys={"logits": "logits", "mask": "action_mask"},
        out_keys=["action"],
        distribution_class=MaskedCategorical,
        distribution_kwargs={"neg_inf": lowest},
        return_log_prob=True,
        log_prob_key="action_log_prob",
        spec=Categorical(actions),
    )


class StateValue(nn.Module):
    """V(s) float32 [..., 1]: the mean over the valid actions of what a network of the actor's kind gives to each.

    So any network can be a critic, one that serves every size of substrate too. Inputs: the network's, then
    ``action_mask`` bool [..., A].
    """

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> Tensor:
        """See the class."""
        *seen, mask = inputs
        values = self.network(*seen).masked_fill(~mask, 0.0)
        return values.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True)


def state_values(network: QNetwork) -> TensorDictModule:
    """A critic that writes ``state_value`` float32 [..., 1], see ``StateValue``."""
    keys = [*network.in_keys, "action_mask"]
    return TensorDictModule(StateValue(network), in_keys=keys, out_keys=["state_value"])


Objective = Callable[[ProbabilisticActor, TensorDictModule], LossModule]
"""Makes a TorchRL loss of an actor and a critic, with ``functional=False``."""


class PolicyGradient(nn.Module):
    r"""Base of the policy-gradient losses: a ``RequestLoss`` around a TorchRL objective.

    The advantages are generalised advantage estimates (Schulman et al., "High-Dimensional Continuous Control Using
    Generalized Advantage Estimation", ICLR 2016)

    $$
    A_t = \sum_{l \ge 0} (\gamma \lambda)^l \delta_{t+l}, \qquad
    \delta_t = r_t + \gamma (1 - d_{t+1}) V(s_{t+1}) - V(s_t)
    $$

    whose sum and whose look ahead end with the request ($d$), or go on across requests with ``stop_at: done``.
    $\lambda = 1$ gives the return to the end of the request less the critic's baseline.

    Args:
        network: factory of the actor's network, whose values are the logits; the critic gets another of its kind.
        sizes: sizes of observation and actions.
        objective: makes the TorchRL loss.
        gamma: discount per step.
        lmbda: lambda of the advantages.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys that ``prepare`` reads from a batch [B, T]: the network's ``in_keys``, ``action_mask`` bool [A], ``action``
    int64 [], ``action_log_prob`` float32 [], and under ``next`` the same observation, ``reward`` float32 [1],
    ``stop_at`` and ``done`` bool [1]. It adds ``advantage`` and ``value_target`` float32 [1] and gives [B T] rows.

    Raises:
        ScenarioError: the network has a memory, or layers that draw random numbers (``network=noisy``).
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        objective: Objective,
        *,
        gamma: float,
        lmbda: float,
        stop_at: str,
    ) -> None:
        super().__init__()
        made = network(sizes)
        refuse_noise(made)
        actor = masked_actor(made, sizes.actions)
        critic = state_values(network(sizes))
        self._observed = list(dict.fromkeys(critic.in_keys))
        self.objective = objective(actor, critic)
        self.objective.set_keys(done="stop", terminated="stop")
        self.objective.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=lmbda)
        self._stop_at = stop_at

    @property
    def actor(self) -> ProbabilisticActor:
        """The policy being learned; see ``masked_actor``."""
        return self.objective.actor_network

    @property
    def critic(self) -> TensorDictModule:
        """Writes ``state_value`` float32 [..., 1]."""
        return self.objective.critic_network

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Advantages along the time dimension of [B, T], then the rows that the objective reads, [B T]."""
        following = [("next", key) if isinstance(key, str) else ("next", *key) for key in self._observed]
        # A horizon without requests ends without the end of a request.
        stop = data.get(("next", self._stop_at)) | data.get(("next", "done"))
        data = data.select(*self._observed, "action", "action_log_prob", *following, ("next", "reward"))
        data.set(("next", "stop"), stop)
        with torch.no_grad():
            self.objective.value_estimator(data)
        rows = data.reshape(-1)
        kept = (*self._observed, "action", "action_log_prob", "advantage", "value_target", "state_value")
        return rows.select(*kept)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The objective on rows of ``prepare``."""
        return self.objective(tensordict)
