"""What the losses that look across requests share: targets whose discount falls at the ends of requests."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import distance_loss

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.losses.masked import masked_argmax
from nfv_torchrl.losses.n_step import last_of_sums, n_step_returns
from nfv_torchrl.networks import NetworkFactory, Sizes


class AcrossRequests(MaskedLoss):
    r"""Q-learning in which time passes between requests and not within them.

    $$
    y_t = \sum_{i=0}^{k-1} D_i \, \big(r_{t+i} - e_{t+i} \, \bar r_{m(t+i)}\big)
    + D_k (1 - d_{t+k}) \bar Q(s_{t+k}, a^*), \quad D_i = \prod_{j<i} \gamma_{t+j}, \quad
    a^* = \arg\max_{a' \in A_p(s_{t+k})} Q(s_{t+k}, a')
    $$

    with e = 1 for a step that ends a request and 0 for the others, $\gamma_t$ = 1 for a step that does not, d the
    end of the horizon, and $\bar r_m$ the reward rate: what a request of service m earns on average, or any
    request if ``by_service`` is False. A subclass says what $\gamma_t$ is at the end of a request
    (``request_discount``) and how the rate is learned. The error $y_t - Q(s_t, a_t)$ is minimised.

    k = 1 for a step within a request. For the last step of a request it is n, or fewer where the horizon, the segment
    or the collected batch ends sooner; the look ahead goes on from the end of a segment, which is not the end of the
    horizon. So the luck of later requests, which a long sum brings along, is averaged in the values of last steps and
    does not reach the choice of a path, where small costs decide. What was explored within the n steps is not corrected
    for.

    Taking off the rate leaves the choice of actions alone, since one request after the other ends whatever is done,
    and of the type that arrives; but values stay near 0, where a network learns them soon, instead of near
    $\bar r / (1 - \gamma)$. Rates by service also take the luck of which types arrive out of the sums.

    Needs ``admission_control``, for a policy that may not refuse has little to look ahead for. Network observations
    that show a request's surroundings alone (``candidate``) hide from the next request what this one did to the rest of
    the network: there n has to span many requests, whereas one step may do for ``mlp``, which sees all.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        n: most rewards to sum after a request; ``collector.steps`` should be larger.
        double: choose the next action by the online network, else by the target network.
        by_service: a rate for each service type.
        environments: E. With more than 1 each row b of a collected batch has rates of its own, those of environment
            b modulo E: what a request earns on average differs between networks, and learning need not see that.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.

    Keys read: the network's ``in_keys``, ``action_mask`` bool [A], ``action`` int64 [], and under ``next`` the same
    observation and mask, k steps on, with ``reward`` float32 [1], the sum of the $D_i r_{t+i}$, ``terminated``
    bool [1], ``discount`` float32 [1], which is $D_k$, and ``requests`` float32 [M], the sum of
    $D_i e_{t+i}$ by service (M = 1 or the number of types); with several environments also ``environment`` int64 [1].
    ``prepare`` makes them from a batch [B, T], time in
    dimension 1, with ``request_done`` bool [1], ``done`` bool [1] and ``outcome`` under ``next``.

    Writes ``loss`` []. Logs ``reward_rate`` [], the mean rate over services, and ``td_error`` [], the mean absolute
    error.
    """

    @dataclass
    class _AcceptedKeys(MaskedLoss._AcceptedKeys):
        discount: NestedKey = "discount"
        requests: NestedKey = "requests"
        environment: NestedKey = "environment"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    rate: Tensor
    """Reward rate of each service, float32 [M], or [E, M] with several environments."""
    out_keys = ["loss", "reward_rate", "td_error"]  # noqa: RUF012  as TorchRL's losses have it

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        n: int = 1,
        double: bool = True,
        by_service: bool = False,
        environments: int = 1,
        loss_function: str = "l2",
    ) -> None:
        if n < 1:
            raise ScenarioError(f"loss.n is {n}; at least one reward is summed")
        q_network = network(sizes)
        super().__init__(q_network, stop_at="terminated")
        self.n, self.double, self.by_service, self.loss_function = n, double, by_service, loss_function
        self.adopt(q_network, actor=greedy_actor(q_network, sizes.actions))
        self.environments = environments
        rates = sizes.services if by_service else 1
        self.register_buffer("rate", torch.zeros(rates) if environments == 1 else torch.zeros(environments, rates))

    @abstractmethod
    def request_discount(self, after: TensorDictBase) -> Tensor | float:
        """The discount of what follows a step that ends a request, float32 [B, T] or one for all.

        ``after`` is what a collected batch has under ``next``.
        """

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``prepare`` reads; ``forward`` reads ``discount`` and ``requests`` in place of the last four."""
        outcome = (("next", "outcome", "service"), ("next", "outcome", "slots_closed"))
        return [*super().in_keys, ("next", "request_done"), ("next", "done"), *outcome]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Transitions of one step within a request and of up to n from its end on, [B, T] flattened."""
        after, keys = data.get("next"), self.tensor_keys
        self.collected(after)
        reward = after.get(keys.reward).squeeze(-1)
        stop = (after.get("done") | after.get(keys.done)).squeeze(-1)
        ends = self.ends(after)
        over = ends.any(-1)
        discount = torch.where(over, torch.as_tensor(self.request_discount(after), dtype=reward.dtype), 1.0)
        total, steps, ahead = n_step_returns(reward, stop, self.n, discount)
        requests = [n_step_returns(end.to(reward.dtype), stop, self.n, discount)[0] for end in ends.unbind(-1)]
        steps = torch.where(over, steps, 1)
        out = data.select(*super().in_keys)
        out.set("next", out.get("next")[last_of_sums(steps)])
        out.set(_after(keys.reward), torch.where(over, total, reward).unsqueeze(-1))
        out.set(_after(keys.discount), torch.where(over, ahead, 1.0).unsqueeze(-1))
        out.set(_after(keys.requests), torch.stack(requests, -1) * over.unsqueeze(-1))
        if self.environments > 1:
            out.set(_after(keys.environment), self.environment(after))
        return out.reshape(-1)

    def ends(self, after: TensorDictBase) -> Tensor:
        """Which steps end a request, of which service: bool [B, T, M]."""
        over = after.get("request_done")
        if not self.by_service:
            return over
        service = after.get(("outcome", "service")).squeeze(-1)
        return over & (service.unsqueeze(-1) == torch.arange(self.rate.shape[-1], device=service.device))

    def environment(self, after: TensorDictBase) -> Tensor:
        """The environment of each step, int64 [B, T, 1]."""
        rows, steps = after.batch_size
        return (torch.arange(rows, device=after.device) % self.environments).view(rows, 1, 1).expand(-1, steps, -1)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of transitions made by ``prepare``."""
        taken = self.value_of(tensordict, self.action(tensordict))
        with torch.no_grad():
            goal = self._target(tensordict)
            error = goal - taken
            self.learn_rate(error, tensordict.get(_after(self.tensor_keys.requests)))
        self.prioritise(tensordict, error)
        loss = self.mean(distance_loss(taken, goal, self.loss_function), tensordict)
        return TensorDict({"loss": loss, "reward_rate": self.rate.mean(), "td_error": error.abs().mean()})

    def collected(self, after: TensorDictBase) -> None:
        """Called with what every batch of ``prepare`` has under ``next``. Override it to learn rates from that."""

    def learn_rate(self, error: Tensor, requests: Tensor) -> None:
        """Called with the errors y - Q, float32 [batch, 1], and ``requests`` [batch, M]. Override it to learn rates."""

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """y, float32 [batch, 1]."""
        after, keys = tensordict.get("next"), self.tensor_keys
        best = masked_argmax(self.outputs("value_network", after, target=not self.double), self.mask(after))
        ahead = self.returns(tensordict, self.value_of(after, best, target=True), after.get(keys.discount))
        rate = self.rate
        if self.environments > 1:
            rate = rate[after.get(keys.environment).squeeze(-1)]
        return ahead - (after.get(keys.requests) * rate).sum(-1, keepdim=True)


def _after(key: NestedKey) -> tuple[str, ...]:
    return ("next", *(key if isinstance(key, tuple) else (key,)))
