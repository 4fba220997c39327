"""How far a run is, and how fast it goes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from nfv_torchrl.state_checks import check_keys, check_real, check_whole


@dataclass
class Progress:
    """How far a run is. ``best_*`` belong to the policy kept in ``best.pt``."""

    iteration: int = 0
    frames: int = 0
    updates: int = 0
    best_fitness: float = float("-inf")  # of evolution; other recipes go by AAR and cost
    best_aar: float = -1.0
    best_cost: float = float("inf")
    best_frames: int = 0
    learning_seconds: float = field(default=0.0, repr=False)
    _since: tuple[float, int, int, float, float] = field(default=(0.0, 0, 0, 0.0, 0.0), repr=False)

    def speeds(self, processor: float = 0.0) -> dict[str, float]:
        """Frames/s of training and updates/s of the learner alone, since the last call.

        ``processor``: processor seconds that the training took so far, if they are counted.
        """
        now = (time.perf_counter(), self.frames, self.updates, self.learning_seconds, processor)
        before, self._since = self._since, now
        if before[0] == 0.0:
            return {}
        values = {"speed/frames_per_second": (now[1] - before[1]) / (now[0] - before[0])}
        if now[4] > before[4]:
            values["speed/frames_per_processor_second"] = (now[1] - before[1]) / (now[4] - before[4])
        if now[3] > before[3]:
            values["speed/updates_per_second"] = (now[2] - before[2]) / (now[3] - before[3])
        return values

    def state_dict(self) -> dict[str, Any]:
        """Everything but the clocks."""
        return {key: value for key, value in asdict(self).items() if key not in ("_since", "learning_seconds")}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()``.

        Raises:
            CheckpointError: a number is missing, or is none that counts something.
        """
        own = self.state_dict()
        check_keys("progress", state, own)
        for key, value in own.items():
            if isinstance(value, int):
                check_whole(f"progress.{key}", state[key], 0, 2**62)
            else:
                check_real(f"progress.{key}", state[key], finite=False)
        for key in own:
            setattr(self, key, state[key])
