"""The recurrent deterministic policy gradient, for actions that are one of many."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from nfv_torchrl.losses.masked import masked_argmax, masked_expectation, masked_softmax
from nfv_torchrl.losses.sequences import SequenceLoss, recurrent_policy, sequence_priority
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Natural, NotNegative, Positive, Share, StopKey


class RDPG(SequenceLoss):
    r"""A deterministic policy and a critic with memory; the policy climbs the critic's slope at its own action.

    $$
    \begin{aligned}
    J_Q &= \big(r_t + \gamma (1 - d_{t+1}) \bar Q(o_{\le t+1}, \bar\mu(o_{\le t+1})) - Q(o_{\le t}, a_t)\big)^2, \quad
    \bar\mu(o_{\le t}) = \arg\max_{a \in A_p(s_t)} \bar f(o_{\le t}, a) \\
    J_\mu &= - \sum_{a \in A_p(s_t)} \hat a_t(a) \, Q(o_{\le t}, a)
    + \frac{c}{|A_p(s_t)|} \sum_{a \in A_p(s_t)} f(o_{\le t}, a)^2, \quad
    \hat a_t = \mathrm{onehot}\Big(\arg\max_{a \in A_p(s_t)} \big(f(o_{\le t}, a) + g_a\big)\Big)
    \end{aligned}
    $$

    with f the policy's log-odds, g standard Gumbel noise and $\partial \hat a_t / \partial f$ taken to be that of
    $\mathrm{softmax}((f + g) / \tau)$ over the valid actions. It is what the paper names as future work ("Recurrent
    Deterministic Policy Gradient"): Heess, Hunt, Lillicrap, Silver, "Memory-Based Control with Recurrent Neural
    Networks", 2015, eqs. 5 and 6, with sequences from a replay memory that begin with their stored memory (Kapturowski
    et al., ICLR 2019). A target network has both the policy and the critic.

    **Which form for discrete actions, and why.** The deterministic policy gradient needs the slope of Q by the action,
    so an action has to be a point of a space in which Q has one. Here it is a corner of the simplex, a one-hot vector,
    with a straight-through Gumbel-softmax (Jang, Gu, Poole, "Categorical Reparameterization with Gumbel-Softmax", ICLR
    2017; as Lowe et al., "Multi-Agent Actor-Critic", NeurIPS 2017, use it). The other known form, Wolpertinger
    (Dulac-Arnold et al., 2015), looks for the valid actions nearest to a point in an embedding and lets the critic
    choose among them. It is made for very many actions with a known geometry. Here a node has some ten valid actions,
    the mask changes with every step, and nothing says which of them are near each other; with ten neighbours the critic
    would choose alone, and that is ``RecurrentDQN``. And the mask enters the softmax exactly.

    The critic is linear in the action vector: $Q(o, a) = \sum_b a_b Q(o, b)$. Only corners are ever played, so nothing
    could teach it what lies between them, and the slope at a corner then is what the other corners are worth.

    One network has both: of two outputs per action the first is f and the second Q. So there is one memory, which is
    stored with the steps, and it serves both. Neither objective reaches the other's output.

    The policy explores by the same Gumbel noise, which makes it sample from softmax(f); in an evaluation there is none.
    The last term keeps f small, so that neither noise nor slope die out.

    Args:
        network: factory of a network with ``unroll``, as ``GRUNetwork`` has it.
        sizes: sizes of observation and actions.
        gamma: discount per step.
        temperature: tau.
        decay: c.
        burn_in: first steps of a sequence that are not learned from.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests. The memory goes
            across requests in either case.

    Rows are sequences, see ``SequenceLoss``: ``buffer.size`` and ``buffer.batch_size`` count them. Writes
    ``loss_qvalue`` and ``loss_actor`` []. Logs ``td_error`` [], the mean absolute error.

    Raises:
        ScenarioError: the network has no memory, negative ``burn_in``.
    """

    out_keys = ["loss_qvalue", "loss_actor", "td_error"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 0.95,
        temperature: Positive = 1.0,
        decay: NotNegative = 1e-3,
        burn_in: Natural = 0,
        stop_at: StopKey = "request_done",
    ) -> None:
        made = network(sizes, outputs=2)
        super().__init__(made, burn_in=burn_in, stop_at=stop_at)
        self.adopt(made, actor=recurrent_policy(made, sizes.actions))
        self.gamma, self.temperature, self.decay = gamma, temperature, decay

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The two losses of sequences made by ``prepare``."""
        k = self.burn_in
        mask = tensordict.get("action_mask")[:, k:]
        logits, values = self.unrolled(tensordict, self.value_network_params)[:, :-1].unbind(-1)
        taken = values.gather(-1, tensordict.get("action")[:, k:].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            error = self._target(tensordict, mask) - taken
        self.prioritise(tensordict, sequence_priority(error.abs()))
        goal = taken.detach() + error
        here = mask[:, :-1]
        gain = masked_expectation(self.choice(logits, here), values.detach(), here)
        size = masked_expectation(here / here.sum(-1, keepdim=True), logits.masked_fill(~here, 0.0).square(), here)
        return TensorDict(
            {
                "loss_qvalue": self.mean((goal - taken).square(), tensordict),
                "loss_actor": self.mean(self.decay * size - gain, tensordict),
                "td_error": error.abs().mean(),
            }
        )

    def _target(self, tensordict: TensorDictBase, mask: Tensor) -> Tensor:
        """r + gamma (1 - d) Q of the target's own next action, [batch, T - burn_in]."""
        logits, values = self.unrolled(tensordict, self.target_value_network_params.data)[:, 1:].unbind(-1)
        ahead = values.gather(-1, masked_argmax(logits, mask[:, 1:])).squeeze(-1)
        k = self.burn_in
        return tensordict.get("reward")[:, k:] + self.gamma * ~tensordict.get("stop")[:, k:] * ahead

    def choice(self, logits: Tensor, mask: Tensor) -> Tensor:
        """One-hot actions of noisy log-odds, float32 [..., A], with the slope of their softmax."""
        noise = -torch.empty_like(logits).exponential_().log()
        soft = masked_softmax((logits + noise) / self.temperature, mask)
        hard = torch.zeros_like(soft).scatter_(-1, soft.argmax(-1, keepdim=True), 1.0)
        return hard + soft - soft.detach()
