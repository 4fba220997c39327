"""How planner kernels are compiled.

Without reference counting: the counts of the many arrays in the tables and scratch tuples would take more than nine
tenths of the time of a search. That is safe because kernels keep no array beyond a call, and it makes "no allocation
per request" a rule that Numba checks: a function that would allocate does not compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that takes arrays and returns numbers; it releases the GIL."""
    return njit(cache=True, nogil=True, _nrt=False)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a part of a kernel, for kernels only: it may return views of its arguments."""
    return njit(cache=True, forceinline=True, _nrt=False)(function)
