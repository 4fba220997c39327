"""Aggregates over few runs that one lucky or lost run hardly moves, as in Agarwal et al., "Deep Reinforcement Learning
at the Edge of the Statistical Precipice" (NeurIPS 2021) and its package rliable.

All take ``scores``, float [R, W]: R training runs on W workloads (rliable's tasks). Intervals are theirs, too: the
stratified bootstrap, which draws runs anew for every workload by itself. Here one run plays all workloads, so its
scores go up and down together and these intervals are too narrow; Student's over training runs are the honest ones.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import trim_mean

from nfv_torchrl.evaluation.statistics import CONFIDENCE, Interval

DRAWS = 2000
TRIMMED = 0.25
"""Share of the scores that is left out at either end."""


def interquartile_mean(scores: np.ndarray, confidence: float = CONFIDENCE, seed: int = 0) -> Interval:
    """Mean of the middle half of all R W scores, rounded outwards: floor(R W / 4) are left out at either end.

    Returns:
        It, its bootstrap percentile interval (undefined for one run) and R.

    Example:
        >>> interquartile_mean(np.array([[0.0, 1.0], [2.0, 30.0]])).mean
        1.5
    """
    runs = len(scores)
    mean = float(trim_mean(scores, TRIMMED, axis=None))
    if runs < 2:
        return Interval(mean, math.nan, math.nan, runs)
    drawn = _resampled(np.asarray(scores, np.float64), seed).reshape(DRAWS, -1)
    low, high = np.quantile(trim_mean(drawn, TRIMMED, axis=1), _ends(confidence))
    return Interval(mean, float(low), float(high), runs)


def performance_profile(
    scores: np.ndarray, taus: np.ndarray, confidence: float = CONFIDENCE, seed: int = 0
) -> list[Interval]:
    """For every tau the share of the R W scores above it (rliable's score distribution).

    The higher line is the better method: it has more runs above whatever level is asked for. Intervals are pointwise.

    Args:
        scores: float [R, W].
        taus: levels, float [T].
        confidence: of the intervals.
        seed: of the bootstrap.

    Returns:
        T shares, with their intervals (undefined for one run) and R.
    """
    scores = np.asarray(scores, np.float64)
    shares = (scores[None] > taus[:, None, None]).mean(axis=(1, 2))
    if len(scores) < 2:
        return [Interval(float(share), math.nan, math.nan, len(scores)) for share in shares]
    drawn = np.sort(_resampled(scores, seed).reshape(DRAWS, -1), axis=1)
    above = np.array([1 - np.searchsorted(row, taus, side="right") / drawn.shape[1] for row in drawn])
    low, high = np.quantile(above, _ends(confidence), axis=0)
    points = zip(shares, low, high, strict=True)
    return [Interval(float(share), float(least), float(most), len(scores)) for share, least, most in points]


def _resampled(scores: np.ndarray, seed: int) -> np.ndarray:
    """Float [DRAWS, R, W]: R runs drawn with replacement, for every workload by itself."""
    runs, workloads = scores.shape
    drawn = np.random.default_rng(seed).integers(runs, size=(DRAWS, runs, workloads))
    return np.take_along_axis(scores[None], drawn, axis=1)


def _ends(confidence: float) -> tuple[float, float]:
    return (1 - confidence) / 2, (1 + confidence) / 2
