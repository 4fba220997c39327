"""Actors: how a network's outputs become actions, and how to find what is inside an actor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.data import Categorical
from torchrl.modules import MaskedCategorical, ProbabilisticActor, QValueActor

from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.networks import QNetwork


def greedy_actor(network: nn.Module, actions: int, in_keys: Sequence[NestedKey] | None = None) -> QValueActor:
    """The greedy policy of a Q-network over the valid actions, ``actions`` with reject.

    The mask goes into the actor, hence also into the target's maximum; the action spec is categorical, because one-hot
    actions turn into NaN where nothing is valid and pick several where values tie. ``in_keys``: those of the network
    unless given.

    Raises:
        ScenarioError: the network has a memory, which single transitions cannot train.
    """
    if any(hasattr(module, "unroll") for module in network.modules()):
        raise ScenarioError("a network with memory learns from sequences: use loss=recurrent_dqn, or preset=recurrent")
    keys = list(network.in_keys if in_keys is None else in_keys)  # type: ignore[arg-type]
    module = TensorDictModule(network, in_keys=keys, out_keys=["action_value"])
    return QValueActor(module, spec=Categorical(actions), action_space="categorical", action_mask_key="action_mask")


def scorer(actor: TensorDictModuleBase) -> TensorDictModule | None:
    """The module of an actor whose scores decide: its greedy action is the valid one of the highest score.

    None for an actor of another kind, or with a memory.
    """
    scores = scores_first(actor)
    return scores if scores is not None and len(scores.out_keys) == 1 else None


def scores_first(actor: TensorDictModuleBase) -> TensorDictModule | None:
    """The same for an actor with a memory, too, whose module also gives the memory after the step."""
    stochastic = isinstance(actor, ProbabilisticActor) and actor[-1].distribution_class is MaskedCategorical
    if not (stochastic or isinstance(actor, QValueActor)):
        return None
    return actor[0] if type(actor[0]) is TensorDictModule else None


def q_network(loss: Any) -> QNetwork:
    """The Q-network inside a loss's actor.

    Raises:
        CheckpointError: there is none.
    """
    for module in loss.actor.modules():
        if isinstance(module, QNetwork):
            return module
    raise CheckpointError("the loss's actor holds no QNetwork; derive the network from nfv_torchrl.networks.QNetwork")
