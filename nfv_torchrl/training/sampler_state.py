"""Saving and loading what a replay memory's sampler and writer know: priorities, ages, where the next item goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data import PrioritizedSampler, TensorDictReplayBuffer

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.state_checks import check_keys, check_list, check_tensor, check_whole, refuse
from nfv_torchrl.training.compact import pack, unpack
from nfv_torchrl.training.recent import RecentSampler

_LARGEST = float(torch.finfo(torch.float32).max)


class SamplerState:
    """The state of the sampler of ``buffer``, as tensors and numbers.

    Of a ``PrioritizedSampler`` the priorities, to its exponent as its trees hold them, and the largest so far: the
    trees, which are objects of C++, are built anew from them, to the bit. Any other sampler says itself what it knows
    (``state_dict``).

    A state can be loaded before the memory holds its items; ``restore`` then brings it back after they were written,
    because writing makes priorities of its own.
    """

    def __init__(self, buffer: TensorDictReplayBuffer) -> None:
        self.buffer = buffer
        self._loaded: Mapping[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """See the class."""
        sampler = self.buffer.sampler
        if isinstance(sampler, PrioritizedSampler):
            return _priorities(sampler, len(self.buffer))
        return plain_state("buffer.sampler", sampler)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()`` of a memory with as many items.

        Raises:
            CheckpointError: it belongs to another sampler, or is damaged.
        """
        self._loaded = state
        if len(self.buffer):
            self.restore()

    def restore(self) -> None:
        """Bring back what was loaded, if anything was."""
        if self._loaded is None:
            return
        state, self._loaded = self._loaded, None
        size, sampler = len(self.buffer), self.buffer.sampler
        if isinstance(sampler, PrioritizedSampler):
            _load_priorities(sampler, state, size)
            return
        if isinstance(sampler, RecentSampler):
            check_keys("buffer.sampler", state, ("newest",))
            check_whole("buffer.sampler.newest", state["newest"], -1 if size == 0 else 0, max(size - 1, 0))
        load_plain("buffer.sampler", sampler, state)


def plain_state(name: str, part: Any) -> dict[str, Any]:
    """``part.state_dict()``, of which a checkpoint can hold everything.

    Raises:
        ScenarioError: it holds objects, or the part has no state to give.
    """
    try:
        state = dict(part.state_dict())
    except NotImplementedError as error:
        raise ScenarioError(_unsaved(name, part)) from error
    if not _is_plain(state):
        raise ScenarioError(_unsaved(name, part))
    return state


def load_plain(name: str, part: Any, state: Any) -> None:
    """``part.load_state_dict(state)``, with the keys that the part has.

    Raises:
        CheckpointError: it has others.
    """
    check_keys(name, state, part.state_dict())
    part.load_state_dict(state)


def _unsaved(name: str, part: Any) -> str:
    return (
        f"{name}: {type(part).__name__} cannot be saved, so that a run could not be resumed; use a class whose "
        "state_dict holds tensors and numbers alone"
    )


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(_is_plain(item) for item in value)
    return value is None or isinstance(value, bool | int | float | str | Tensor)


def _priorities(sampler: PrioritizedSampler, size: int) -> dict[str, Any]:
    value, place = sampler._max_priority
    tree = torch.as_tensor(sampler._sum_tree[torch.arange(size)]) if size else torch.zeros(0)
    return {
        "priorities": pack(tree.to("cpu", torch.float32).numpy()),
        "largest": [] if value is None else [torch.as_tensor(value).cpu(), torch.as_tensor(place).cpu()],
    }


def _load_priorities(sampler: PrioritizedSampler, state: Any, size: int) -> None:
    name = "buffer.sampler"
    check_keys(name, state, ("priorities", "largest"))
    priorities = torch.from_numpy(unpack(f"{name}.priorities", state["priorities"], np.dtype(np.float32), (size,)))
    check_tensor(f"{name}.priorities", priorities, torch.float32, (size,), 0.0, _LARGEST)
    if not (priorities > 0).all():
        refuse(f"{name}.priorities", "hold a 0, and no item would ever be drawn")
    largest = check_list(f"{name}.largest", state["largest"], 2 if state["largest"] else 0)
    sampler._empty()
    if size:
        places = torch.arange(size)
        sampler._sum_tree[places] = priorities
        sampler._min_tree[places] = priorities
    if largest:
        value = check_tensor(f"{name}.largest", largest[0], torch.float32, (), 0.0, _LARGEST)
        place = check_tensor(f"{name}.largest", largest[1], torch.int64, (), 0, sampler.max_size - 1)
        sampler._max_priority = (value.to(sampler.device), place.to(sampler.device))
