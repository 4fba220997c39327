"""Arrays in few bytes, exactly: what a replay memory holds is mostly zeros, ones and multiples of 1/1000.

Flags become bits, integers take the smallest type that holds them, columns of multiples of 1/1000 become integers, and
all of it is deflated. What does not come back to the bit stays as it is.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfv_torchrl.simulator.view import SHARE_LEVELS
from nfv_torchrl.state_checks import check_keys, refuse

LEVEL = 1
"""Of zlib: the higher ones take several times as long for a few per cent."""

RATIO = 256
"""A packed array never grows to more than so many times its own size, so that a small file cannot fill the memory."""

_INTEGERS = tuple(np.dtype(name) for name in ("uint8", "int8", "uint16", "int16", "int32", "int64"))
_SHARES = (np.arange(2**16) / SHARE_LEVELS).astype(np.float32)


def pack(array: np.ndarray) -> dict[str, Tensor]:
    """``array`` [n, ...] as a few tensors uint8 []."""
    rows = flat_rows(array)
    if array.dtype == np.bool_:
        return {"bits": _deflate(np.packbits(rows))}
    if array.dtype.kind == "i" and array.size:
        low, high = int(array.min()), int(array.max())
        smallest = next(kind for kind in _INTEGERS if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max)
        return {smallest.name: _deflate(rows.astype(smallest))}
    if array.dtype == np.float32:
        return _pack_shares(rows)
    return {"raw": _deflate(rows)}


def unpack(name: str, packed: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """The array of ``dtype`` and ``shape`` that ``pack`` was given; ``name`` is for the message.

    Raises:
        CheckpointError: it was not of that dtype and shape, or what is there is damaged.
    """
    if not isinstance(packed, Mapping) or not packed:
        refuse(name, "is no packed array")
    form = next(iter(packed))
    if form == "columns":
        return _unpack_shares(name, packed, shape)
    check_keys(name, packed, (form,))
    count = int(np.prod(shape))
    if form == "bits" and dtype == np.bool_:
        bits = _inflate(name, packed[form], -(-count // 8))
        return np.unpackbits(np.frombuffer(bits, np.uint8), count=count).astype(np.bool_).reshape(shape)
    integers = {kind.name: kind for kind in _INTEGERS} if dtype.kind == "i" else {}
    stored = dtype if form == "raw" and dtype != np.bool_ else integers.get(form)
    if stored is None:
        refuse(name, f"is packed as {form}, which {dtype} is not")
    return np.frombuffer(_inflate(name, packed[form], count * stored.itemsize), stored).astype(dtype).reshape(shape)


def flat_rows(array: np.ndarray) -> np.ndarray:
    """``array`` [n, ...] as [n, numbers of a row]."""
    return np.ascontiguousarray(array).reshape(len(array), int(np.prod(array.shape[1:])))


def _pack_shares(rows: np.ndarray) -> dict[str, Tensor]:
    """Columns that are multiples of 1/1000 throughout as integers, the others as they are."""
    with np.errstate(invalid="ignore", over="ignore"):
        codes = np.rint(rows * np.float32(SHARE_LEVELS)).astype(np.uint16)
    # By their bits: -0.0 and NaN have to come back, too.
    exact = (_SHARES[codes].view(np.uint32) == rows.view(np.uint32)).all(0)
    return {
        "columns": torch.from_numpy(exact.copy()),
        "shares": _deflate(codes[:, exact]),
        "raw": _deflate(rows[:, ~exact]),
    }


def _unpack_shares(name: str, packed: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    check_keys(name, packed, ("columns", "shares", "raw"))
    columns = packed["columns"]
    width = int(np.prod(shape[1:]))
    if not isinstance(columns, Tensor) or columns.dtype != torch.bool or columns.shape != (width,):
        refuse(f"{name}.columns", "is not one flag for each column")
    exact = columns.numpy()
    whole = int(exact.sum())
    codes = np.frombuffer(_inflate(name, packed["shares"], 2 * shape[0] * whole), np.uint16)
    raw = np.frombuffer(_inflate(name, packed["raw"], 4 * shape[0] * (width - whole)), np.float32)
    rows = np.empty((shape[0], width), np.float32)
    rows[:, exact] = _SHARES[codes].reshape(shape[0], whole)
    rows[:, ~exact] = raw.reshape(shape[0], width - whole)
    return rows.reshape(shape)


def _deflate(array: np.ndarray) -> Tensor:
    content = np.ascontiguousarray(array)
    data = zlib.compress(content.tobytes(), LEVEL)
    # Bytes after the end of the stream are not read; they keep the ratio.
    data = data.ljust(-(-content.nbytes // RATIO), b"\0")
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _inflate(name: str, data: Any, size: int) -> bytes:
    """The ``size`` bytes in ``data``: no more are made, whatever it says."""
    if not isinstance(data, Tensor) or data.dtype != torch.uint8 or data.ndim != 1 or not data.is_contiguous():
        refuse(name, "is not packed in bytes")
    if size > RATIO * len(data):
        refuse(name, f"is said to hold {size} bytes, too many for the {len(data)} that are there")
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data.numpy().tobytes(), size + 1)
    except zlib.error as error:
        refuse(name, f"is damaged ({error})")
    if len(content) != size:
        refuse(name, f"does not hold the {size} bytes that it should")
    return content
