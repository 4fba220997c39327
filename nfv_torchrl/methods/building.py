"""What a policy file may build: classes of a list, from plain arguments. A stranger may have written the file.

A file names a class and its arguments. The name is looked up in a table of this project's classes, or, for packages
that the user trusts, in the module that defines it. Nothing else in the file is resolved, called or imported.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from nfv_torchrl import losses, networks
from nfv_torchrl.errors import CheckpointError, one_line
from nfv_torchrl.losses import request_loss
from nfv_torchrl.losses.torchrl_losses import FITS
from nfv_torchrl.methods.evolved import CandidatePolicy, Evolvable, PricePolicy
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.nfvdeep.planner import NFVdeepPlanner
from nfv_torchrl.plans.planner import MenuPlanner

Place = str | os.PathLike[str]


def _by_name(*classes: type) -> dict[str, type]:
    """Each class under its module's name and under that of the package which exports it."""
    modules = {f"{each.__module__}.{each.__name__}": each for each in classes}
    return modules | {f"{each.__module__.rpartition('.')[0]}.{each.__name__}": each for each in classes}


def _losses() -> list[type[nn.Module]]:
    """Every loss of this package: what has ``prepare`` and ``forward``, in a module of ``nfv_torchrl/losses/``."""
    found = []
    for place in pkgutil.iter_modules(losses.__path__):
        module = importlib.import_module(f"{losses.__name__}.{place.name}")
        for each in vars(module).values():
            made_here = isinstance(each, type) and each.__module__ == module.__name__
            if made_here and issubclass(each, nn.Module) and hasattr(each, "prepare"):
                found.append(each)
    return found


CLASSES: Mapping[str, Mapping[str, type]] = {
    "network": _by_name(
        networks.CandidateNetwork,
        networks.DuelingNetwork,
        networks.GRUNetwork,
        networks.ImplicitQuantileNetwork,
        networks.LookaheadNetwork,
        networks.MLPNetwork,
        networks.MenuNetwork,
        PriceNetwork,
    ),
    "loss": _by_name(*_losses(), *FITS),
    "planner": _by_name(NFVdeepPlanner, MenuPlanner),
    "policy": {
        **_by_name(CandidatePolicy, PricePolicy),
        "nfv_torchrl.evolution.CandidatePolicy": CandidatePolicy,
        "nfv_torchrl.evolution.PricePolicy": PricePolicy,
    },
}
"""By part of a policy file, the classes it may name; the planner is one that asks the policy, which evolution may have
shaped (``policy``)."""

BASES: Mapping[str, type] = {"network": nn.Module, "loss": nn.Module, "planner": object, "policy": Evolvable}
"""By part, what a class of a trusted package has to be."""

MOST_VALUES = 1000
"""Numbers and strings among the arguments of one class."""
MOST_DEPTH = 8
"""Lists in lists among them."""
LARGEST = 2**53


def factory(path: Place, part: str, config: Mapping[str, Any], trusted_packages: Sequence[str] = ()) -> Callable:
    """The class that a part of a policy file names, with the arguments the file gives; nothing is built yet.

    Args:
        path: the file, for messages.
        part: ``network``, ``loss``, ``planner`` or ``policy``.
        config: that part: ``_target_`` and arguments; a network's may have ``_partial_: true``.
        trusted_packages: packages of the user's own whose classes may be named too.

    Raises:
        CheckpointError: a class that is not allowed, or arguments that are not plain.
    """
    target = config.get("_target_")
    if not isinstance(target, str):
        raise CheckpointError(f"{path}: {part} names no class; a policy file says so in {part}._target_")
    if config.get("_partial_", True) is not True or (part != "network" and "_partial_" in config):
        raise CheckpointError(f"{path}: {part}._partial_ may only be true, and only of a network")
    arguments = {key: value for key, value in config.items() if key not in ("_target_", "_partial_")}
    _check_plain(path, part, arguments)
    found = _look_up(path, part, target, trusted_packages)
    return partial(request_loss(found) if part == "loss" else found, **arguments)


