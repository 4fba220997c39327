"""Checks of loaded state dicts: a checkpoint may come from anyone, and nothing that it says can be trusted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.scenario.quoting import one_line

_REMEDY = "use a checkpoint that this run wrote"
ARRAY_DTYPES = (torch.bool, torch.uint8, torch.int32, torch.int64, torch.float32, torch.float64)


def refuse(name: str, what: str) -> NoReturn:
    """Raise the ``CheckpointError`` for the part ``name`` of a checkpoint."""
    raise CheckpointError(f"checkpoint: {name} {what}; {_REMEDY}")


def check_keys(name: str, state: Any, keys: Iterable[str]) -> None:
    """Refuse unless ``state`` is a mapping of exactly these ``keys``."""
    if not isinstance(state, Mapping):
        refuse(name, f"is a {type(state).__name__}, not a mapping")
    for key in (keys := [*keys]):
        if key not in state:
            refuse(f"{name}.{key}", "is missing")
    for key in state:
        if key not in keys:
            refuse(f"{name}.{one_line(str(key))}", "is not known")


def check_whole(name: str, value: Any, low: int, high: int) -> int:
    """``value`` if it is an integer from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, int):
        refuse(name, f"is a {type(value).__name__}, not an integer")
    if not low <= value <= high:
        refuse(name, f"is {value}, outside {low} .. {high}")
    return value


def check_real(name: str, value: Any, *, finite: bool = True) -> float:
    """``value`` if it is a number; only ``finite`` ones, unless told otherwise."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        refuse(name, f"is a {type(value).__name__}, not a number")
    if finite and not math.isfinite(value):
        refuse(name, f"is {value}, not a finite number")
    return value


def check_list(name: str, value: Any, length: int) -> list[Any]:
    """``value`` if it is a list of ``length`` items."""
    if not isinstance(value, list | tuple) or len(value) != length:
        refuse(name, f"is not a list of {length}")
    return [*value]


def check_tensor(
    name: str, value: Any, dtype: torch.dtype, shape: tuple[int, ...], low: float = -math.inf, high: float = math.inf
) -> Tensor:
    """``value`` if it is a tensor of this dtype and shape, in memory of its own size, from ``low`` to ``high``.

    Numbers that are not finite are refused.
    """
    if not isinstance(value, Tensor):
        refuse(name, f"is a {type(value).__name__}, not a tensor")
    if value.dtype != dtype:
        refuse(name, f"has dtype {value.dtype}, not {dtype}")
    if value.shape != torch.Size(shape):
        refuse(name, f"has shape {list(value.shape)}, not {list(shape)}")
    if value.layout != torch.strided or (value.numel() > 1 and 0 in value.stride()):
        refuse(name, "is not a plain tensor")
    if value.is_floating_point() and not torch.isfinite(value).all():
        refuse(name, "holds numbers that are not finite")
    if value.numel() and not (low <= value.min() and value.max() <= high):
        refuse(name, f"is outside {low} .. {high}")
    return value.detach()


def check_array(name: str, value: Any, like: np.ndarray, low: int, high: int) -> np.ndarray:
    """A copy of the tensor ``value`` as an array; of dtype and shape of ``like``, all in ``low`` .. ``high``."""
    dtype = torch.from_numpy(like).dtype
    return check_tensor(name, value, dtype, like.shape, low, high).numpy().copy()


def check_arrays(name: str, state: Any) -> dict[str, np.ndarray]:
    """The tensors of a mapping as arrays that share their memory; what is in them is for the caller to check."""
    if not isinstance(state, Mapping):
        refuse(name, f"is a {type(state).__name__}, not a mapping")
    for key, value in state.items():
        plain = isinstance(value, Tensor) and value.layout == torch.strided and value.is_contiguous()
        if not plain or value.dtype not in ARRAY_DTYPES or value.device.type != "cpu":
            refuse(f"{name}.{key}", "is not a plain tensor of numbers")
    return {key: value.detach().numpy() for key, value in state.items()}
