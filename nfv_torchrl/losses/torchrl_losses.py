"""TorchRL's own loss classes as losses of requests: networks, masks and keys that they need, and what is put right.

``docs/extending.md`` has the table of what holds for each class. What may be set of them is in
``nfv_torchrl.settings.torchrl_losses``.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    DiscreteCQLLoss,
    DiscreteIQLLoss,
    DiscreteSACLoss,
    DistributionalDQNLoss,
    DQNLoss,
    LossModule,
    ReinforceLoss,
)
from torchrl.objectives.value import ValueEstimatorBase

from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.losses.actors import greedy_actor
from nfv_torchrl.losses.base import Acting, transition_keys
from nfv_torchrl.losses.masked import masked_argmax
from nfv_torchrl.losses.policy_gradient import PolicyGradient, masked_actor, state_values
from nfv_torchrl.networks import NetworkFactory, QNetwork, Sizes
from nfv_torchrl.settings.torchrl_losses import check_settings, served

UNLIKELY = -1e30
"""Log-odds of an invalid action where TorchRL multiplies log-probabilities by a weight. With minus infinity, or the
lowest float and a weight above 1, there would be a probability of 0 times minus infinity."""
GAMMA, LMBDA = 0.99, 0.95
"""TorchRL's own."""


def request_loss(make: Callable[..., Any]) -> Callable[..., Any]:
    """What makes a loss as ``make(network, sizes, **settings)``, for a class of TorchRL's, too.

    Args:
        make: a ``RequestLoss`` class, which is returned as it is; a loss class of TorchRL's, or one derived from it; or
            a ``partial`` of either.

    Raises:
        ScenarioError: a loss class of TorchRL's that does not serve here.

    Example::

        loss = request_loss(torchrl.objectives.DQNLoss)(network, sizes, gamma=0.95, double_dqn=True)
    """
    kind, settings = (make.func, make.keywords) if isinstance(make, partial) else (make, {})
    return make if served(kind) is None else partial(torchrl_loss, kind, **settings)


def torchrl_loss(kind: Any, network: NetworkFactory, sizes: Sizes, **settings: Any) -> Any:
    """A loss of TorchRL's with networks from ``network``, masked in choice and target.

    Args:
        kind: the class, or one derived from it.
        network: factory of the networks.
        sizes: sizes of observation and actions.
        settings: hyperparameters of the class, with ``gamma``, ``lmbda`` (policy gradients), ``stop_at`` (as the losses
            of this package have it) and ``atoms``, ``v_min``, ``v_max`` (``DistributionalDQNLoss``).

    Returns:
        A ``RequestLoss``: an object of a class derived from ``kind``, or for policy gradients a ``PolicyGradient``
        around an object of ``kind``.

    Raises:
        ScenarioError: a setting that the class does not have, or a value that it does not take.
    """
    given = check_settings(kind, settings)
    fit = next(FITS[each] for each in kind.__mro__ if each in FITS)
    try:
        return fit(kind, network, sizes, **given)
    except (TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, ScenarioError):
            raise
        raise ScenarioError(f"loss: {kind.__name__} cannot be made ({one_line(error)}); check its settings") from error


def q_learning(
    kind: Any,
    network: NetworkFactory,
    sizes: Sizes,
    *,
    gamma: float = GAMMA,
    stop_at: str = "request_done",
    **settings: Any,
) -> LossModule:
    """``DQNLoss`` and ``DiscreteCQLLoss`` of a greedy actor, which masks values before anything is done with them."""
    actor = greedy_actor(network(sizes), sizes.actions)
    return _finished(_derived(kind)(actor, **settings), actor, gamma, stop_at)


def distributional(
    kind: Any,
    network: NetworkFactory,
    sizes: Sizes,
    *,
    gamma: float = GAMMA,
    stop_at: str = "request_done",
    atoms: int = 51,
    v_min: float = -1.0,
    v_max: float = 1.0,
    **settings: Any,
) -> LossModule:
    """``DistributionalDQNLoss`` of values on ``atoms`` places from ``v_min`` to ``v_max``."""
    if v_min >= v_max:
        raise ScenarioError(f"loss.v_min: {v_min} is not below loss.v_max, {v_max}; values lie between them")
    q_network = network(sizes, outputs=atoms)
    support = torch.linspace(v_min, v_max, atoms)
    loss = _derived(kind)(AtomsModule(q_network, support), gamma=float(gamma), **settings)
    loss.set_keys(done=stop_at, terminated=stop_at)
    loss.act_by(greedy_actor(ExpectedValue(q_network, support), sizes.actions, q_network.in_keys))
    return loss


