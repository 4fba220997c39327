"""What the command lines of the recipes share."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn, ParamSpec, TypeVar

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException

from nfv_torchrl.errors import AuditError, CheckpointError, ScenarioError

P = ParamSpec("P")
R = TypeVar("R")

EXPECTED = (ScenarioError, CheckpointError, AuditError)
"""Errors whose message names the culprit and the remedy: a traceback would only bury it."""


def clear_errors(main: Callable[P, R]) -> Callable[P, R]:
    """Decorate a recipe's ``main``: an expected error prints ``error: ...`` to stderr and exits with code 2.

    Put it between ``@hydra.main(...)`` and the function. An expected error raised inside ``hydra.utils.instantiate``
    is shown in the same way. Anything else keeps its traceback.
    """

    @functools.wraps(main)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return main(*args, **kwargs)
        except EXPECTED as error:
            _leave(error)
        except InstantiationException as error:
            if not isinstance(error.__cause__, EXPECTED):
                raise
            _leave(error.__cause__)

    return guarded


def check_keys(config: Mapping[str, Any], known: Iterable[str]) -> None:
    """Refuse keys that a recipe would not read, such as one added with ``+key=value``.

    Raises:
        ScenarioError: there is such a key.
    """
    for key in config:
        if key not in (names := [*known]):
            raise ScenarioError(f"{key}: this recipe has no such key; known keys: {', '.join(names)}")


def recipe_configs(recipes: Path) -> contextlib.AbstractContextManager[Any]:
    """For ``hydra.compose``: the configs of the recipes in a folder, which a recipe at work has opened already."""
    if GlobalHydra.instance().is_initialized():
        return contextlib.nullcontext()
    return initialize_config_dir(str(recipes.resolve() / "config"), version_base=None)


def _leave(error: BaseException) -> NoReturn:
    print(f"error: {error}", file=sys.stderr)
    raise SystemExit(2) from None
