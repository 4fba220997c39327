"""Numbers that are fixed, or drawn for each request from an interval.

An interval stands for ``LEVELS`` values that are equally far apart, both ends among them and all equally likely. So a
scenario has finitely many profiles, which the tables of searches and masks are made for once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import parse, shown

LEVELS = 21
"""Values of an interval, 5 % of it apart."""
DECIMALS = 6
"""Values are rounded to so many decimals: rates are whole bit/s."""
LARGEST = 1e30
"""Bound of delays and weights: beyond it sums and 32-bit numbers of observations overflow."""


def is_range(value: Any) -> bool:
    """Whether ``value`` is an interval, not one number (or None)."""
    return isinstance(value, Sequence)


def check_range(value: Any, where: str) -> Any:
    """A number, None, or an interval as a tuple.

    Raises:
        ScenarioError: it is neither, or its ends are not in order.
    """
    if not is_range(value) or isinstance(value, str):
        return value if value is None else parse(value, float, where)
    low, high = parse(value, tuple[float, float], where)
    if not 0 < low < high:
        raise ScenarioError(f"{where}: {shown(list(value))}; give [low, high] with 0 < low < high, or one number")
    return low, high


def values_of(value: float | tuple[float, float]) -> np.ndarray:
    """The values that a number or an interval stands for, ascending, float64 [1] or at most [LEVELS]."""
    if isinstance(value, tuple):
        return np.unique(np.round(np.linspace(*value, LEVELS), DECIMALS))
    return np.array([value])


def middle(value: float | tuple[float, float]) -> float:
    """The mean of the values."""
    return (value[0] + value[1]) / 2 if isinstance(value, tuple) else value
