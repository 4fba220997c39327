"""What is read from a file against what the run has: compared before anything is loaded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.checkpoint import GlobalRNGState

from nfv_torchrl.errors import CheckpointError, one_line
from nfv_torchrl.tensor_checks import Place, check_keys, check_like, check_mapping, kind_of

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
            raise CheckpointError(f"{path}: {name} is a {kind_of(content[name])}, not the state of that part")


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


def _check_optimizer(path: Place, key: str, found: Any, optimizer: torch.optim.Optimizer) -> None:
    """Settings as in this run, which come from its config; of each parameter what the optimizer keeps of it."""
    own = optimizer.state_dict()
    check_mapping(path, key, found)
    check_keys(path, key, found, own)
    check_like(path, f"{key}.param_groups", found["param_groups"], own["param_groups"])
    if found["param_groups"] != own["param_groups"]:
        raise CheckpointError(f"{path}: {key}.param_groups are not the settings of this run's {kind_of(optimizer)}")
    check_mapping(path, f"{key}.state", found["state"])
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
    check_mapping(path, key, found)
    numpy_state = found.get("numpy")
    if not isinstance(numpy_state, tuple | list) or len(numpy_state) != 5:
        raise CheckpointError(f"{path}: {key}.numpy is not the state of NumPy's random numbers")
    name, words, place, has_gauss, gauss = numpy_state
    whole = isinstance(words, Tensor) and words.shape == (624,) and words.dtype == torch.int64
    inside = whole and bool(((words >= 0) & (words < 2**32)).all())
    numbers = type(place) is int and 0 <= place <= 624 and has_gauss in (0, 1) and isinstance(gauss, float)
    if name != "MT19937" or not inside or not numbers or not math.isfinite(gauss):
        raise CheckpointError(f"{path}: {key}.numpy is not the state of NumPy's random numbers")
