"""Pieces of files in messages: short, on one line, printable."""

from __future__ import annotations

import reprlib
from typing import Any

LONGEST = 200
"""Characters of a text that a message quotes."""

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 60


def shown(value: Any) -> str:
    """``value`` for a message: its repr, shortened."""
    return _short.repr(value)


def one_line(text: str) -> str:
    """``text`` for a message: blanks and line breaks joined, what cannot be printed escaped, shortened."""
    words = " ".join(text[: 2 * LONGEST].split())[:LONGEST]
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in words)
