"""How much processor time a training took so far, with what is no training left out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from numba.core.event import Event, Listener, register, unregister

from nfv_torchrl.state_checks import check_keys, check_real

COMPILING = "numba:compiler_lock"
"""Numba's name for the time in which it compiles a function, or reads from disk what it compiled before."""


class TrainingClock(Listener):
    """Processor time (s) of all threads of this process between ``start`` and ``stop``, added up.

    It stands still while Numba compiles or reads compiled code. So of a training, which stops it for evaluations, it
    counts collecting, learning, log lines and checkpoints. Other processes do not count, such as those of collectors
    with workers.

    Examples:
        >>> clock = TrainingClock()
        >>> clock.start()
        >>> clock.stop()  # for an evaluation
        >>> clock.start()
    """

    def __init__(self) -> None:
        self._before = 0.0
        self._since: float | None = None  # None: it stands still
        self._started, self._compiling = False, 0

    @property
    def seconds(self) -> float:
        """Until now."""
        return self._before + (0.0 if self._since is None else time.process_time() - self._since)

    def start(self) -> None:
        """From now on it runs, if it does not already."""
        if not self._started:
            register(COMPILING, self)
            self._started, self._since = True, time.process_time()

    def stop(self) -> None:
        """It stands still, if it does not already."""
        if self._started:
            unregister(COMPILING, self)
            self._hold()
            self._started = False

    def on_start(self, event: Event) -> None:
        """Numba begins to compile, perhaps one function within another."""
        self._hold()
        self._compiling += 1

    def on_end(self, event: Event) -> None:
        """Numba has compiled."""
        self._compiling -= 1
        if not self._compiling:
            self._since = time.process_time()

    def _hold(self) -> None:
        self._before, self._since = self.seconds, None

    def state_dict(self) -> dict[str, float]:
        """The seconds until now."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()``.

        Raises:
            CheckpointError: it is none.
        """
        check_keys("clock", state, ("seconds",))
        self._before = float(check_real("clock.seconds", state["seconds"]))