@contextlib.contextmanager
def building(path: Place, weights: Mapping[str, torch.Tensor]) -> Iterator[None]:
    """While a policy is built: no more memory than its weights account for, and one error for whatever goes wrong.

    Raises:
        CheckpointError: names the file.
    """
    elements = sum(tensor.numel() for tensor in weights.values())
    try:
        with _Allowance(path, elements):
            yield
    except CheckpointError:
        raise
    except Exception as error:  # a stranger's arguments can make a constructor raise anything
        raise CheckpointError(f"{path} holds no valid network, loss, planner or policy ({one_line(error)})") from error


class _Allowance(TorchFunctionMode):
    """Counts what is allocated before it is: a file of 1 kB may ask for layers of many GB."""

    ALLOCATING = (torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.arange)

    def __init__(self, path: Place, elements: int) -> None:
        super().__init__()
        self.path = path
        self.left = 4 * elements + 2**20  # room for temporary tensors

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in self.ALLOCATING:
            self.left -= func(*args, **{**kwargs, "device": "meta"}).numel()
            if self.left < 0:
                raise CheckpointError(f"{self.path}: its network is larger than its weights; it is not valid")
        return func(*args, **kwargs)


def _look_up(path: Place, part: str, target: str, trusted_packages: Sequence[str]) -> type:
    known = CLASSES[part].get(target)
    if known is not None:
        return known
    packages = [trusted_packages] if isinstance(trusted_packages, str) else list(trusted_packages)
    module, _, name = target.rpartition(".")
    package = next((each for each in packages if _inside(module, each)), None)
    if package is None or _inside(module, "nfv_torchrl"):
        raise CheckpointError(
            f"{path} asks for {target}, which is none of this project's {part} classes; if it is a class of a package "
            "that you trust, name that package in trusted_packages"
        )
    return _class_of(path, part, module, name, package)


def _class_of(path: Place, part: str, module: str, name: str, package: str) -> type:
    """A class that a trusted package defines, by the names in one of its modules alone."""
    target = f"{module}.{name}"
    if not all(word.isidentifier() and not word.startswith("__") for word in target.split(".")):
        raise CheckpointError(f"{path} asks for {target}, which is no name of a class in a module")
    try:
        found = vars(importlib.import_module(module)).get(name)
    except Exception as error:  # importing runs the package's own code
        raise CheckpointError(f"{path} asks for {target}, which cannot be imported ({one_line(error)})") from error
    if not isinstance(found, type) or not _inside(found.__module__, package) or not issubclass(found, BASES[part]):
        kind = "class" if BASES[part] is object else f"{BASES[part].__name__} class"
        raise CheckpointError(f"{path} asks for {target}, which is no {kind} that {package} defines")
    return found


def _inside(module: str, package: str) -> bool:
    return bool(package) and (module == package or module.startswith(f"{package}."))


def _check_plain(path: Place, part: str, arguments: Mapping[str, Any]) -> None:
    """Arguments are numbers, strings, None, and lists and dicts of them; no key or string that anything resolves."""
    waiting = [(part, 0, arguments)]
    values = 0
    while waiting:
        where, depth, value = waiting.pop()
        values += 1
        if values > MOST_VALUES or depth > MOST_DEPTH:
            raise CheckpointError(f"{path}: {part} has more arguments than any of its classes takes")
        if isinstance(value, Mapping):
            for key in value:
                if not isinstance(key, str) or key.startswith("_") or "$" in key:
                    raise CheckpointError(f"{path}: {where} has the key {key!r:.60}; a policy file has none such there")
            waiting += [(f"{where}.{key}", depth + 1, item) for key, item in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{where}.{place}", depth + 1, item) for place, item in enumerate(value)]
        else:
            _check_value(path, where, value)


def _check_value(path: Place, where: str, value: Any) -> None:
    if isinstance(value, str) and "${" in value:
        raise CheckpointError(f"{path}: {where} is {value!r:.60}; a policy file holds values, nothing to be resolved")
    if type(value) not in (type(None), bool, int, float, str):
        raise CheckpointError(f"{path}: {where} is a {type(value).__name__}; arguments are numbers, strings and lists")
    if isinstance(value, int | float) and not abs(value) < LARGEST:  # so of a NaN
        raise CheckpointError(f"{path}: {where} is no finite number below 2^53")
