"""Which network of an actor decides, and by which of its outputs."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase

from nfv_torchrl.losses.actors import scores_first
from nfv_torchrl.losses.quantile import MeanValue
from nfv_torchrl.losses.sequences import FirstOutput
from nfv_torchrl.networks import QNetwork


def deciding_network(actor: TensorDictModuleBase) -> tuple[QNetwork, int | None] | None:
    """The network whose scores decide, and its output that is the score (None: the mean of all).

    The greedy action of such an actor is the valid one of the highest score. None for an actor of another kind.
    """
    scores = scores_first(actor)
    module = None if scores is None else scores.module
    if isinstance(module, QNetwork) and getattr(module, "outputs", None) == 1:
        return module, None
    if isinstance(module, MeanValue):
        return module.network, None
    if isinstance(module, FirstOutput):
        return module.network, 0
    return None
