"""Epsilon as a function of the frames seen: in closed form, so that a resumed run goes on exactly."""

from __future__ import annotations

from nfv_torchrl.settings.values import Count, Share


def multiplicative(
    frames: int, *, start: Share = 1.0, end: Share = 0.1, factor: Share = 0.9, every: Count = 60_000
) -> float:
    """Epsilon times ``factor`` every ``every`` frames, from ``start`` down to ``end`` (the paper: 1, 0.9, 0.1).

    One horizon of the paper's scenario is some 60,000 frames, hence the default: one decay step per iteration.
    """
    return max(end, start * factor ** (frames // every))


def linear(frames: int, *, start: Share = 1.0, end: Share = 0.05, over: Count = 200_000) -> float:
    """Epsilon on a straight line from ``start`` to ``end`` over the first ``over`` frames."""
    return end + (start - end) * max(0.0, 1.0 - frames / over)


def none(frames: int) -> float:
    """Epsilon 0 at all times: for policies that explore by themselves (noisy networks, stochastic policies)."""
    return 0.0
