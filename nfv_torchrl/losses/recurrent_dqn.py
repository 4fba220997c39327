"""Deep Q-learning with memory, from sequences of steps."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import distance_loss

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.base import MaskedLoss
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.settings.values import Distance, Natural, Share, StopKey


class RecurrentDQN(MaskedLoss):
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

    ``prepare`` turns a batch [B, T] into B sequences: ``observation`` float32 [T + 1, P] and ``action_mask`` bool
    [T + 1, A], of the T steps and of what followed the last; ``restart`` bool [T + 1], steps that begin a horizon;
    ``memory`` float32 [H] before the first; ``action`` int64 [T], ``reward`` float32 [T] and ``stop`` bool [T]. So
    ``buffer.size`` and ``buffer.batch_size`` count sequences.

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
        if burn_in < 0:
            raise ScenarioError(f"loss.burn_in is {burn_in}; use 0 or more steps")
        made = network(sizes)
        if not hasattr(made, "unroll"):
            raise ScenarioError(f"{type(made).__name__} has no memory; use a network that has one, such as network=gru")
        super().__init__(made, stop_at=stop_at)
        self.adopt(made, actor=recurrent_actor(made, sizes.actions))
        self.gamma, self.double, self.burn_in = gamma, double, burn_in
        self.loss_function = loss_function

    @property
    def in_keys(self) -> list[str]:
        """What ``forward`` reads."""
        return ["observation", "action_mask", "restart", "memory", "action", "reward", "stop"]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """One sequence for each environment of [B, T]."""
        after = data.get("next")
        if data.shape[1] <= self.burn_in:
            raise ScenarioError(f"loss.burn_in is {self.burn_in}; collector.steps={data.shape[1]} must be larger")

        def with_next(key: str) -> Tensor:
            return torch.cat([data.get(key), after.get(key)[:, -1:]], 1)

        done = after.get("done").squeeze(-1)
        return TensorDict(
            {
                "observation": with_next("observation"),
                "action_mask": with_next("action_mask"),
                "restart": torch.cat([torch.zeros_like(done[:, :1]), done], 1),
                "memory": data.get("memory")[:, 0],
                "action": data.get("action"),
                "reward": after.get("reward").squeeze(-1),
                "stop": after.get(self.tensor_keys.done).squeeze(-1) | done,
            },
            batch_size=data.shape[:1],
        )

    def _values(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Values float32 [batch, T + 1 - burn_in, A] under ``params``, invalid actions at their lowest."""
        seen, restart, memory = (tensordict.get(key) for key in ("observation", "restart", "memory"))
        k = self.burn_in
        with params.to_module(self.value_network):
            network: QNetwork = self.value_network  # type: ignore[assignment]
            if k:
                with torch.no_grad():
                    _, memory = network.unroll(seen[:, :k], memory, restart[:, :k])  # type: ignore[operator]
            values, _ = network.unroll(seen[:, k:], memory, restart[:, k:])  # type: ignore[operator]
        return values.masked_fill(~tensordict.get("action_mask")[:, k:], torch.finfo(values.dtype).min)

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


def sequence_priority(error: Tensor) -> Tensor:
    """0.9 of a sequence's largest error and 0.1 of its mean, from errors of at least 0, [batch, T] to [batch, 1].

    A mean alone would hide the one step that is to be learned from (Kapturowski et al. 2019, section 2.3).
    """
    return 0.9 * error.amax(-1, keepdim=True) + 0.1 * error.mean(-1, keepdim=True)


def recurrent_actor(network: QNetwork, actions: int) -> QValueActor:
    """The greedy policy of a Q-network with memory: as ``greedy_actor``, but it writes ``("next", "memory")`` too."""
    keys = ["action_value", ("next", "memory")]
    module = TensorDictModule(network, in_keys=list(network.in_keys), out_keys=keys)
    return QValueActor(module, spec=Categorical(actions), action_space="categorical", action_mask_key="action_mask")
