"""Which network of an actor decides, and by which of its outputs."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase
from torch import nn

from nfv_torchrl.losses.actors import scores_first
from nfv_torchrl.losses.quantile import MeanValue
from nfv_torchrl.losses.sequences import FirstOutput
from nfv_torchrl.networks import QNetwork


def deciding_network(actor: TensorDictModuleBase) -> tuple[QNetwork, int | None] | None:
    """The network whose scores decide, and its output that is the score (None: the mean of all).

    The greedy action of such an actor is the valid one of the highest score. None for an actor of another kind, or one
    that gives the network other keys to read than its own.
    """
    scores = scores_first(actor)
    found = None if scores is None else _inside(scores.module)
    return found if found is not None and list(scores.in_keys) == list(found[0].in_keys) else None  # type: ignore[union-attr]


def _inside(module: nn.Module) -> tuple[QNetwork, int | None] | None:
    if isinstance(module, QNetwork) and getattr(module, "outputs", None) == 1:
        return module, None
    if type(module) is MeanValue:
        return module.network, None
    if type(module) is FirstOutput:
        return module.network, 0
    return None
