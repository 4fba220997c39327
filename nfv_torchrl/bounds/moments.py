"""The moments at which the rows of a relaxation hold, and who is still there then."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.workload import Workload


@dataclass(frozen=True, eq=False)
class Moments:
    """T moments of a horizon: its slots, or the arrivals themselves.

    Attributes:
        slots: the slot of each, int64 [T].
        times: s, float64 [T]; None: the beginning of each slot.
        felt: the first moment at which each slot with failures is felt, int64 [E]; T: at none.
        failed: these slots, int64 [E].
    """

    slots: np.ndarray
    times: np.ndarray | None
    felt: np.ndarray
    failed: np.ndarray

    @classmethod
    def of_slots(cls, horizon: int, failures: FailureTimeline) -> Moments:
        """Every slot."""
        return cls._felt(np.arange(horizon), None, failures)

    @classmethod
    def of_arrivals(cls, arrives: np.ndarray, failures: FailureTimeline) -> Moments:
        """The times of arrivals, float64 [R], s. From one to the next nobody comes."""
        times = np.unique(arrives) if arrives.size else np.zeros(1)
        return cls._felt(np.floor(times).astype(np.int64), times, failures)

    @classmethod
    def _felt(cls, slots: np.ndarray, times: np.ndarray | None, failures: FailureTimeline) -> Moments:
        failed = np.unique(failures.slot[~failures.up])
        return cls(slots, times, np.searchsorted(slots, failed), failed)

    @property
    def count(self) -> int:
        """T."""
        return self.slots.size

    def at(self, arrives: np.ndarray) -> np.ndarray:
        """The first moment that is not before each of some times or slots, [R]; T: there is none."""
        return np.searchsorted(self.slots if self.times is None else self.times, arrives)

    def until(self, start: np.ndarray, departure: np.ndarray) -> np.ndarray:
        """First moment without each request, int64 [R], that came at ``start`` and has left at ``departure``.

        A failure may interrupt anyone, so nobody is counted on from the first failure after the arrival.
        """
        following = np.searchsorted(self.failed, self.slots[start], side="right")
        return np.minimum(departure, np.minimum(np.r_[self.felt, self.count][following], self.count))

    def keeping(self, means: np.ndarray) -> np.ndarray:
        """Share of those with each of M mean lifetimes (s) that stay from the moment before, float64 [M, T]."""
        if self.times is None:
            keep = np.repeat([[math.exp(-1.0 / mean)] for mean in means.tolist()], self.count, axis=1)
        else:
            keep = np.exp(-np.diff(self.times, prepend=self.times[0]) / means[:, None])
        keep[:, self.felt[self.felt < self.count]] = 0.0
        return keep


def surely_there(workload: Workload) -> np.ndarray:
    """First slot through whose end each request need not stay, int64 [R].

    Where requests leave within slots, one counts in the slots at whose end it is still there: all of these are there
    together, while two that are there in the same slot need not have met.
    """
    if workload.time is None:
        return workload.departure
    return np.minimum(np.floor(workload.leaves), workload.departure).astype(np.int64)
