"""How kernels are compiled, and when what was compiled is stale.

Without reference counting: counting references to the many arrays of a world would take more than nine tenths of the
time of a step or a search. That is safe because kernels keep no array beyond a call, and it makes "no allocation
inside" a rule that Numba checks: a function that would allocate does not compile.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

PACKAGE = Path(__file__).parents[1]
IMPORT = re.compile(rf"^from ({PACKAGE.name}[\w.]*) import ([\w, ]*)", re.MULTILINE)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that takes arrays and returns numbers, for Python and for other compiled code.

    It releases the GIL.
    """
    return _compiled(function, nogil=True)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call. Its Python wrapper is left out, half of what there is to compile."""
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a small function that only kernels call into its callers."""
    return _compiled(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def _compiled(function: Callable[..., Any], **options: bool) -> Any:
    """Compile with a cache on disk that is stale as soon as one of the modules it was compiled from has changed.

    Numba itself looks at the function's own file only, while what it caches also holds the compiled code of functions
    called and the constants read from other modules: a changed rule would go on unchanged.
    """
    made = njit(cache=True, _nrt=False, **options)(function)
    cached = getattr(getattr(made, "_cache", None), "_cache_file", None)  # none where Numba is switched off
    if cached is not None:
        cached._source_stamp = (cached._source_stamp, source_stamp(Path(function.__code__.co_filename)))
    return made


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
