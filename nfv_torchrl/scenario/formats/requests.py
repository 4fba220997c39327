"""Requests as files of other projects have them, before a scenario says what they are to it."""

from __future__ import annotations

from typing import NamedTuple


class Asked(NamedTuple):
    """One chain that asks for resources; where its first and last function stand is left open.

    Attributes:
        name: what messages call it, with its file.
        time: arrival, s.
        lifetime: s, positive.
        amounts: of each kind of resource by name, one number a function, float [F].
        rates: Mbit/s of each of the F + 1 segments; 0 for the first and the last, which no end asks for.
        tolerable_delay: ms; None: any delay will do.
        processing_delay: ms of each function, float [F].
    """

    name: str
    time: float
    lifetime: float
    amounts: dict[str, tuple[float, ...]]
    rates: tuple[float, ...]
    tolerable_delay: float | None
    processing_delay: tuple[float, ...]


class RequestSet(NamedTuple):
    """All requests of a file or folder, in order of arrival, and what it says that is not used."""

    source: str
    requests: list[Asked]
    unused: tuple[str, ...] = ()