def soft_actor_critic(
    kind: Any,
    network: NetworkFactory,
    sizes: Sizes,
    *,
    gamma: float = GAMMA,
    stop_at: str = "request_done",
    num_qvalue_nets: int = 2,
    target_entropy: float | str = "auto",
    target_entropy_weight: float = 0.98,
    deactivate_vmap: bool = True,
    **settings: Any,
) -> LossModule:
    """``DiscreteSACLoss`` of a stochastic actor and Q-networks that are each made anew."""
    actor = masked_actor(network(sizes), sizes.actions, UNLIKELY)
    values = _several(network, sizes, num_qvalue_nets, "action_value")
    loss = _derived(kind)(
        actor,
        values,
        action_space="categorical",
        num_actions=sizes.actions,
        num_qvalue_nets=num_qvalue_nets,
        target_entropy=target_entropy,
        target_entropy_weight=target_entropy_weight,
        deactivate_vmap=deactivate_vmap,
        **settings,
    )
    loss.entropy_share = target_entropy_weight if target_entropy == "auto" else None
    return _finished(loss, actor, gamma, stop_at)


def implicit_q_learning(
    kind: Any,
    network: NetworkFactory,
    sizes: Sizes,
    *,
    gamma: float = GAMMA,
    stop_at: str = "request_done",
    num_qvalue_nets: int = 2,
    **settings: Any,
) -> LossModule:
    """``DiscreteIQLLoss`` of a stochastic actor, Q-networks that are each made anew, and state values."""
    actor = masked_actor(network(sizes), sizes.actions, UNLIKELY)
    values = _several(network, sizes, num_qvalue_nets, "state_action_value")
    critic = state_values(network(sizes))
    loss = _derived(kind)(
        actor, values, critic, action_space="categorical", num_qvalue_nets=num_qvalue_nets, **settings
    )
    loss.deactivate_vmap = True  # its constructor does not take it; noise could not be drawn
    loss._make_vmap()
    return _finished(loss, actor, gamma, stop_at)


def policy_gradient(
    kind: Any,
    network: NetworkFactory,
    sizes: Sizes,
    *,
    gamma: float = GAMMA,
    lmbda: float = LMBDA,
    stop_at: str = "request_done",
    **settings: Any,
) -> PolicyGradient:
    """``ClipPPOLoss``, ``A2CLoss``, ``ReinforceLoss`` with the actor, critic and advantages of ``PolicyGradient``."""
    objective: Any = partial(kind, functional=False, **settings)
    return PolicyGradient(network, sizes, objective, gamma=gamma, lmbda=lmbda, stop_at=stop_at)


FITS: dict[type[LossModule], Callable[..., Any]] = {
    DQNLoss: q_learning,
    DistributionalDQNLoss: distributional,
    DiscreteCQLLoss: q_learning,
    DiscreteIQLLoss: implicit_q_learning,
    DiscreteSACLoss: soft_actor_critic,
    ClipPPOLoss: policy_gradient,
    A2CLoss: policy_gradient,
    ReinforceLoss: policy_gradient,
}
"""How each class of TorchRL's is made."""


class Weighted(Acting):
    """Rows count by their ``priority_weight`` where there is one, and each gets a priority, ``td_error`` [batch, 1].

    TorchRL's ``DiscreteCQLLoss`` and ``DiscreteIQLLoss`` leave the weights out.
    """

    def _reduce_loss(self, loss: Tensor, tensordict: TensorDictBase | None = None, **options: Any) -> Tensor:
        if tensordict is not None and options.get("weights") is None:
            options["weights"] = tensordict.get("priority_weight", None)
        return super()._reduce_loss(loss, tensordict, **options)  # type: ignore[misc]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See TorchRL's class."""
        values = super().forward(tensordict)  # type: ignore[misc]
        tensordict.set("td_error", tensordict.get("td_error").detach().reshape(-1, 1))
        return values


class ConservativeTarget(Weighted):
    """``DiscreteCQLLoss`` whose target is that of its target network.

    TorchRL's hands the target network's parameters over under a name that its value estimator does not read, so the
    online network values the next state. What it logs leaves the lowest float of invalid actions out.
    """

    @property
    def value_estimator(self) -> Any:
        """The value estimator, which is asked with the parameters of the target network."""
        estimator = super().value_estimator  # type: ignore[misc]
        return ByTarget(estimator, self.target_value_network_params)  # type: ignore[attr-defined]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See ``DiscreteCQLLoss``; ``td_error`` is absolute, ``pred_value`` of the actions taken."""
        values = super().forward(tensordict)
        taken = tensordict.get("pred_val").gather(-1, tensordict.get("action").unsqueeze(-1))
        values.set("td_error", tensordict.get("td_error").sqrt().mean())
        return values.set("pred_value", taken.detach().mean())


