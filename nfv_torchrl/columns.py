"""Columns of an array by name: numbers to kernels, names to people, written down once."""

from __future__ import annotations

from typing import Any, TypeVar

Names = TypeVar("Names", bound=tuple[Any, ...])


def columns(names: type[Names]) -> Names:
    """The ``NamedTuple`` class ``names`` with its fields numbered 0, 1, 2, ...

    A kernel takes ``columns(Names).some_field`` for a constant; the names are ``columns(Names)._fields``.
    """
    return names(*range(len(names._fields)))  # type: ignore[attr-defined]
