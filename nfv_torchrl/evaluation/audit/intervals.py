"""Means and 95 % intervals, worked out a second time from their definitions (docs/model.md, Metrics)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.special import stdtrit

UNDEFINED = math.nan


class Row(NamedTuple):
    """Estimate, ends of its interval (NaN where undefined), and the number of seeds."""

    mean: float
    low: float
    high: float
    n: int


def mean_row(values: Sequence[float]) -> Row:
    """Mean and Student's interval of the values that exist."""
    sample = [value for value in values if math.isfinite(value)]
    n = len(sample)
    if n == 0:
        return Row(UNDEFINED, UNDEFINED, UNDEFINED, 0)
    mean = math.fsum(sample) / n
    if n == 1:
        return Row(mean, UNDEFINED, UNDEFINED, 1)
    half = _quantile(n) * math.sqrt(_covariance(sample, sample) / n)
    return Row(mean, mean - half, mean + half, n)


def ratio_row(pairs: Sequence[tuple[float, float]]) -> Row:
    """Ratio of the two means and Fieller's interval: the r for which mean(x - r y) is not told from 0."""
    both = [(x, y) for x, y in pairs if math.isfinite(x) and math.isfinite(y)]
    n = len(both)
    xs, ys = [x for x, _ in both], [y for _, y in both]
    bottom = math.fsum(ys) / n if n else 0.0
    if bottom == 0:
        return Row(UNDEFINED, UNDEFINED, UNDEFINED, n)
    top = math.fsum(xs) / n
    if n == 1:
        return Row(top / bottom, UNDEFINED, UNDEFINED, 1)
    if xs == ys:
        return Row(1.0, 1.0, 1.0, n)
    scale = _quantile(n) ** 2 / n
    a = bottom**2 - scale * _covariance(ys, ys)
    b = top * bottom - scale * _covariance(xs, ys)
    c = top**2 - scale * _covariance(xs, xs)
    if a <= 0:
        return Row(top / bottom, UNDEFINED, UNDEFINED, n)
    root = math.sqrt(max(b * b - a * c, 0.0))
    return Row(top / bottom, (b - root) / a, (b + root) / a, n)


def _covariance(xs: Sequence[float], ys: Sequence[float]) -> float:
    x, y = math.fsum(xs) / len(xs), math.fsum(ys) / len(ys)
    return math.fsum((p - x) * (q - y) for p, q in zip(xs, ys, strict=True)) / (len(xs) - 1)


def _quantile(n: int) -> float:
    return float(stdtrit(n - 1, 0.975))
