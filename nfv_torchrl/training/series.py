"""Series that never change say nothing: they are kept back until they do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from nfv_torchrl.state_checks import check_keys, check_real, check_whole, refuse

Point = tuple[int, float]
"""Frame and value."""


class ChangingSeries:
    """Which points of scalar series to write, so that none is written that is constant.

    A series is kept back as long as all of its values are the same. With the first other value its first point, the
    last one of that value and the new one are written: the line is that of all points.

    Args:
        always: whether the series of a tag is to be written though it may be constant.
    """

    def __init__(self, always: Callable[[str], bool] = lambda tag: False) -> None:
        self.always = always
        self._changed: set[str] = set()
        self._kept: dict[str, tuple[int, float, int]] = {}  # first frame, value, last frame

    def points(self, tag: str, frame: int, value: float) -> Iterator[Point]:
        """The points to write now that the series ``tag`` has a new one."""
        if tag in self._changed or self.always(tag):
            yield frame, value
            return
        first, before, last = self._kept.get(tag, (frame, value, frame))
        if before == value or (math.isnan(before) and math.isnan(value)):
            self._kept[tag] = (first, before, frame)
            return
        del self._kept[tag]
        self._changed.add(tag)
        yield first, before
        if last != first:
            yield last, before
        yield frame, value

    def constants(self) -> dict[str, float]:
        """The series kept back so far, with their value."""
        return {tag: value for tag, (_, value, _) in sorted(self._kept.items())}

    def state_dict(self) -> dict[str, Any]:
        """What was written and what is kept back."""
        return {"changed": sorted(self._changed), "kept": {tag: list(point) for tag, point in self._kept.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()``.

        Raises:
            CheckpointError: it is none.
        """
        check_keys("logged", state, ("changed", "kept"))
        changed, kept = state["changed"], state["kept"]
        if not isinstance(changed, list | tuple) or not isinstance(kept, Mapping):
            refuse("logged", "is no list of series")
        for tag in (*changed, *kept):
            if not isinstance(tag, str):
                refuse("logged", f"names a series {tag!r:.60}")
        for tag, point in kept.items():
            if not isinstance(point, list | tuple) or len(point) != 3:
                refuse(f"logged.kept.{tag}", "is no point of a series")
            check_whole(f"logged.kept.{tag}", point[0], 0, 2**62)
            check_real(f"logged.kept.{tag}", point[1], finite=False)
            check_whole(f"logged.kept.{tag}", point[2], 0, 2**62)
        self._changed, self._kept = set(changed), {tag: tuple(point) for tag, point in kept.items()}
