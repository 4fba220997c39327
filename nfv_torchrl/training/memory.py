"""Saving and loading a replay buffer, in a small fraction of the room that it takes in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import RoundRobinWriter, TensorDictReplayBuffer

from nfv_torchrl.state_checks import ARRAY_DTYPES, check_keys, check_list, check_whole, refuse
from nfv_torchrl.training.compact import flat_rows, pack, unpack
from nfv_torchrl.training.sampler_state import SamplerState, load_plain, plain_state

_OWN_KEY = "index"
"""Key that ``TensorDictReplayBuffer`` writes itself."""

_BLOCK = 2**14
"""Rows packed at a time: little enough that packing takes no memory to speak of."""

_DTYPES = {str(dtype): dtype for dtype in ARRAY_DTYPES}


class MemoryState:
    """The state of a replay buffer: the items it holds, where the next one goes, and what its sampler knows.

    The buffer's own ``state_dict`` holds its whole storage, uninitialised memory included. Here items are packed (see
    ``compact``), and what is seen after a step is left out where the next row says the same.

    Args:
        buffer: the memory.
        rows: some of what the loss keeps, [R]; items that are loaded have to be of that kind. None: of any.
    """

    def __init__(self, buffer: TensorDictReplayBuffer, rows: TensorDictBase | None = None) -> None:
        self.buffer, self._rows = buffer, rows
        self._sampler = SamplerState(buffer)

    def state_dict(self) -> dict[str, Any]:
        """Items by their keys, joined by dots, in storage order; the states of writer and sampler."""
        size = len(self.buffer)
        arrays: dict[str, np.ndarray] = {}
        if size:
            items = self.buffer[:].exclude(_OWN_KEY).to("cpu").flatten_keys(".")
            arrays = {key: value.numpy() for key, value in items.items()}
        return {
            "size": size,
            "items": {key: _pack_item(value, arrays.get(_before(key) or "")) for key, value in arrays.items()},
            "writer": plain_state("buffer.writer", self.buffer.writer),
            "sampler": self._sampler.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Fill an empty buffer.

        Raises:
            CheckpointError: the state is of a larger buffer, of other parts, or damaged.
        """
        check_keys("buffer", state, ("size", "items", "writer", "sampler"))
        size = check_whole("buffer.size", state["size"], 0, self.buffer.storage.max_size)
        self._check_writer(state["writer"], size)
        if not isinstance(state["items"], dict) or not all(isinstance(key, str) for key in state["items"]):
            refuse("buffer.items", "is no mapping by key")
        if size:
            self._check_kind(state["items"])
            self._fill(state["items"], size)
        load_plain("buffer.writer", self.buffer.writer, state["writer"])
        self._sampler.load_state_dict(state["sampler"])

    def _check_writer(self, state: Any, size: int) -> None:
        """A writer that goes round says where it is, and how many items it has written."""
        if not isinstance(self.buffer.writer, RoundRobinWriter):
            return
        check_keys("buffer.writer", state, self.buffer.writer.state_dict())
        room = self.buffer.storage.max_size
        cursor = check_whole("buffer.writer._cursor", state["_cursor"], 0, room - 1)
        check_whole("buffer.writer._write_count", state["_write_count"], size, 2**63 - 1)
        if size < room and cursor != size:
            refuse("buffer.writer._cursor", f"is {cursor}, but the {size} rows there end at {size}")

    def _check_kind(self, packed: dict[str, Any]) -> None:
        """The items are such as the loss keeps: same keys and dtypes. Sizes may be those of a larger network."""
        if self._rows is None:
            return
        kept = {key: str(value.dtype) for key, value in self._rows.flatten_keys(".").items()}
        found = {key: content.get("dtype") if isinstance(content, dict) else None for key, content in packed.items()}
        differ = sorted(key for key in {*kept, *found} if kept.get(key) != found.get(key))
        if differ:
            refuse(
                "buffer.items",
                f"are not what the loss keeps: {', '.join(differ)} differ. The loss or its network has changed since",
            )

    def _fill(self, packed: dict[str, Any], size: int) -> None:
        arrays: dict[str, np.ndarray] = {}
        for key in sorted(packed, key=lambda key: _before(key) is not None):  # those left out of come first
            before = arrays.get(_before(key) or "")
            arrays[key] = _unpack_item(f"buffer.items.{key}", packed[key], size, before)
        items = TensorDict(batch_size=[size])
        for key in packed:
            items.set(tuple(key.split(".")), torch.from_numpy(arrays[key]))
        # Through the storage: a writer may not want all of them, and a sampler makes priorities of what is written.
        places = torch.arange(size)
        self.buffer.storage.set(places, items.set(_OWN_KEY, places))


def _before(key: str) -> str | None:
    """The key whose next row may say what ``key`` says."""
    return key.removeprefix("next.") if key.startswith("next.") else None


def _blocks(size: int) -> list[slice]:
    return [slice(first, min(first + _BLOCK, size)) for first in range(0, size, _BLOCK)]


def _pack_item(array: np.ndarray, before: np.ndarray | None) -> dict[str, Any]:
    """``array`` [size, ...]; of rows that equal the following one of ``before`` nothing but that is kept."""
    content: dict[str, Any] = {
        "dtype": str(torch.from_numpy(array[:0]).dtype),
        "shape": list(array.shape[1:]),
        "blocks": [],
    }
    shared = None
    if before is not None and before.shape == array.shape and before.dtype == array.dtype:
        shared = _equal_rows(array, np.roll(before, -1, 0))
        content["shared"] = pack(shared)
    for block in _blocks(len(array)):
        rows = array[block] if shared is None else array[block][~shared[block]]
        content["blocks"].append(pack(rows))
    return content


def _equal_rows(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rows that are the same to the bit, bool [n]."""
    return (flat_rows(one).view(np.uint8) == flat_rows(other).view(np.uint8)).all(1)


def _unpack_item(name: str, content: Any, size: int, before: np.ndarray | None) -> np.ndarray:
    check_keys(name, content, {"dtype", "shape", "blocks"} | ({"shared"} & set(content)))
    kind = _DTYPES.get(content["dtype"]) if isinstance(content["dtype"], str) else None
    if kind is None:
        refuse(f"{name}.dtype", f"is {content['dtype']!r}")
    dtype = torch.zeros((), dtype=kind).numpy().dtype
    width = check_list(f"{name}.shape", content["shape"], len(content["shape"]))
    shape = tuple(check_whole(f"{name}.shape", length, 0, 2**31) for length in width)
    shared = np.zeros(size, np.bool_)
    if "shared" in content:
        shared = unpack(f"{name}.shared", content["shared"], np.dtype(np.bool_), (size,))
        if before is None or before.shape != (size, *shape) or before.dtype != dtype:
            refuse(name, "leaves out rows that are nowhere else")
    blocks = _blocks(size)
    parts = [
        unpack(name, packed, dtype, (int((~shared[block]).sum()), *shape))
        for block, packed in zip(blocks, check_list(f"{name}.blocks", content["blocks"], len(blocks)), strict=True)
    ]
    rows = np.concatenate(parts)
    if before is None or "shared" not in content:
        return rows
    whole = np.roll(before, -1, 0)
    whole[~shared] = rows
    return whole
