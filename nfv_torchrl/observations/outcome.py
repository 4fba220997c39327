"""What the last step brought, by name."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from nfv_torchrl.simulator import REASON_NAMES, Simulator
from nfv_torchrl.simulator.reasons import NO_REASON
from nfv_torchrl.simulator.state import OUTCOME

FLAGS = ("passed", "accepted")
INTEGERS = ("reason", "service")
OF_THEIR_OWN = ("request_done", "done")
"""Keys beside ``outcome``: the ends of requests and of horizons."""
NUMBERS = tuple(name for name in OUTCOME._fields if name not in (*FLAGS, *INTEGERS, *OF_THEIR_OWN))


def outcome_spec(simulator: Simulator) -> Composite:
    """Specs of ``read_outcome``, [B, 1] each."""
    shape = (simulator.batch_size, 1)
    spec: dict = {name: Binary(1, shape=shape, dtype=torch.bool) for name in FLAGS}
    spec["reason"] = Bounded(NO_REASON, len(REASON_NAMES) - 1, shape, dtype=torch.int64)
    spec["service"] = Bounded(0, len(simulator.tables.chain_length) - 1, shape, dtype=torch.int64)
    spec |= {name: Unbounded(shape, dtype=torch.float32) for name in NUMBERS}
    return Composite(spec, shape=shape[:1])


def read_outcome(outcome: Tensor) -> TensorDict:
    """The columns of ``World.outcome``, float64 [B, columns], as tensors [B, 1] that later steps do not write into.

    The numbers share one float32 tensor.
    """
    columns = dict(zip(OUTCOME._fields, outcome.to(torch.float32).split(1, -1), strict=True))
    values = {name: columns[name] for name in NUMBERS}
    values |= {name: columns[name] > 0 for name in FLAGS}
    values |= {name: columns[name].to(torch.int64) for name in INTEGERS}
    return TensorDict(values, batch_size=[len(outcome)])
