"""What recipes expect of a loss, and what the losses of this package share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from nfv_torchrl.networks import QNetwork


class RequestLoss(Protocol):
    """A ``torchrl.objectives.LossModule`` made as ``MyLoss(network, sizes, **hyperparameters)``.

    ``network`` is a ``NetworkFactory``, so that a loss may ask for several outputs per action.
    """

    actor: TensorDictModule
    """The policy being learned: reads the network's keys and ``action_mask``, writes ``action``."""

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Turn a collected batch [B, T] into what the replay buffer stores, one row an item."""
        ...

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Entries that start with ``loss`` are summed and minimised, the others are logged."""
        ...


def has_target(loss: nn.Module) -> bool:
    """Whether a loss has target networks, which need an updater."""
    return any(name.startswith("target_") for name, _ in loss.named_children())


class Acting:
    """A loss that has an actor. Its parameters are those of the loss already, so it is no submodule of the loss."""

    _actor: tuple[TensorDictModule]

    @property
    def actor(self) -> TensorDictModule:
        """The policy being learned; see ``RequestLoss``."""
        return self._actor[0]

    def act_by(self, actor: TensorDictModule) -> None:
        """Make ``actor`` the policy. In a tuple, which PyTorch does not look into, it is not registered."""
        self._actor = (actor,)

    def _apply(self, fn: Callable[..., Any], *args: Any, **more: Any) -> Any:
        """What ``to`` and its like do, to the actor too.

        It may have buffers of its own, and in a deep copy of the loss its parameters are copies of their own.
        """
        super()._apply(fn, *args, **more)  # type: ignore[misc]
        for actor in getattr(self, "_actor", ()):
            actor._apply(fn, *args, **more)
        return self

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Single transitions: only the keys that the loss reads, [B, T] flattened."""
        return data.select(*self.in_keys).reshape(-1)  # type: ignore[attr-defined]


def transition_keys(seen: Iterable[NestedKey], action: NestedKey, *after: NestedKey) -> list[NestedKey]:
    """The keys of a transition: what is ``seen`` now and under ``next``, the action, and what else is ``after`` it."""
    once = list(dict.fromkeys(seen))
    return [*once, action, *(("next", *(key if isinstance(key, tuple) else (key,))) for key in (*once, *after))]


class MaskedLoss(Acting, LossModule):
    """What the losses of this package share: keys, stored transitions, and calls of networks with their parameters.

    A subclass hands its networks and its actor over by ``adopt``.

    Keys, all of which ``set_keys`` can change: ``action`` int64 [], ``action_mask`` bool [A], and under ``next``
    ``reward`` float32 [1] and ``done`` bool [1], which is ``stop_at`` here: where looking ahead ends. Of a prioritised
    memory also ``priority_weight`` float32 [], the weight of a row in ``mean``, and ``td_error`` float32 [1], the row's
    next priority, which ``prioritise`` writes.

    Args:
        network: a network whose ``in_keys`` the loss reads, now and under ``next``.
        stop_at: ``request_done``, or ``done`` to look across requests.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        action_mask: NestedKey = "action_mask"
        reward: NestedKey = "reward"
        done: NestedKey = "request_done"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    # TorchRL wants the names of functional networks annotated, and finds target networks by theirs.
    value_network: nn.Module
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams
    actor_network: nn.Module
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(self, network: QNetwork, *, stop_at: str = "request_done") -> None:
        super().__init__()
        self.network_keys = tuple(network.in_keys)
        self.set_keys(done=stop_at)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        """There is no value estimator."""

    def adopt(
        self,
        network: nn.Module,
        *,
        actor: TensorDictModule | None = None,
        name: str = "value_network",
        target: bool = True,
    ) -> None:
        """Make the parameters of ``network`` those of this loss; ``outputs(name, ...)`` then calls it.

        Args:
            network: a network to learn.
            actor: a policy made of it, which becomes ``actor``.
            name: ``value_network`` or ``actor_network``; another name has to be annotated as these two are.
            target: keep a target network, too, for a target updater to move.
        """
        self.convert_to_functional(network, name, create_target_params=target)
        if actor is not None:
            self.act_by(actor)

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads."""
        keys = self.tensor_keys
        return transition_keys((*self.network_keys, keys.action_mask), keys.action, keys.reward, keys.done)

    def outputs(self, name: str, tensordict: TensorDictBase, *more: Tensor, target: bool = False) -> Tensor:
        """What network ``name`` returns for the state in ``tensordict``, [batch, A] or [batch, A, outputs].

        ``more``: what the network takes after the inputs that it names.
        """
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        if target:
            # `to_module` would leave the target network's own tensors marked as requiring a gradient.
            params = params.data
        network = getattr(self, name)
        inputs = [tensordict.get(key) for key in self.network_keys]
        with params.to_module(network):
            return network(*inputs, *more)

    def value_of(self, tensordict: TensorDictBase, action: Tensor, *, target: bool = False) -> Tensor:
        """What the value network, of one output, says of one action each, int64 [batch, 1], in the state in
        ``tensordict``; [batch, 1]. A network that has ``values_of`` is not asked for the other actions."""
        network: Any = self.value_network
        if not hasattr(network, "values_of"):
            return self.outputs("value_network", tensordict, target=target).gather(-1, action)
        params = self.target_value_network_params.data if target else self.value_network_params
        with params.to_module(network):
            return network.values_of(*(tensordict.get(key) for key in self.network_keys), action)

    def mask(self, tensordict: TensorDictBase) -> Tensor:
        """A_p of the state in ``tensordict``, bool [batch, A]."""
        return tensordict.get(self.tensor_keys.action_mask)

    def action(self, tensordict: TensorDictBase) -> Tensor:
        """The action taken, int64 [batch, 1]."""
        return tensordict.get(self.tensor_keys.action).unsqueeze(-1)

    def returns(self, tensordict: TensorDictBase, next_value: Tensor, gamma: float | Tensor) -> Tensor:
        """r + gamma (1 - done) next_value; ``next_value`` is [batch, 1] or, of a distribution, [batch, M].

        ``gamma``: one number, or float32 [batch, 1].
        """
        after = tensordict.get("next")
        going_on = ~after.get(self.tensor_keys.done)
        return after.get(self.tensor_keys.reward) + gamma * going_on * next_value

    def mean(self, values: Tensor, tensordict: TensorDictBase) -> Tensor:
        r"""The mean of ``values`` [batch, ...] over the rows of ``tensordict``, [].

        If the rows have a ``priority_weight`` w, which a prioritised memory gives them so that rows it draws more often
        do not count more, it is $\sum_i w_i l_i / \sum_i w_i$ with l the mean of a row (Schaul et al., "Prioritized
        Experience Replay", ICLR 2016, section 3.4; the quotient is TorchRL's).
        """
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is None:
            return values.mean()
        weights = weights.reshape(-1)
        return (values.reshape(len(weights), -1).mean(-1) * weights).sum() / weights.sum()

    def prioritise(self, tensordict: TensorDictBase, error: Tensor) -> None:
        """Write the mean size of each row's ``error`` [batch, ...] to ``td_error`` [batch, 1], its next priority."""
        size = error.detach().abs().reshape(len(error), -1).mean(-1, keepdim=True)
        tensordict.set(self.tensor_keys.priority, size)
