"""When a run is evaluated."""

from __future__ import annotations

LEAST_SHARE = 0.1
"""Of an interval: less before the end than this, an evaluation would say what the one at the end says."""


class Evaluations:
    """Before the first iteration, every ``interval`` iterations, and at the end.

    The last one before the end is left out if it is less than a tenth of an interval away from it.

    Args:
        interval: iterations, or whatever the recipe counts; 0: never.
        last: iterations of the whole run.

    Attributes:
        count: how many there are in all, with the one before the first iteration.

    Examples:
        >>> [done for done in range(102) if Evaluations(25, 101).due(done)]
        [0, 25, 50, 75, 101]
    """

    def __init__(self, interval: int, last: int) -> None:
        self._interval, self._last = interval, last
        self.count = sum(map(self.due, {*range(0, last, interval), last})) if interval else 0

    def due(self, done: int) -> bool:
        """Whether it is time, after ``done`` iterations."""
        if not self._interval:
            return False
        if done >= self._last:
            return True
        return done % self._interval == 0 and (not done or self._last - done >= LEAST_SHARE * self._interval)
