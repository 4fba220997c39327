"""How far a command is: a bar on a terminal, and elsewhere a plain line now and then that a log file can hold."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import weakref
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar, TextIO

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 10.0
SECONDS_BETWEEN_REDRAWINGS = 1.0  # on a terminal, while a unit is at work
BAR = "{desc}{percentage:3.0f}%|{bar:16}| {n_fmt}/{total_fmt} {unit}s, {elapsed} gone, {eta} left, {pace}{postfix}"
LINE = "{desc}{percentage:3.0f}%, {n_fmt} of {total_fmt} {unit}s, {elapsed} gone, {eta} left, {pace}{postfix}"
WITHOUT_TOTAL = "{desc}{n_fmt} {unit}s, {elapsed} gone, {pace}{postfix}"


class ProgressBar(tqdm):
    """A ``tqdm`` whose time left is not thrown off by pauses, and that writes whole lines where there is no terminal.

    On a terminal it redraws one line. Elsewhere it writes a line every ten seconds, also while one unit takes longer
    than that. The first comes after ten seconds, so that short work leaves none. Evaluations of a training belong into
    ``pause``: they count neither for the pace nor for the time that the rest takes, but those still to come are added
    to the time left, as long as the last one.

    Args:
        items: what to go through; None: call ``update``.
        total: number of ``unit``; needed for a percentage. ``len(items)`` if not given.
        initial: how many are done already.
        unit: what is counted, in the singular.
        desc: what is going on.
        pauses: how many pauses there will be, as far as known.
        file: where to write; standard error if not given.

    Example:
        >>> bar = ProgressBar(total=600_000, unit="frame", desc="dqn", pauses=13)
        >>> bar.update(1_024)
        >>> with bar.pause():
        ...     pass  # an evaluation
        >>> bar.close()
    """

    def __init__(
        self,
        items: Iterable[Any] | None = None,
        *,
        total: int | None = None,
        initial: int = 0,
        unit: str,
        desc: str | None = None,
        pauses: int = 0,
        file: TextIO | None = None,
    ) -> None:
        stream = sys.stderr if file is None else file
        terminal = stream.isatty()
        if total is None and hasattr(items, "__len__"):
            total = len(items)  # type: ignore[arg-type]
        self._pauses = pauses
        self._paused = 0.0  # s
        self._paused_times = 0
        self._last_pause = 0.0  # s; the first may have more to do than all others
        self._first: tuple[float, int] | None = None
        super().__init__(
            items,
            desc=f"{desc}: " if desc else None,
            total=total,
            initial=initial if total is None else min(initial, total),
            unit=unit,
            unit_scale=total is None or total >= 10_000,
            bar_format=WITHOUT_TOTAL if not total else BAR if terminal else LINE,
            file=stream if terminal else _Lines(stream),
            mininterval=0.5 if terminal else SECONDS_BETWEEN_LINES,
            delay=0 if terminal else SECONDS_BETWEEN_LINES,
            miniters=1,
            dynamic_ncols=terminal,
            position=None if terminal else 0,  # a bar within another would move up and down between lines
        )
        self._ticker = _Ticker(self, SECONDS_BETWEEN_REDRAWINGS if terminal else SECONDS_BETWEEN_LINES)

    def __iter__(self) -> Iterator[Any]:
        # That of tqdm looks at the clock itself and knows nothing of the first unit, see `update`.
        try:
            for item in self.iterable:
                yield item
                self.update()
        finally:
            self.close()

    def update(self, n: float | None = 1) -> bool | None:
        """``n`` more are done. More than ``total`` are not shown: batches need not divide it."""
        if n and self.total:
            n = min(n, self.total - self.n)
        if n and self._first is None:  # the first batch compiles, so the pace counts from its end
            self._first = (self._work_seconds(), self.n + n)
        return super().update(n)

    def say(self, words: str) -> None:
        """``words`` stand at the end of the line until there are others."""
        self.set_postfix_str(words, refresh=False)

    def reach(self, done: int) -> None:
        """``done`` are done in all."""
        self.update(done - self.n)

    @contextlib.contextmanager
    def pause(self) -> Iterator[None]:
        """Other work, such as an evaluation."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._last_pause = time.perf_counter() - begun
            self._paused += self._last_pause
            self._paused_times += 1

    def close(self) -> None:
        """The last line; nothing is written after it."""
        self._ticker.stop()
        super().close()

    def show_again(self) -> None:
        """Write the line though nothing has moved, if it is time for one and no bar within this one speaks for it."""
        now: float = self._time()
        if now - self.last_print_t >= self.mininterval and self._ticker.innermost:
            self.last_print_t: float = now
            self.refresh()

    def _work_seconds(self) -> float:
        return time.perf_counter() - self._paused

    def _pace(self) -> float:
        """Units per second of work, without pauses and the first unit; 0 as long as it is unknown."""
        if self._first is None:
            return 0.0
        seconds, done = self._work_seconds() - self._first[0], self.n - self._first[1]
        return done / seconds if done > 0 and seconds > 0 else 0.0

    def _seconds_left(self) -> float | None:
        pace = self._pace()
        if not self.total or not pace:
            return None
        to_come = max(self._pauses - self._paused_times, 0)
        return (self.total - self.n) / pace + to_come * self._last_pause

    @property
    def format_dict(self) -> dict[str, Any]:
        """What a line is made of; see tqdm."""
        left, pace = self._seconds_left(), self._pace()
        done = bool(self.total) and self.n >= self.total
        # Slow work is told by the unit: 0.02 cells/s says nothing to anyone.
        slow = 0 < pace < 1
        told = f"{1 / pace:.1f} s/{self.unit}" if slow else f"{self.format_sizeof(pace)} {self.unit}s/s"
        return {
            **super().format_dict,
            "eta": "nothing" if done else "?" if left is None else self.format_interval(left),
            "pace": told if pace else f"? {self.unit}s/s",
        }


class _Ticker:
    """Lets a bar show itself now and then: whoever reads the line cannot tell a unit of minutes from a hang."""

    _open: ClassVar[list[_Ticker]] = []

    def __init__(self, bar: ProgressBar, seconds: float) -> None:
        self._bar = weakref.ref(bar)  # a bar that nobody closes is still closed when it is collected
        self._seconds = seconds
        self._stopped = threading.Event()
        self._showing = threading.RLock()  # again by this thread, where it collects the bar
        self._open.append(self)
        threading.Thread(target=self._run, name="progress bar", daemon=True).start()

    @property
    def innermost(self) -> bool:
        """Whether no bar was opened later and is still open."""
        return self._open[-1] is self

    def stop(self) -> None:
        with self._showing:
            self._stopped.set()
        with contextlib.suppress(ValueError):  # it was stopped before
            self._open.remove(self)

    def _run(self) -> None:
        while not self._stopped.wait(self._seconds):
            with self._showing:
                bar = self._bar()
                if bar is not None and not self._stopped.is_set():
                    bar.show_again()
                del bar  # not kept alive while waiting


class _Lines:
    """A stream that ends a line where tqdm would go back to its beginning."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        line = text.strip("\r\n ")
        return self._stream.write(f"{line}\n") if line else 0

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return False
