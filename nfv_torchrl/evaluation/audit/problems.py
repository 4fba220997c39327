"""The list of problems an audit finds, kept to a length one can read."""

from __future__ import annotations

MOST_SHOWN = 50
"""One mistake early in a run can make every later line wrong; the rest is counted, not listed."""

LONGEST = 400
"""Characters of a problem: files may hold anything, and messages quote them."""


class UnreadableRun(Exception):
    """A file is missing or so broken that nothing can be recomputed from it."""


class Problems:
    """Collects problems in the order found; past ``MOST_SHOWN`` it only counts them."""

    def __init__(self) -> None:
        self._shown: list[str] = []
        self._found = 0

    def add(self, text: str) -> None:
        self._found += 1
        if len(self._shown) < MOST_SHOWN:
            self._shown.append(text if len(text) <= LONGEST else f"{text[:LONGEST]}...")

    def texts(self) -> list[str]:
        """What was found, and how many more there are."""
        hidden = self._found - len(self._shown)
        return [*self._shown, f"and {hidden} more problems"] if hidden else list(self._shown)
