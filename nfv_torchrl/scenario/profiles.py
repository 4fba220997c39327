"""Profiles: what a request asks of VMs and links, as arrays. A catalogue's services are profiles; files may bring more.

P profiles of chains of at most F functions (F at least 1) on VMs of R kinds of resources.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.units import LEDGER_UNITS, MAX_CAPACITY

MOST_FUNCTIONS = 1000
LONGEST_DELAY = 1e30
"""ms."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """Read-only arrays; entries past a chain's end are 0.

    Attributes:
        service: type that a request of the profile counts as, int64 [P].
        chain_length: functions, int64 [P]; 0: the request is only routed.
        amount: what each function takes of each kind, float64 [P, F, R].
        work: Mcycles/s that set the processing delay of a function, 1000 work / speed of the VM, float64 [P, F].
        fixed_delay: processing delay beside it, ms, float64 [P, F].
        rate: data rate of each segment, Mbit/s, float64 [P, F + 1]: segment i leads from function i - 1 (or the
            ingress) to function i (or the egress).
        tolerable_delay: ms, float64 [P], infinite where any delay will do.

    Raises:
        ScenarioError: shapes that do not fit, or a number out of range.
    """

    service: np.ndarray
    chain_length: np.ndarray
    amount: np.ndarray
    work: np.ndarray
    fixed_delay: np.ndarray
    rate: np.ndarray
    tolerable_delay: np.ndarray

    def __post_init__(self) -> None:
        for field in fields(self):
            kind = np.int64 if field.name in ("service", "chain_length") else np.float64
            array = np.array(getattr(self, field.name), kind)
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)
        count, functions, kinds = self.amount.shape if self.amount.ndim == 3 else (0, 0, 0)
        shapes = {"service": (count,), "chain_length": (count,), "work": (count, functions)}
        shapes |= {"fixed_delay": (count, functions), "rate": (count, functions + 1), "tolerable_delay": (count,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape or not (functions and kinds):
                raise ScenarioError(f"profiles: {name} has shape {list(getattr(self, name).shape)}; see Profiles")
        if count and not 0 <= self.chain_length.min() <= self.chain_length.max() <= functions <= MOST_FUNCTIONS:
            raise ScenarioError(f"profiles: chains have 0 to {MOST_FUNCTIONS} functions")
        for name in ("amount", "work", "rate"):
            values = getattr(self, name)
            small = (values > 0) & (values < 1 / LEDGER_UNITS)
            if not np.all((values >= 0) & (values <= MAX_CAPACITY)) or small.any():
                raise ScenarioError(f"profiles: {name} holds a number that is neither 0 nor from 1e-6 to 1e9")
        if not (np.all(self.fixed_delay >= 0) and np.all(self.fixed_delay <= LONGEST_DELAY)):
            raise ScenarioError("profiles: a processing delay is negative or too large; use 0 to 1e30 ms")
        if not np.all(self.tolerable_delay > 0):
            raise ScenarioError("profiles: a tolerable delay is not positive; leave it out where any delay will do")

    def __len__(self) -> int:
        return len(self.service)

    def same_as(self, other: Profiles) -> bool:
        """Whether all numbers are the same."""
        pairs = [(getattr(self, field.name), getattr(other, field.name)) for field in fields(Profiles)]
        return self is other or all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    @property
    def kinds(self) -> int:
        """R."""
        return self.amount.shape[2]

    @property
    def total(self) -> np.ndarray:
        """What a whole chain takes of each kind, float64 [P, R]."""
        return self.amount.sum(axis=1)

    @property
    def least_rates(self) -> int:
        """How many different least rates of a segment there may be among profiles with a delay limit; at least 1."""
        segments = np.arange(self.rate.shape[1]) <= self.chain_length[:, None]
        least = np.where(segments, self.rate, np.inf).min(axis=1)
        return max(len(np.unique(least[np.isfinite(self.tolerable_delay)])), 1)

    def asks_for_nothing(self) -> bool:
        """Whether some function takes nothing of any kind, or some segment that may be used carries nothing."""
        placed = np.arange(self.amount.shape[1]) < self.chain_length[:, None]
        segments = np.arange(self.rate.shape[1]) <= self.chain_length[:, None]
        return bool((placed & (self.amount.sum(axis=2) == 0)).any() or (segments & (self.rate == 0)).any())


def join_profiles(parts: Sequence[Profiles]) -> Profiles:
    """All profiles one after the other, padded to the longest chain.

    Raises:
        ScenarioError: they have different numbers of kinds.
    """
    if len({part.kinds for part in parts}) != 1:
        raise ScenarioError("profiles: some ask for other kinds of resources than others; see scenario.resources")
    functions = max(part.amount.shape[1] for part in parts)

    def padded(array: np.ndarray, width: int) -> np.ndarray:
        pad = [(0, 0)] * array.ndim
        pad[1] = (0, width - array.shape[1])
        return np.pad(array, pad)

    widths = {"amount": functions, "work": functions, "fixed_delay": functions, "rate": functions + 1}
    return Profiles(
        **{
            field.name: np.concatenate(
                [
                    padded(getattr(part, field.name), widths[field.name])
                    if field.name in widths
                    else getattr(part, field.name)
                    for part in parts
                ]
            )
            for field in fields(Profiles)
        }
    )
