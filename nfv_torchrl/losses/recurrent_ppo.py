"""Proximal policy optimisation with memory, from sequences of steps."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from nfv_torchrl.losses.policy_gradient import masked_policy
from nfv_torchrl.losses.sequences import SequenceLoss, recurrent_policy
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import NotNegative, Positive, Share, StopKey

OF_STEPS = ("action_log_prob", "advantage", "value_target")


class RecurrentPPO(SequenceLoss):
    r"""The clipped surrogate of ``PPO`` where policy and state value depend on all steps of the horizon so far.

    $$
    L = -\min\big(\rho_t A_t, \mathrm{clip}(\rho_t, 1 - \epsilon, 1 + \epsilon) A_t\big)
    + c_V \big(V(o_{\le t}) - \hat V_t\big)^2 - c_H H[\pi(\cdot | o_{\le t})], \qquad
    \rho_t = \frac{\pi(a_t | o_{\le t})}{\pi_{old}(a_t | o_{\le t})}
    $$

    over valid actions only, with generalised advantage estimates that end with the request (see ``PolicyGradient``;
    Schulman et al., "Proximal Policy Optimization Algorithms", arXiv:1707.06347, eq. 9; with memory: Ni, Eysenbach,
    Salakhutdinov, "Recurrent Model-Free RL Can Be a Strong Baseline for Many POMDPs", ICML 2022). A row is a sequence
    of ``collector.steps`` steps. It begins with the memory that the policy had there, is run through by the present
    weights, and gradients go back to its first step: what was remembered of one request learns from the next ones. The
    memory is zero again where a horizon begins within it.

    One network has both: of two outputs per action the first are the policy's log-odds, and the mean of the second over
    the valid actions is the state value. So there is one memory, and it serves both.

    Args:
        network: factory of a network with ``unroll``, as ``GRUNetwork`` has it.
        sizes: sizes of observation and actions.
        gamma: discount per step.
        lmbda: lambda of the advantages.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests. The memory goes
            across requests in either case.
        clip_epsilon: epsilon.
        entropy_coeff: c_H.
        critic_coeff: c_V.
        normalize_advantage: advantages of a minibatch to mean 0 and deviation 1.

    Rows are those of ``SequenceLoss``, so ``learner.minibatch`` counts sequences, with ``action_log_prob`` float32 [T]
    and, from ``prepare``, ``advantage`` and ``value_target`` float32 [T, 1]. Writes what ``PPO`` writes.

    Raises:
        ScenarioError: the network has no memory.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 1.0,
        lmbda: Share = 0.95,
        stop_at: StopKey = "request_done",
        clip_epsilon: Positive = 0.2,
        entropy_coeff: NotNegative = 0.01,
        critic_coeff: NotNegative = 0.5,
        normalize_advantage: bool = True,
    ) -> None:
        made = network(sizes, outputs=2)
        super().__init__(made, stop_at=stop_at)
        self.gamma, self.lmbda = gamma, lmbda
        self.adopt(made, actor=recurrent_policy(made, sizes.actions), target=False)
        # It gets log-odds and state values that have been computed along the sequences.
        self.objective = ClipPPOLoss(
            masked_policy(given("logits"), sizes.actions),
            given("state_value"),
            clip_epsilon=clip_epsilon,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            normalize_advantage=normalize_advantage,
            loss_critic_type="l2",
            functional=False,
        )

    @property
    def in_keys(self) -> list[str]:
        """What ``forward`` reads."""
        return [*super().in_keys, *OF_STEPS]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Sequences with advantages along them, one for each environment of [B, T]."""
        rows = super().prepare(data)
        with torch.no_grad():
            _, values = self._policy_and_values(rows)
        stop = rows.get("stop").unsqueeze(-1)
        reward = rows.get("reward").unsqueeze(-1)
        advantage, goal = vec_generalized_advantage_estimate(
            self.gamma, self.lmbda, values[:, :-1], values[:, 1:], reward, done=stop, terminated=stop
        )
        more = {"action_log_prob": data.get("action_log_prob"), "advantage": advantage, "value_target": goal}
        return rows.update(more)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The objective on sequences of ``prepare``."""
        logits, values = (output[:, :-1] for output in self._policy_and_values(tensordict))
        steps = {"logits": logits, "state_value": values, "action_mask": tensordict.get("action_mask")[:, :-1]}
        steps |= {key: tensordict.get(key) for key in ("action", *OF_STEPS)}
        return self.objective(TensorDict(steps, batch_size=values.shape[:2]).reshape(-1))

    def _policy_and_values(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Log-odds [batch, T + 1, A] and state values [batch, T + 1, 1]."""
        logits, worth = self.unrolled(tensordict, self.value_network_params).unbind(-1)
        mask = tensordict.get("action_mask")
        return logits, worth.masked_fill(~mask, 0.0).sum(-1, keepdim=True) / mask.sum(-1, keepdim=True)


def given(key: str) -> TensorDictModule:
    """A module that leaves the entry ``key`` as it is."""
    return TensorDictModule(nn.Identity(), in_keys=[key], out_keys=[key])
