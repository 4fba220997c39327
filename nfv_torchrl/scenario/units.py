"""Amounts in whole ledger units, so that what is taken comes back exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

LEDGER_UNITS = 1_000_000
"""Ledger units in one Mbit/s (a unit is 1 bit/s) or one Mcycles/s (a unit is 1 cycle/s)."""

MAX_CAPACITY = 1e9
"""Largest capacity in Mbit/s or Mcycles/s: its ledger units still fit a float64 without rounding."""


def to_ledger(amount: ArrayLike) -> np.ndarray:
    """``amount`` in Mbit/s or Mcycles/s as the nearest whole number of ledger units, int64, same shape."""
    return np.rint(np.asarray(amount, dtype=np.float64) * LEDGER_UNITS).astype(np.int64)


def quantise(amount: ArrayLike) -> np.ndarray:
    """``amount`` rounded to whole ledger units, float64 in the same unit as given. Idempotent to the bit."""
    return np.rint(np.asarray(amount, dtype=np.float64) * LEDGER_UNITS) / LEDGER_UNITS
