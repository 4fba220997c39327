"""What the command lines of the recipes share: where their configs are, and errors in one line."""

from __future__ import annotations

import codecs
import contextlib
import errno
import functools
import inspect
import logging
import os
import re
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, ParamSpec, TypeVar

import hydra
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nfv_torchrl.cli import recipes_folder
from nfv_torchrl.errors import AuditError, CheckpointError, ScenarioError, TrainingError, cut_words
from nfv_torchrl.locks import locks_of_command
from nfv_torchrl.settings.torchrl_losses import forget_other_loss
from nfv_torchrl.training.help import help_text
from nfv_torchrl.training.overrides import explain

P = ParamSpec("P")
R = TypeVar("R")

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
"""Signals that ask a command to end: Ctrl-C, and what clusters send before they kill."""
EXPECTED = (ScenarioError, CheckpointError, AuditError, TrainingError)
"""Errors whose message names the culprit and the remedy: a traceback would only bury it."""
FULL_ERROR = "HYDRA_FULL_ERROR"
"""Environment variable that asks for tracebacks; Hydra itself reads it."""
REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room there; what was written before is whole"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "name a place that you may write to"),
    **dict.fromkeys(
        (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP), "check the path"
    ),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "raise the limit of open files (ulimit -n)"),
    **dict.fromkeys((errno.EIO, errno.ESTALE), "check the disk"),
}
"""What to do about an error of the operating system, for those that are not our bugs."""
PLAIN_TEXT = {"–": "-", "—": "-", "±": "+-", "…": "...", "λ": "lambda", "μ": "mu", "γ": "gamma", "ρ": "rho", "τ": "tau"}


def recipe(name: str) -> Callable[[Callable[[DictConfig], None]], Callable[..., None]]:
    """Decorate a recipe's ``main``: it gets ``config/NAME.yaml`` with the overrides of the command line.

    The folder ``config`` is the one beside the recipe, or for a recipe that was copied elsewhere the package's own.
    Expected errors are printed in one line, those of Hydra about the command line as well, and the exit code is 2. With
    the environment variable ``HYDRA_FULL_ERROR=1`` there are tracebacks instead.
    """

    def decorate(main: Callable[[DictConfig], None]) -> Callable[..., None]:
        beside = Path(inspect.getfile(main)).resolve().parent
        recipes = beside if (beside / "config" / f"{name}.yaml").is_file() else recipes_folder()
        entered = False

        @functools.wraps(main)
        def entering(cfg: DictConfig) -> None:
            nonlocal entered
            entered = True
            _quiet_torchrl()
            clear_errors(main)(cfg)

        @functools.wraps(main)
        def from_command_line(cfg: DictConfig) -> None:
            forget_other_loss(cfg, HydraConfig.get().overrides.task)
            entering(cfg)

        app = hydra.main(config_path=str(recipes / "config"), config_name=name, version_base=None)(from_command_line)

        @functools.wraps(main)
        def run(cfg: DictConfig | None = None) -> None:
            nonlocal entered
            entered = False  # by an earlier call in this process, it says nothing of this one
            if cfg is not None:
                entering(cfg)
                return
            if {"-h", "--help"} & set(sys.argv[1:]):
                with recipe_configs(recipes):
                    print(help_text(name, recipes / "config"))
                return
            wanted = os.environ.get(FULL_ERROR) == "1"
            try:
                # Hydra raises its errors instead of printing them at length.
                with _full_error(True), _sweeps_elsewhere():
                    app()
            except Exception as error:
                if wanted or entered:
                    raise
                _leave(explain(error, recipes, name, sys.argv[1:]))

        return run

    return decorate


def _quiet_torchrl() -> None:
    """TorchRL's notes would break the progress line. ``RL_LOGGING_LEVEL=INFO`` brings them back."""
    level = os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # read by processes started from here, too
    logging.getLogger("torchrl").setLevel(level)


