"""What is read from a file against what the run has: compared before anything is loaded."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.checkpoint import GlobalRNGState

from nfv_torchrl.errors import CheckpointError, one_line

Place = str | os.PathLike[str]

FIXED = ("loss", "updater", "window", "progress")
"""Parts of a run whose state has the same keys, shapes and dtypes at any time."""


def check_parts(path: Place, content: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Compare a checkpoint with the parts of the run that is to go on from it.

    Environment, replay memory and search check themselves when they are loaded.

    Args:
        path: the file, for messages.
        content: what it holds.
        state: the parts by name, each with ``state_dict``.

    Raises:
        CheckpointError: a part is missing or is not one of this run; names file and key.
    """
    for name, part in state.items():
        if name not in content:
            raise CheckpointError(f"{path} lacks {name!r}; it is no checkpoint of this recipe, use another one")
        if name in FIXED:
            check_like(path, name, content[name], part.state_dict())
        elif isinstance(part, torch.optim.Optimizer):
            _check_optimizer(path, name, content[name], part)
        elif isinstance(part, GlobalRNGState):
            _check_random_numbers(path, name, content[name])
        elif not isinstance(content[name], Mapping):
            raise CheckpointError(f"{path}: {name} is a {_kind(content[name])}, not the state of that part")


def load_part(path: Place, name: str, part: Any, state: Any) -> None:
    """``part.load_state_dict(state)``.

    Raises:
        CheckpointError: whatever went wrong, with file and part.
    """
    try:
        part.load_state_dict(state)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {name}: {error}") from error
    except Exception as error:  # a stranger's values can make any reader raise anything
        raise CheckpointError(
            f"{path}: {name} cannot be loaded ({type(error).__name__}: {one_line(error)}); use another checkpoint"
        ) from error


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
        _check_mapping(path, key, found)
        check_keys(path, key, found, own)
        for name, value in own.items():
            check_like(path, f"{key}.{name}", found[name], value)
    elif type(found) is not type(own):
        raise CheckpointError(f"{path}: {key} is a {_kind(found)} where this run has a {_kind(own)}")
    elif isinstance(own, list | tuple):
        if len(found) != len(own):
            raise CheckpointError(f"{path}: {key} has {len(found)} entries where this run has {len(own)}")
        for place, value in enumerate(own):
            check_like(path, f"{key}.{place}", found[place], value)


def check_tensor(path: Place, key: str, found: Any, own: Tensor) -> None:
    """Refuse all but a finite tensor of the shape and dtype of ``own``: torch would broadcast or round some others."""
    if not isinstance(found, Tensor):
        raise CheckpointError(f"{path}: {key} is a {_kind(found)}, not a tensor {list(own.shape)}")
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


def _check_mapping(path: Place, key: str, found: Any) -> None:
    if not isinstance(found, Mapping):
        raise CheckpointError(f"{path}: {key} is a {_kind(found)}, not a dict; use another file")


def _check_optimizer(path: Place, key: str, found: Any, optimizer: torch.optim.Optimizer) -> None:
    """Settings as in this run, which come from its config; of each parameter what the optimizer keeps of it."""
    own = optimizer.state_dict()
    _check_mapping(path, key, found)
    check_keys(path, key, found, own)
    check_like(path, f"{key}.param_groups", found["param_groups"], own["param_groups"])
    if found["param_groups"] != own["param_groups"]:
        raise CheckpointError(f"{path}: {key}.param_groups are not the settings of this run's {_kind(optimizer)}")
    _check_mapping(path, f"{key}.state", found["state"])
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    one = _state_of_one_number(optimizer)
    for number, kept in found["state"].items():
        where = f"{key}.state.{number}"
        if type(number) is not int or not 0 <= number < len(parameters):
            raise CheckpointError(f"{path}: {where} belongs to no parameter; this run has {len(parameters)}")
        like = {name: value if value.dim() == 0 else parameters[number] for name, value in one.items()}
        check_like(path, where, kept, like)


def _state_of_one_number(optimizer: torch.optim.Optimizer) -> Mapping[str, Tensor]:
    """What an optimizer of this kind keeps of a parameter of shape [1]: it says so only after a step."""
    parameter = torch.nn.Parameter(torch.zeros(1))
    parameter.grad = torch.zeros(1)
    settings = {name: value for name, value in optimizer.param_groups[0].items() if name != "params"}
    like = type(optimizer)([{"params": [parameter], **settings}])  # type: ignore[call-arg]
    like.step()
    return like.state[parameter]


def _check_random_numbers(path: Place, key: str, found: Any) -> None:
    """Its readers check all but where NumPy's generator is in its 624 words, which it would read from anywhere."""
    _check_mapping(path, key, found)
    numpy_state = found.get("numpy")
    if not isinstance(numpy_state, tuple | list) or len(numpy_state) != 5:
        raise CheckpointError(f"{path}: {key}.numpy is not the state of NumPy's random numbers")
    name, words, place, has_gauss, gauss = numpy_state
    whole = isinstance(words, Tensor) and words.shape == (624,) and words.dtype == torch.int64
    inside = whole and bool(((words >= 0) & (words < 2**32)).all())
    numbers = type(place) is int and 0 <= place <= 624 and has_gauss in (0, 1) and isinstance(gauss, float)
    if name != "MT19937" or not inside or not numbers or not math.isfinite(gauss):
        raise CheckpointError(f"{path}: {key}.numpy is not the state of NumPy's random numbers")


def _kind(value: Any) -> str:
    return type(value).__name__
