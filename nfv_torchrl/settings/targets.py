"""Settings that name a class or function of one's own choice by ``_target_``, checked against its signature.

A signature is checked as far as it is annotated: with plain types, or with those of ``values``, such as
``gamma: Share``. What a recipe passes itself (``given``) is no setting.
"""

from __future__ import annotations

import collections.abc
import inspect
import os
import pkgutil
import types
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import (
    PLAIN,
    Count,
    NotNegative,
    Positive,
    Rule,
    Share,
    join,
    parse,
    refuse,
    refuse_key,
    shown,
)

OF_HYDRA = ("_target_", "_partial_", "_recursive_", "_convert_", "_args_")
"""Keys that ``hydra.utils.instantiate`` reads itself."""
SPECIAL: dict[str, dict[str, Any]] = {
    "torchrl.objectives.utils.HardUpdate": {"value_network_update_interval": Count},
    "torchrl.objectives.utils.SoftUpdate": {"eps": Share, "tau": Share},
    "torchrl.data.replay_buffers.samplers.PrioritizedSampler": {
        "alpha": NotNegative,
        "beta": NotNegative,
        "eps": Positive,
    },
    "nfv_torchrl.methods.policy_file.load_policy": {"path": str | None},
}
"""Arguments whose annotations do not say it: TorchRL's, and a path that is null where ``checkpoint`` names no file."""


class Target(Rule):
    """A mapping with ``_target_`` and arguments.

    Args:
        given: arguments that the recipe passes.
        partial: whether ``_partial_: true`` belongs there; None: it may; ``functions``: to functions, not to classes.
        has: methods that a class needs.
    """

    def __init__(
        self, *given: str, partial: bool | Literal["functions"] | None = False, has: tuple[str, ...] = ()
    ) -> None:
        self.given, self.partial, self.has = given, partial, has

    def describe(self, kind: str) -> str:
        """See ``Rule``."""
        return "a mapping with _target_ and arguments"

    def check(self, value: Any, where: str, expected: str) -> None:
        """See ``Rule``."""
        wanted = self.partial
        if wanted == "functions":
            wanted = not inspect.isclass(locate(value.get("_target_"), where))
        if wanted is not None and value.get("_partial_", False) is not wanted:
            refuse(f"{where}._partial_", value.get("_partial_", False), str(wanted).lower())
        check_target(value, where, self.given)
        target = locate(value.get("_target_"), where)
        for method in self.has if inspect.isclass(target) else ():
            if not hasattr(target, method):
                name = shown(value["_target_"])
                raise ScenarioError(f"{where}._target_: {name} has no method {method!r}; name a class that has it")


def check_target(spec: Mapping[str, Any], where: str, given: tuple[str, ...] = ()) -> None:
    """Check the target and the arguments of ``spec`` without calling it.

    Raises:
        ScenarioError: the target cannot be imported or called, or an argument is unknown, missing or of the wrong kind.
    """
    parse(spec.get("_partial_", False), bool, f"{where}._partial_")
    target = locate(spec.get("_target_"), where)
    arguments = {key: value for key, value in spec.items() if key not in OF_HYDRA}
    called = target.__init__ if inspect.isclass(target) else target
    try:
        parameters = inspect.signature(called).parameters
    except (TypeError, ValueError):  # written in C
        return
    names = [
        name
        for place, (name, parameter) in enumerate(parameters.items())
        if not (place == 0 and inspect.isclass(target))
        and name not in given
        and parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    ]
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        for key in arguments:
            if key not in names:
                refuse_key(join(where, key), names)
    if not spec.get("_partial_") and not spec.get("_args_"):
        for name in names:
            if parameters[name].default is inspect.Parameter.empty and name not in arguments:
                raise ScenarioError(f"{join(where, name)}: is missing; add it")
    _check_kinds(target, called, arguments, where)


def locate(path: Any, where: str) -> Any:
    """What the ``_target_`` of the setting ``where`` names.

    Raises:
        ScenarioError: nothing that can be imported and called.
    """
    if not isinstance(path, str):
        raise ScenarioError(f"{where}._target_: {shown(path)}; give a class or function with its package")
    try:
        target = pkgutil.resolve_name(path)
    except Exception as error:  # whatever importing somebody's module raises
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ScenarioError(f"{where}._target_: {path!r} cannot be imported ({why}); check its name") from error
    if not callable(target):
        raise ScenarioError(f"{where}._target_: {path!r} is no class or function; name one")
    return target


def _check_kinds(target: Any, called: Any, arguments: Mapping[str, Any], where: str) -> None:
    """The values of the arguments whose annotations can be judged."""
    hints = _hints(called)
    hints |= SPECIAL.get(f"{target.__module__}.{getattr(target, '__qualname__', '')}", {})
    for key, value in arguments.items():
        if isinstance(value, Mapping) and "_target_" in value:
            check_target(value, join(where, key))
        elif key in hints and _can_be_written(hints[key]):
            parse(value, hints[key], join(where, key))
        elif inspect.isclass(hints.get(key)):
            refuse(join(where, key), value, f"a mapping with the _target_ of a {hints[key].__name__}")


def _hints(called: Any) -> dict[str, Any]:
    try:
        return typing.get_type_hints(called, include_extras=True)
    except Exception:  # annotations that cannot be evaluated, such as names imported for type checking only
        return {}


def written_hints(called: Any) -> dict[str, Any]:
    """The annotations of a function's arguments that a yaml file can have all values of."""
    return {name: hint for name, hint in _hints(called).items() if _can_be_written(hint)}


def _can_be_written(hint: Any) -> bool:
    """Whether all values of the type can stand in a yaml file."""
    if get_origin(hint) is Annotated:
        return _can_be_written(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType, tuple, list, dict, collections.abc.Sequence):
        return all(_can_be_written(part) for part in get_args(hint))
    return hint in (*PLAIN, dict, Any, type(None), Ellipsis) or get_origin(hint) is os.PathLike