def clear_errors(main: Callable[P, R]) -> Callable[P, R]:
    """Decorate a command's ``main``: an expected error prints ``error: ...`` to stderr and exits with code 2.

    Those are the errors of this package, also where ``hydra.utils.instantiate`` wraps them, and what the machine does
    not grant: files, room on a disk, memory. Anything else keeps its traceback. Locks that ``main`` took
    are given back. A signal that ends it (Ctrl-C, SIGTERM, SIGUSR1) lets it clean up first; the exit code then is 128 +
    the number of the signal.
    """

    @functools.wraps(main)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        plain_output()
        try:
            # Processes started from here decide for themselves about tracebacks.
            with _full_error(False), locks_of_command(), _signals_interrupt():
                return main(*args, **kwargs)
        except KeyboardInterrupt as stop:
            number = stop.args[0] if stop.args else signal.SIGINT
            print(f"\nStopped by {signal.Signals(number).name}.", file=sys.stderr)
            raise SystemExit(128 + number) from None
        except (Exception, MemoryError) as error:
            text = expected(error)
            if text is None:
                raise
            _leave(text)

    return guarded


@contextlib.contextmanager
def _signals_interrupt() -> Iterator[None]:
    """What ends a process raises ``KeyboardInterrupt`` instead, with the signal's number."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt(number)

    before = {number: signal.signal(number, interrupt) for number in STOPS if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def expected(error: BaseException) -> str | None:
    """The line that an expected error is worth; None for a bug."""
    if isinstance(error, EXPECTED):
        return str(error)
    if isinstance(error, InstantiationException):
        return _of_instantiation(error)
    if isinstance(error, OmegaConfBaseException):
        return f"{error.full_key or 'the settings'}: {str(error).splitlines()[0]}; check that setting"
    if isinstance(error, OSError) and error.errno in REMEDIES:
        return f"{error.filename or 'writing'}: {os.strerror(error.errno)}; {REMEDIES[error.errno]}"
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return f"memory: there is too little ({_line(error)}); use fewer environments or seeds, or a smaller memory"
    return None


def recipe_configs(recipes: Path) -> contextlib.AbstractContextManager[Any]:
    """For ``hydra.compose``: the configs of the recipes in a folder, which a recipe at work has opened already."""
    if GlobalHydra.instance().is_initialized():
        return contextlib.nullcontext()
    return initialize_config_dir(str(recipes.resolve() / "config"), version_base=None)


def plain_output() -> None:
    """Print what a terminal's encoding cannot show in plain letters, where Python would raise an error."""
    codecs.register_error("plain", _in_plain_letters)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="plain")


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(PLAIN_TEXT.get(letter, "?") for letter in text), error.end


def _of_instantiation(error: InstantiationException) -> str | None:
    """An expected error raised in a ``_target_``, or one about its arguments."""
    found = re.search(r"full_key: (\S+)", str(error))
    key = found[1] if found else "_target_"
    cause = error.__cause__
    if isinstance(cause, EXPECTED):
        return str(cause) if str(cause).startswith(key.split(".")[0]) else f"{key}: {cause}"
    if cause is not None and isinstance(cause, TypeError | ValueError | ImportError | AttributeError):
        return f"{key}: {_line(cause)}; check its arguments ({FULL_ERROR}=1 shows where it was raised)"
    return None


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


@contextlib.contextmanager
def _full_error(wanted: bool) -> Iterator[None]:
    before = os.environ.pop(FULL_ERROR, None)
    if wanted:
        os.environ[FULL_ERROR] = "1"
    try:
        yield
    finally:
        os.environ.pop(FULL_ERROR, None)
        if before is not None:
            os.environ[FULL_ERROR] = before


@contextlib.contextmanager
def _sweeps_elsewhere() -> Iterator[None]:
    """Hydra's own file of a sweep goes to a folder that is removed: it is written before anything can be refused."""
    given = sys.argv
    if not any(text.startswith(("-m", "--m", "hydra.mode=")) for text in given) or "hydra.sweep.dir" in " ".join(given):
        yield
        return
    place = next((place for place, text in enumerate(given) if place and text[0] != "-" and "=" in text), len(given))
    with tempfile.TemporaryDirectory(prefix="sweep_") as folder:
        sys.argv = [*given[:place], f"hydra.sweep.dir='{folder}'", *given[place:]]
        try:
            yield
        finally:
            sys.argv = given


def _leave(text: str) -> NoReturn:
    print(f"error: {cut_words(text)}", file=sys.stderr)
    raise SystemExit(2) from None
