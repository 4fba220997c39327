"""How kernels are compiled, and when what was compiled is stale.

Without reference counting: counting references to the many arrays of a world would take more than nine tenths of the
time of a step or a search. That is safe because kernels keep no array beyond a call, and it makes "no allocation
inside" a rule that Numba checks: a function that would allocate does not compile.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import re
import stat
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numba import config, njit
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.types.misc import unliteral

from nfv_torchrl.simulator.parts import KeptFiles, KernelCompiler, PartCompiler, SharedCompiler

log = logging.getLogger(__name__)
PACKAGE = Path(__file__).parents[1]
WITHIN = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
PART = {"pipeline_class": PartCompiler} | WITHIN
IMPORT = re.compile(rf"^from ({PACKAGE.name}[\w.]*) import ([\w, ]*)", re.MULTILINE)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that takes arrays and returns numbers, for Python and for other compiled code.

    It releases the GIL.
    """
    return _compiled(function, pipeline_class=KernelCompiler, nogil=True)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call; it becomes machine code within these, see ``PartLibrary``."""
    return _compiled(function, **PART)


def shared(function: Callable[..., Any]) -> Any:
    """Compile a function that several kernels call and that takes much longer to run than to call, once for all."""
    return _compiled(function, pipeline_class=SharedCompiler, **WITHIN)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a small function that only kernels call into its callers."""
    return _compiled(function, **PART, forceinline=True)


def records(count: int, dtype: np.dtype) -> np.ndarray:
    """``count`` zeroed records, whose fields are attributes where Numba is switched off (NUMBA_DISABLE_JIT), too."""
    made = np.zeros(count, dtype)
    return made.view(np.recarray) if config.DISABLE_JIT else made


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    made = njit(_nrt=False, **options)(function)
    if made is not function:  # it is where Numba is switched off
        made.get_call_template = partial(_call_of_any_value, made)
        kept = _cache_for(function)
        if kept is not None:
            made._cache = kept
    return made


def _call_of_any_value(called: Any, args: Any, kws: Any) -> Any:
    """How Numba sees a call by compiled code: by the types of its arguments, never by the values of constants.

    Numba compiles a function once more for every constant that it is called with, and for the value before a loop of
    what a loop counts. LLVM knows the constants of a call when it optimises the kernel.
    """
    _, args = called._compiler.fold_argument_types(args, kws)
    return type(called).get_call_template(called, [unliteral(kind) for kind in args], {})


class KernelFile(IndexDataCacheFile):
    """Cache files whose compiled code ends with its checksum: damaged machine code is not to be run."""

    def _dump(self, content: Any) -> bytes:
        data = super()._dump(content)
        return data + hashlib.sha256(data).digest()  # reading a pickle stops at its end

    def _load_data(self, name: str) -> Any:
        data = Path(self._data_path(name)).read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[:-size]).digest() != data[-size:]:
            raise pickle.UnpicklingError(f"{name} is damaged")
        return pickle.loads(data)


class KernelCache(FunctionCache):
    """Numba's cache on disk, stale as soon as one of the modules that a function was compiled from has changed.

    Numba itself looks at the function's own file only, while what it caches also holds the compiled code of functions
    called and the constants read from other modules: a changed rule would go on unchanged. And whatever is wrong with
    the files costs a compilation here, not the run.

    Raises:
        RuntimeError: Numba finds no folder that it may write to.
    """

    _impl_class = KeptFiles

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), source_stamp(Path(function.__code__.co_filename)))
        self._cache_file = KernelFile(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code, or None if it is not there or cannot be read."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever reading a damaged file raises
            with contextlib.suppress(OSError):
                Path(self._cache_file._index_path).unlink(missing_ok=True)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, if there is room for it."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(f"compiled code cannot be kept in {self.cache_path} ({error.strerror})")


def _cache_for(function: Callable[..., Any]) -> KernelCache | None:
    """A cache beside the source or in the user's home; else in the temporary folder; else none."""
    with contextlib.suppress(RuntimeError):
        return KernelCache(function)
    folder = _temporary_folder()
    if folder is None:
        _warn_once("there is no folder to keep compiled code in, so it is compiled anew each time")
        return None
    _warn_once(f"compiled code is kept in {folder}, because neither the package's folder nor HOME can be written to")
    # In the environment, where child processes find it.
    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = str(folder)
    with contextlib.suppress(RuntimeError):
        return KernelCache(function)
    return None


def _temporary_folder() -> Path | None:
    """A folder that only this user can write to: what lies in it will be run."""
    try:
        folder = Path(tempfile.gettempdir()) / f"nfv_torchrl_{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not stat.S_IMODE(about.st_mode) & 0o022
    return folder if private else None


@cache
def _warn_once(what: str) -> None:
    log.warning("warning: %s; set NUMBA_CACHE_DIR to a folder of your own", what)


@cache
def source_stamp(path: Path) -> str:
    """A hash of a module's file and of the modules of this package that it imports from, directly or not.

    What a package's ``__init__`` passes on is not followed: kernels import constants and kernels by their own module.
    """
    seen: set[Path] = set()
    waiting = [path]
    while waiting:
        here = waiting.pop()
        if here not in seen and here.is_file():
            seen.add(here)
            waiting.extend(_imported(here))
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in sorted(seen))).hexdigest()


@cache
def _imported(path: Path) -> list[Path]:
    """Files that the modules imported by a file may be in."""
    found = []
    for module, names in IMPORT.findall(path.read_text(encoding="utf-8")):
        place = PACKAGE.parent.joinpath(*module.split("."))
        found += [place.with_suffix(".py"), *(place / f"{name.strip()}.py" for name in names.split(","))]
    return found
