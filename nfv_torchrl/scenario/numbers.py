"""Checks of single numbers that come from Python, where no parser has seen them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError


def check_number(key: str, value: Any) -> None:
    """Refuse what is no finite number (text, None, true and false, NaN, an integer beyond a float's range).

    Raises:
        ScenarioError: it is none; the message begins with ``key``.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise ScenarioError(f"{key}: {value!r}; use a number")
    # A comparison, because math.isfinite chokes on integers beyond a float's range.
    if not -1e308 <= value <= 1e308:
        raise ScenarioError(f"{key}: {shown(value)}; use a finite number")


def check_integer(key: str, value: Any, least: int, most: int) -> int:
    """``value`` as an int, if it is an integer from ``least`` to ``most``.

    Raises:
        ScenarioError: it is not; the message begins with ``key``.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ScenarioError(f"{key}: {shown(value)}; use an integer")
    if not least <= value <= most:
        bounds = f"of at least {least}" if value < least else f"of at most {most}"
        raise ScenarioError(f"{key}: {shown(value)}; use an integer {bounds}")
    return int(value)


def shown(value: Any, longest: int = 40) -> str:
    """``value`` for a message of one line: its end is left out where it is long."""
    if isinstance(value, int) and abs(value) >= 10**longest:
        return f"an integer of about 10^{int(math.log10(abs(value)))}"
    text = repr(value)
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
