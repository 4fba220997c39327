"""Saving and loading environments: their pools of running requests are mostly empty, and take little room packed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.state_checks import ARRAY_DTYPES, check_keys, check_list, check_whole, refuse
from nfv_torchrl.training.compact import pack, unpack

LARGE = 1 << 20
"""Bytes of an array from which on it is packed."""
_DTYPES = {str(dtype): dtype for dtype in ARRAY_DTYPES}


class EnvState:
    """The state of ``env``, its large arrays packed exactly (see ``compact``)."""

    def __init__(self, env: NFVEnv) -> None:
        self.env = env

    def state_dict(self) -> dict[str, Any]:
        """As the environment's; of a large array its dtype, its shape and what it is packed to."""
        state = self.env.state_dict()
        return state | {"world": {name: _packed(name, array) for name, array in state["world"].items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state``.

        Raises:
            CheckpointError: it belongs to another batch size, scenario or version, or is damaged.
        """
        world = state.get("world")
        if not isinstance(world, Mapping):
            refuse("env.world", "is no mapping by name")
        self.env.load_state_dict({**state, "world": {name: _whole(str(name), array) for name, array in world.items()}})


def _packed(name: str, tensor: Tensor) -> Tensor | dict[str, Any]:
    if tensor.numel() * tensor.element_size() < LARGE:
        return tensor
    array = tensor.numpy()
    if _is_list(name, array):
        array = array - _free(array)
    return {"dtype": str(tensor.dtype), "shape": list(tensor.shape), "packed": pack(array)}


def _whole(name: str, value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    where = f"env.world.{name}"
    check_keys(where, value, ("dtype", "shape", "packed"))
    dtype = _DTYPES.get(value["dtype"]) if isinstance(value["dtype"], str) else None
    if dtype is None:
        refuse(f"{where}.dtype", "is none of an array")
    given = value["shape"]
    sizes = check_list(f"{where}.shape", given, len(given) if isinstance(given, list) else 0)
    shape = tuple(check_whole(f"{where}.shape", size, 0, 2**31) for size in sizes)
    array = unpack(where, value["packed"], torch.zeros((), dtype=dtype).numpy().dtype, shape)
    return torch.from_numpy(array + _free(array) if _is_list(name, array) else array)


def _is_list(name: str, array: np.ndarray) -> bool:
    return name.endswith("_next") and array.ndim == 2


def _free(array: np.ndarray) -> np.ndarray:
    """What the list of free places holds while nobody has taken from it: each the number of the next."""
    return np.arange(array.shape[1], dtype=array.dtype)
