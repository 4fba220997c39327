"""The methods that a recipe's yaml names."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hydra.utils import instantiate

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.methods.base import Method
from nfv_torchrl.scenario.scenario import Scenario

TABLES = ("summary.csv", "per_seed.csv")
"""Files beside the folders that are called after methods."""


def _check_name(key: str, name: Any, others: Iterable[str]) -> None:
    """A method's name is that of a folder, too, on any file system."""
    usable = isinstance(name, str) and name.isprintable() and name.strip() == name and len(name.encode()) <= 100
    if not usable or not name or name[0] == "." or any(letter in name for letter in "/\\:"):
        raise ScenarioError(
            f"method.{key}.name: {name!r} names no folder of its own; use letters and digits, no slash, no dot in front"
        )
    alike = [other for other in (*others, *TABLES) if other != name and other.casefold() == name.casefold()]
    if alike or name in TABLES:
        raise ScenarioError(f"method.{key}.name: {name!r} and {(alike or TABLES)[0]!r} are one file; use another name")


def methods_from_config(config: Mapping[str, Any], scenario: Scenario | Sequence[Scenario]) -> list[Method]:
    """Build the methods of a recipe's ``method`` group, in order.

    Args:
        config: ``_target_`` and arguments of each method; the keys only tell the entries apart. An entry with
            ``_partial_: true`` is called with ``scenario=`` after that (a checkpoint has to be checked against it).
        scenario: what the methods will run on, one scenario or the several of one batch.

    Raises:
        ScenarioError: an entry is no method, or two have the same name.
    """
    methods: dict[str, Method] = {}
    for key, entry in config.items():
        if not isinstance(entry, Mapping) or "_target_" not in entry:
            raise ScenarioError(f"method.{key}: {entry!r} is no method; give _target_ and the arguments of its class")
        method = instantiate(entry)
        if isinstance(method, functools.partial):
            method = method(scenario=scenario)
        lacking = [name for name in (*Method.__annotations__, "prepare", "act") if not hasattr(method, name)]
        if lacking:
            raise ScenarioError(
                f"method.{key}: {type(method).__name__} lacks {lacking[0]!r}; see nfv_torchrl.methods.Method"
            )
        _check_name(key, method.name, methods)
        if method.name in methods:
            raise ScenarioError(f"method.{key}: another method is called {method.name!r} too; set method.{key}.name")
        methods[method.name] = method
    if not methods:
        raise ScenarioError("method: names no method; give at least one, such as method=greedy")
    return list(methods.values())
