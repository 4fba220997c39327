"""What is read from a file against what is to take it: keys, kinds, shapes and dtypes, before anything is loaded."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from nfv_torchrl.errors import CheckpointError

Place = str | os.PathLike[str]


def check_like(path: Place, key: str, found: Any, own: Any) -> None:
    """Refuse what differs from ``own`` in keys, kinds, shapes or dtypes, and tensors that are not finite.

    Args:
        path: the file, for messages.
        key: where in it ``found`` is.
        found: what the file holds.
        own: what it is to replace: tensors, numbers, strings, and mappings and sequences of them.

    Raises:
        CheckpointError: names file and key.
    """
    if isinstance(own, Tensor):
        check_tensor(path, key, found, own)
    elif isinstance(own, Mapping):
        check_mapping(path, key, found)
        check_keys(path, key, found, own)
        for name, value in own.items():
            check_like(path, f"{key}.{name}", found[name], value)
    elif type(found) is not type(own):
        raise CheckpointError(f"{path}: {key} is a {kind_of(found)} where this run has a {kind_of(own)}")
    elif isinstance(own, list | tuple):
        if len(found) != len(own):
            raise CheckpointError(f"{path}: {key} has {len(found)} entries where this run has {len(own)}")
        for place, value in enumerate(own):
            check_like(path, f"{key}.{place}", found[place], value)


def check_tensor(path: Place, key: str, found: Any, own: Tensor) -> None:
    """Refuse all but a finite tensor of the shape and dtype of ``own``: torch would broadcast or round some others."""
    if not isinstance(found, Tensor):
        raise CheckpointError(f"{path}: {key} is a {kind_of(found)}, not a tensor {list(own.shape)}")
    if found.shape != own.shape:
        raise CheckpointError(
            f"{path}: {key} has the shape {list(found.shape)}, here it is {list(own.shape)}; give the settings of "
            "network= and loss= that the file was trained with"
        )
    if found.dtype != own.dtype:
        raise CheckpointError(f"{path}: {key} is of {found.dtype}, here it is of {own.dtype}; use another file")
    if found.is_floating_point() and not bool(torch.isfinite(found).all()):
        raise CheckpointError(f"{path}: {key} holds numbers that are not finite; use an older checkpoint or policy")


def check_keys(path: Place, key: str, found: Mapping[str, Any], own: Iterable[str]) -> None:
    """Refuse a mapping that lacks a key of ``own``, or has another."""
    names = list(own)
    lacking = [name for name in names if name not in found]
    if lacking:
        raise CheckpointError(f"{path}: {key} lacks {lacking[0]!r}; it belongs to another network, loss or recipe")
    more = [name for name in found if name not in names]
    if more:
        raise CheckpointError(f"{path}: {key} has {more[0]!r}, which nothing here reads; it belongs to another network")


def check_mapping(path: Place, key: str, found: Any) -> None:
    """Refuse what is no mapping."""
    if not isinstance(found, Mapping):
        raise CheckpointError(f"{path}: {key} is a {kind_of(found)}, not a dict; use another file")


def kind_of(value: Any) -> str:
    """What messages call the type of ``value``."""
    return type(value).__name__
