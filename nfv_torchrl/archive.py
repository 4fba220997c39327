"""What a ``.pt`` file may be, checked before and after torch reads it: a stranger may have written it."""

from __future__ import annotations

import os
import pickletools
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.scenario.quoting import one_line as quoted

PLAIN = (type(None), bool, int, float, str, bytes)
"""Values that a file may hold beside tensors, lists, tuples and dicts."""

INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.uint16, torch.int32, torch.uint32, torch.int64, torch.uint64)
DTYPES = (torch.bool, *INTEGERS, torch.float16, torch.bfloat16, torch.float32, torch.float64)

DEEPEST = 32
"""Lists and dicts inside each other."""
LARGEST_PICKLE = 16 << 20
"""Bytes of the list of what a file holds, which is without the numbers of tensors."""
MOST_IN_TUPLES = 1_000_000
"""Values in a tuple, with those in the tuples that it holds."""


def machine_memory() -> int:
    """Bytes of memory that this machine has."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_archive(path: Path, largest: int) -> None:
    """Refuse a file that would take more memory than its own size, or is larger than ``largest`` bytes; read it once.

    Raises:
        CheckpointError: too large, compressed, with parts that overlap, or damaged.
    """
    size = path.stat().st_size
    if size > largest:
        raise CheckpointError(f"{path} is of {size / 1e9:.1f} GB; at most {largest / 1e9:.1f} GB are read here")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        # torch stores what it writes as it is: a compressed entry is a small file that fills the memory.
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise CheckpointError(f"{path} is compressed; torch.save does not compress, so it is no checkpoint")
        if sum(entry.file_size for entry in entries) > size:
            raise CheckpointError(f"{path} says that it holds more bytes than it has; it is no checkpoint")
        for entry in entries:
            if entry.filename.endswith("data.pkl"):
                _check_pickle(path, archive, entry)
        damaged = archive.testzip()
    if damaged is not None:
        raise CheckpointError(f"checkpoint {path} is damaged (at {quoted(damaged)}); use an older one")


def _check_pickle(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Refuse tuples that hold each other over and over: as keys they would be hashed for ever, before anything is seen.

    The stack of the pickle is followed with nothing on it but how many values each of its entries stands for.
    """
    if entry.file_size > LARGEST_PICKLE:
        raise CheckpointError(f"{path} lists more values than a checkpoint has; it is no checkpoint")
    stack: list[int | None] = []  # None: a mark
    memo: dict[Any, int] = {}
    for code, argument, _ in pickletools.genops(archive.read(entry)):
        if code.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1] or 1
        elif code.name == "MEMOIZE":
            memo[len(memo)] = stack[-1] or 1
        elif code.name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif code.name == "MARK":
            stack.append(None)
        else:
            inside = _popped(stack, code)
            values = 1 + sum(inside) if code.name.startswith("TUPLE") else 1
            if values > MOST_IN_TUPLES:
                raise CheckpointError(f"{path} holds tuples in tuples as no checkpoint does; it is none")
            stack += [values] * len(code.stack_after)


def _popped(stack: list[int | None], code: pickletools.OpcodeInfo) -> list[int]:
    """What the instruction takes from the stack, down to the last mark if it says so."""
    count = len(code.stack_before)
    if pickletools.markobject in code.stack_before:
        place = len(stack) - 1 - stack[::-1].index(None)
        count = len(stack) - place + code.stack_before.index(pickletools.markobject)
    taken, stack[len(stack) - count :] = stack[len(stack) - count :], []
    return [values for values in taken if values is not None]


def check_values(path: Path, content: Any) -> None:
    """Refuse anything but plain values, and tensors on the CPU that have the memory they claim.

    Raises:
        CheckpointError: names the place in the file.
    """
    waiting: list[tuple[str, int, Any]] = [("", 0, content)]
    seen: set[int] = set()  # a list may hold the same list many times: look at each once
    while waiting:
        where, depth, value = waiting.pop()
        if isinstance(value, Tensor):
            _check_tensor(path, where, value)
        elif isinstance(value, Mapping | list | tuple):
            if id(value) not in seen:
                seen.add(id(value))
                items = list(value.items() if isinstance(value, Mapping) else enumerate(value))
                if depth > DEEPEST or any(type(key) not in (str, int) for key, _ in items):
                    raise CheckpointError(f"{path}: {where:.60} is nested or named as in no checkpoint")
                waiting += [(f"{where}.{key}" if where else str(key), depth + 1, item) for key, item in items]
        elif type(value) not in PLAIN:
            raise CheckpointError(f"{path}: {where} is a {type(value).__name__}; a checkpoint holds no such thing")


def _check_tensor(path: Path, where: str, tensor: Tensor) -> None:
    if type(tensor) not in (Tensor, nn.Parameter) or tensor.layout != torch.strided or tensor.device.type != "cpu":
        raise CheckpointError(f"{path}: {where} is no ordinary tensor; a checkpoint holds only those")
    if tensor.dtype not in DTYPES:
        raise CheckpointError(f"{path}: {where} is of {tensor.dtype}, which no checkpoint holds")
    # Strides of zero make a tensor of any size from one number; whatever copies it would fill the memory.
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise CheckpointError(f"{path}: {where} claims the shape {list(tensor.shape)} but has not that many numbers")
    if tensor.dtype == torch.bool and tensor.numel() and int(tensor.view(torch.uint8).max()) > 1:
        raise CheckpointError(f"{path}: {where} holds bytes that are neither true nor false")
