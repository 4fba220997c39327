"""How planner kernels are compiled.

Without reference counting: counting references to the many arrays of tables and scratch would take more than nine
tenths of the time of a search. That is safe because kernels keep no array beyond a call, and it makes "no allocation
per request" a rule that Numba checks: a function that would allocate does not compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that takes arrays and returns numbers, for Python and for other compiled code.

    It releases the GIL.
    """
    return njit(cache=True, nogil=True, _nrt=False)(function)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call. Its Python wrapper is left out, half of what there is to compile."""
    return njit(cache=True, _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a small function that only kernels call into its callers."""
    return njit(cache=True, forceinline=True, _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