class ByTarget:
    """A value estimator whose next values are those of given parameters."""

    def __init__(self, estimator: ValueEstimatorBase, params: TensorDictBase) -> None:
        self._estimator, self._params = estimator, params

    def value_estimate(self, tensordict: TensorDictBase, **ignored: Any) -> Tensor:
        """r + gamma (1 - done) V(s')."""
        return self._estimator.value_estimate(tensordict, target_params=self._params)


class RecordedEntropy(Weighted):
    """What ``DiscreteIQLLoss`` logs as ``entropy`` is called what it is: ``cross_entropy`` with the actions taken."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See ``DiscreteIQLLoss``."""
        return super().forward(tensordict).rename_key_("entropy", "cross_entropy")


class EntropyOfMask(Weighted):
    """``DiscreteSACLoss`` asks for a share of the entropy that the state's own mask allows, not of log A.

    Where few actions are valid log A cannot be reached, and the temperature would grow without end.
    """

    entropy_share: float | None
    """c; None: ``target_entropy`` is a number of nats."""
    target_entropy: Tensor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See ``DiscreteSACLoss``."""
        self._most = tensordict.get("action_mask").sum(-1).log()
        return super().forward(tensordict)

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        if self.entropy_share is not None:
            log_prob = log_prob + self.entropy_share * self._most - self.target_entropy
        return super()._alpha_loss(log_prob)  # type: ignore[misc]


class AtomShapes(Acting):
    """``DistributionalDQNLoss`` with actions int64 [batch], also of one row."""

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads."""
        keys = self.tensor_keys  # type: ignore[attr-defined]
        return transition_keys(self.value_network.in_keys, keys.action, keys.reward, keys.done)  # type: ignore[attr-defined]

    @staticmethod
    def _log_ps_a_categorical(action: Tensor, action_log_softmax: Tensor) -> Tensor:
        """Log-probabilities of the action's atoms, [batch, atoms]; TorchRL takes [1] for one action of one row."""
        place = action.reshape(-1, 1, 1).expand(-1, action_log_softmax.shape[-2], 1)
        return action_log_softmax.gather(-1, place).squeeze(-1)


MENDED: dict[type[LossModule], type[Acting]] = {
    DiscreteCQLLoss: ConservativeTarget,
    DiscreteIQLLoss: RecordedEntropy,
    DiscreteSACLoss: EntropyOfMask,
    DistributionalDQNLoss: AtomShapes,
}


@functools.cache
def _derived(kind: Any) -> Any:
    """A class like ``kind`` that acts and prepares, with what is put right of TorchRL's class."""
    more = next((MENDED[each] for each in kind.__mro__ if each in MENDED), Acting)
    return type(kind.__name__, (more, kind), {"__doc__": kind.__doc__})


def _finished(loss: Any, actor: TensorDictModuleBase, gamma: float, stop_at: str) -> Any:
    loss.set_keys(done=stop_at, terminated=stop_at)
    loss.make_value_estimator(gamma=gamma)
    loss.act_by(actor)
    return loss


def _several(network: NetworkFactory, sizes: Sizes, number: int, key: str) -> list[TensorDictModule]:
    """Q-networks that write ``key``, float32 [..., A], each with parameters and buffers of its own."""
    made = (copy.deepcopy(network(sizes)) for _ in range(number))
    return [TensorDictModule(each, in_keys=list(each.in_keys), out_keys=[key]) for each in made]


class ExpectedValue(nn.Module):
    """Expected values of all actions [..., A] from a network's log-odds of atoms [..., A, atoms]."""

    def __init__(self, network: QNetwork, support: Tensor) -> None:
        super().__init__()
        self.network = network
        self.support: Tensor
        self.register_buffer("support", support, persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """See the class."""
        return self.network(*inputs).softmax(-1) @ self.support


class AtomsModule(TensorDictModuleBase):
    """What ``DistributionalDQNLoss`` wants of an actor; TorchRL's own masks distributions, not the choice.

    Writes ``action_value`` float32 [batch, atoms, A], log-probabilities of the atoms of every action, and ``action``
    int64 [batch], the valid action of the highest expected value.
    """

    action_space = "categorical"

    def __init__(self, network: QNetwork, support: Tensor) -> None:
        super().__init__()
        self.network = network
        self.network_keys = list(network.in_keys)
        self.in_keys = [*dict.fromkeys((*self.network_keys, "action_mask"))]
        self.out_keys = ["action_value", "action"]
        self.register_buffer("support", support)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See the class."""
        odds = self.network(*(tensordict.get(key) for key in self.network_keys)).log_softmax(-1)
        best = masked_argmax(odds.exp() @ self.support, tensordict.get("action_mask")).squeeze(-1)
        tensordict.set("action_value", odds.transpose(-1, -2))
        return tensordict.set("action", best)
