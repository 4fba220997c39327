"""Means, confidence intervals and paired comparisons over seeds.

Seeds differ more than methods do, so two methods are compared on the same seeds, pair by pair. Every interval is
Student's; with one seed it is undefined (NaN, shown as "–"), never zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

CONFIDENCE = 0.95
SMALLEST_GAP = 1e-3
"""A bound and `myopic_optimal` closer than this in AAR leave no gap of which a share could be closed."""


@dataclass(frozen=True)
class Interval:
    """An estimate, the ends of its confidence interval (NaN when undefined) and the number of seeds behind it."""

    mean: float
    low: float
    high: float
    n: int

    @property
    def half_width(self) -> float:
        """Half the interval's length; for an interval that is not symmetric, the longer of its two arms."""
        return max(self.mean - self.low, self.high - self.mean)


def mean_interval(values: Sequence[float] | np.ndarray, confidence: float = CONFIDENCE) -> Interval:
    """Mean of ``values`` [n] and its Student t interval.

    NaN values are seeds in which the metric does not exist (the delay where nothing was accepted); they are left out,
    and ``n`` counts what is left.
    """
    sample = np.asarray(values, dtype=np.float64)
    sample = sample[np.isfinite(sample)]
    n = len(sample)
    if n == 0:
        return Interval(math.nan, math.nan, math.nan, 0)
    # Equal values have exactly that mean; their sum divided by n may be off by a bit.
    mean = float(sample[0]) if np.all(sample == sample[0]) else math.fsum(sample) / n
    if n == 1:
        return Interval(mean, math.nan, math.nan, 1)
    half = _quantile(n, confidence) * math.sqrt(float(np.sum((sample - mean) ** 2)) / (n - 1) / n)
    return Interval(mean, mean - half, mean + half, n)


def paired_difference(
    a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, confidence: float = CONFIDENCE
) -> Interval:
    """Mean of ``a - b`` over the same seeds, [n] each, with its Student t interval."""
    first, second = _pairs(a, b)
    return mean_interval(first - second, confidence)


def relative_difference(
    a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, confidence: float = CONFIDENCE
) -> Interval:
    """``mean(a - b) / mean(b)`` over the same seeds, [n] each: 0.07 reads "7 % above ``b``".

    The interval is Fieller's for a ratio of two means of pairs. It leaves out 0 exactly when the interval of
    ``paired_difference`` does, so the absolute and the relative comparison never contradict each other.
    """
    ratio = ratio_of_means(a, b, confidence)
    return Interval(ratio.mean - 1, ratio.low - 1, ratio.high - 1, ratio.n)


def ratio_of_means(
    numerator: Sequence[float] | np.ndarray, denominator: Sequence[float] | np.ndarray, confidence: float = CONFIDENCE
) -> Interval:
    """``mean(numerator) / mean(denominator)`` over the same seeds, [n] each, with Fieller's interval.

    It holds every ratio r for which a t-test does not tell ``mean(numerator - r * denominator)`` from 0, and is bounded
    only if that test tells the denominator's own mean from 0; otherwise the ends are NaN.
    """
    top, bottom = _pairs(numerator, denominator)
    n = len(top)
    if n == 0 or np.mean(bottom) == 0:
        return Interval(math.nan, math.nan, math.nan, n)
    x, y = float(np.mean(top)), float(np.mean(bottom))
    if n == 1:
        return Interval(x / y, math.nan, math.nan, 1)
    if np.array_equal(top, bottom):  # rounding shall not make a difference where there is none
        return Interval(1.0, 1.0, 1.0, n)
    scale = _quantile(n, confidence) ** 2 / n
    (s_xx, s_xy), (_, s_yy) = np.cov(top, bottom) * scale
    # The ends solve (x - r y)^2 = s_xx - 2 r s_xy + r^2 s_yy, a quadratic in r.
    leading, middle, last = y * y - s_yy, x * y - s_xy, x * x - s_xx
    if leading <= 0:
        return Interval(x / y, math.nan, math.nan, n)
    root = math.sqrt(max(middle * middle - leading * last, 0.0))
    return Interval(x / y, float((middle - root) / leading), float((middle + root) / leading), n)


def cost_ratio(costs: np.ndarray, reference: np.ndarray) -> float:
    """Paired cost: ``costs`` over ``reference``, summed over the requests that both accept; NaN if there are none.

    The fair comparison of cost: a method that drops the costly requests gains nothing by it.

    Args:
        costs: what every request cost, float [R], NaN where it was not accepted.
        reference: the same of another method.
    """
    both = np.isfinite(costs) & np.isfinite(reference)
    below = float(reference[both].sum(dtype=np.float64))
    return float(costs[both].sum(dtype=np.float64)) / below if below else math.nan


def gap_closed(values: Sequence[float], start: Sequence[float], bound: Sequence[float]) -> Interval | None:
    """How much of the way from ``start`` to ``bound`` the ``values`` go, over the same seeds, [n] each.

    A ratio of means over seeds; None where there is no gap to close, or no seed.
    """
    gained, gap = np.array(values) - np.array(start), np.array(bound) - np.array(start)
    return None if not len(gap) or np.mean(gap) < SMALLEST_GAP else ratio_of_means(gained, gap)


def _quantile(n: int, confidence: float) -> float:
    return float(stdtrit(n - 1, 0.5 + confidence / 2))


def _pairs(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if first.shape != second.shape:
        raise ValueError(f"paired samples must have the same seeds, got shapes {first.shape} and {second.shape}")
    both = np.isfinite(first) & np.isfinite(second)
    return first[both], second[both]
