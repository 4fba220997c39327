"""What the last step brought, by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from nfv_torchrl.simulator import REASON_NAMES, Simulator
from nfv_torchrl.simulator.compiled import kernel
from nfv_torchrl.simulator.reasons import NO_REASON
from nfv_torchrl.simulator.state import OUTCOME

OF_THEIR_OWN = ("request_done", "done")
"""Keys beside ``outcome``: the ends of requests and of horizons."""
FLAGS = ("passed", "accepted", *OF_THEIR_OWN)
INTEGERS = ("reason", "service")
NUMBERS = tuple(name for name in OUTCOME._fields if name not in (*FLAGS, *INTEGERS))

_FLAGS, _INTEGERS, _NUMBERS = (tuple(map(OUTCOME._fields.index, names)) for names in (FLAGS, INTEGERS, NUMBERS))


def outcome_spec(simulator: Simulator) -> Composite:
    """Specs of the key ``outcome`` of ``read_outcome``, [B, 1] each."""
    shape = (simulator.batch_size, 1)
    spec: dict = {name: Binary(1, shape=shape, dtype=torch.bool) for name in FLAGS if name not in OF_THEIR_OWN}
    spec["reason"] = Bounded(NO_REASON, len(REASON_NAMES) - 1, shape, dtype=torch.int64)
    spec["service"] = Bounded(0, simulator.tables.services - 1, shape, dtype=torch.int64)
    spec |= {name: Unbounded(shape, dtype=torch.float32) for name in NUMBERS}
    return Composite(spec, shape=shape[:1])


@kernel
def _split(outcome, flags, integers, numbers):
    """``outcome`` float64 [B, columns] by kinds: bool, int64 and float32, [columns of the kind, B, 1] each."""
    for b in range(outcome.shape[0]):
        for k in range(len(_FLAGS)):
            flags[k, b, 0] = outcome[b, _FLAGS[k]] > 0.0
        for k in range(len(_INTEGERS)):
            integers[k, b, 0] = np.int64(outcome[b, _INTEGERS[k]])
        for k in range(len(_NUMBERS)):
            numbers[k, b, 0] = np.float32(outcome[b, _NUMBERS[k]])


def read_outcome(outcome: np.ndarray) -> dict[str, Any]:
    """The columns of ``World.outcome``, float64 [B, columns], as tensors [B, 1] that later steps do not write into.

    Returns:
        ``request_done`` and ``done`` bool, and ``outcome``, the others by name: ``passed`` and ``accepted`` bool,
        ``reason`` and ``service`` int64, the rest float32. Those of one kind are rows of one tensor.
    """
    batch = len(outcome)
    flags = torch.empty(len(FLAGS), batch, 1, dtype=torch.bool)
    integers = torch.empty(len(INTEGERS), batch, 1, dtype=torch.int64)
    numbers = torch.empty(len(NUMBERS), batch, 1)
    _split(outcome, flags.numpy(), integers.numpy(), numbers.numpy())
    values = dict(zip(NUMBERS, numbers.unbind(), strict=True))
    values |= zip(FLAGS, flags.unbind(), strict=True)
    values |= zip(INTEGERS, integers.unbind(), strict=True)
    ends = {name: values.pop(name) for name in OF_THEIR_OWN}
    return {**ends, "outcome": values}
