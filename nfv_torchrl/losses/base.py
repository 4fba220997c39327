"""What a recipe expects of a loss."""

from __future__ import annotations

from typing import Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical
from torchrl.modules import QValueActor

from nfv_torchrl.networks import QNetwork


class RequestLoss(Protocol):
    """A ``torchrl.objectives.LossModule`` made as ``MyLoss(network, sizes, **hyperparameters)``.

    ``network`` is a ``NetworkFactory``, so that a loss may ask for several outputs per action.
    """

    actor: TensorDictModule
    """The greedy policy being learned: reads the network's keys and ``action_mask``, writes ``action``."""

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Turn a collected batch [B, T] into what the replay buffer stores, one row an item."""
        ...

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Entries that start with ``loss`` are summed and minimised, the others are logged."""
        ...


def greedy_actor(network: QNetwork, actions: int) -> QValueActor:
    """The greedy policy of a Q-network over the valid actions, ``actions`` with reject.

    The mask goes into the actor, hence also into the target's maximum; the action spec is categorical, because one-hot
    actions turn into NaN where nothing is valid and pick several where values tie.
    """
    module = TensorDictModule(network, in_keys=list(network.in_keys), out_keys=["action_value"])
    return QValueActor(
        module, spec=Categorical(actions), action_space="categorical", action_mask_key="action_mask"
    )
