"""Places of nodes that a file gives as x and y, without saying whether these are degrees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Place = tuple[float, float]


def place_nodes(
    places: Sequence[Place | None], geographical: bool | None = None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Attributes of nodes at ``places`` (x, y), and what to say about them.

    They are longitude and latitude if ``geographical`` says so, or if that is None and all fit. A node at (0, 0), where
    files put what they do not know, has no place; nor has any if all are at one.
    """
    known = [place if place and any(place) else None for place in places]
    there = {place for place in known if place is not None}
    if not there:
        return [{} for _ in places], []
    if len(there) == 1 and len(places) > 1:
        return _plane(places), ["x and y are the same for all nodes, so they are no places"]
    fit = all(-180 <= x <= 180 and -90 <= y <= 90 for x, y in there)
    if geographical is False or not fit:
        return _plane(places), ["x and y are no degrees"]
    nodes = [{} if place is None else {"longitude": place[0], "latitude": place[1]} for place in known]
    return nodes, [] if geographical else ["x and y are taken for longitude and latitude"]


def _plane(places: Sequence[Place | None]) -> list[dict[str, Any]]:
    """Attributes that no quantity is read from, so that the warning names them."""
    return [{} if place is None else {"x": place[0], "y": place[1]} for place in places]
