"""Recorded arrays, read without pickle and checked: whoever recorded them may be a stranger."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError, one_line

REMEDY = "record it again, in another folder"


class Form(NamedTuple):
    """What an array has to be."""

    dtype: np.dtype
    shape: tuple[int, ...]


def flat_keys(data: TensorDictBase) -> Iterator[tuple[str, Tensor]]:
    """Every tensor by the name of its file: the words of its key, with dots between them."""
    for key, value in data.items(include_nested=True, leaves_only=True):
        yield (key if isinstance(key, str) else ".".join(key)), value


def read_array(path: Path, form: Form) -> np.ndarray:
    """The array of an ``.npy`` file, mapped: nothing of it is in memory before its size is known to be right.

    Raises:
        ScenarioError: it is missing, damaged, of another form, or holds pickled objects.
    """
    if not path.is_file():
        raise ScenarioError(f"dataset: {path} is missing or no file; {REMEDY}")
    try:
        # Not np.load: that would open archives too. Copy on write, as torch wants arrays it may write to.
        array = np.lib.format.open_memmap(path, mode="c")
    except Exception as error:  # a damaged header can make the reader raise anything
        raise ScenarioError(f"dataset: {path} is no array of plain numbers ({one_line(error)}); {REMEDY}") from error
    if array.dtype != form.dtype or array.shape != form.shape:
        raise ScenarioError(
            f"dataset: {path} is {array.dtype} {list(array.shape)}, not {form.dtype} {list(form.shape)}; {REMEDY}"
        )
    return array


def check_part(folder: Path, part: TensorDictBase, env: NFVEnv) -> None:
    """Refuse what cannot have been recorded in ``env``, so that neither learning nor compiled code meets it.

    Args:
        folder: where it is, for messages.
        part: all keys of ``env``, [B, T].
        env: its specs say which whole numbers there may be.

    Raises:
        ScenarioError: a number that is not finite or outside its range, or an action that the mask forbids.
    """
    ranges = _ranges(env)
    for name, value in flat_keys(part):
        _check_values(f"dataset: {folder / name}.npy", value, ranges.get(name.removeprefix("next.")))
    for mask in (part["action_mask"], part["next", "action_mask"]):
        if not mask.any(-1).all():
            raise ScenarioError(f"dataset: {folder} has a state without any valid action; {REMEDY}")
    if not part["action_mask"].gather(-1, part["action"].unsqueeze(-1)).all():
        raise ScenarioError(f"dataset: {folder} has actions that its own mask forbids; {REMEDY}")
    _check_reasons(folder, part["next"])


def _ranges(env: NFVEnv) -> dict[str, tuple[int, int]]:
    """Smallest and largest of the whole numbers that a key may hold, for keys whose spec says so."""
    specs = {"action": env.action_spec}
    for key, spec in env.observation_spec.items(include_nested=True, leaves_only=True):
        specs[key if isinstance(key, str) else ".".join(key)] = spec
    ranges = {}
    for name, spec in specs.items():
        if isinstance(spec, Categorical):
            ranges[name] = (0, spec.n - 1)
        elif isinstance(spec, Bounded):
            ranges[name] = (int(spec.space.low.min()), int(spec.space.high.max()))
    return ranges


def _check_values(what: str, value: Tensor, limits: tuple[int, int] | None) -> None:
    if value.dtype == torch.bool:
        if int(value.view(torch.uint8).max()) > 1:
            raise ScenarioError(f"{what} holds bytes that are neither true nor false; {REMEDY}")
    elif value.is_floating_point():
        if not torch.isfinite(value).all():
            raise ScenarioError(f"{what} holds numbers that are not finite; {REMEDY}")
    elif limits is not None and (int(value.min()) < limits[0] or int(value.max()) > limits[1]):
        raise ScenarioError(f"{what} holds numbers outside {limits[0]} .. {limits[1]}; {REMEDY}")


def _check_reasons(folder: Path, after: TensorDictBase) -> None:
    """What is rejected has a reason; sums are grouped by it."""
    rejected = after["request_done"] & ~after["outcome", "accepted"]
    if (after["outcome", "reason"][rejected] < 0).any():
        raise ScenarioError(f"dataset: {folder / 'next.outcome.reason'}.npy names no reason; {REMEDY}")
