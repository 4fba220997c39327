"""What the audit of a run, or of a whole evaluation, found."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import AuditError


@dataclass
class AuditReport:
    """What the audit of one folder found: ``problems`` in words, empty if all is well, and what was recomputed.

    Attributes:
        folder: the run, or the evaluation.
        problems: in the order found.
        metrics: the metrics anew, empty where nothing could be recomputed.
        requests: rows of the workload.
        costs: $ of each request, NaN where it was rejected or came in the warm-up.
        scenario: scenario.json as read, empty if it could not be.
        stated: metrics.json as read.
        world: what all methods meet alike under one seed: scenario.json in part, SHA-256 of the other files.
    """

    folder: Path
    problems: list[str]
    metrics: dict[str, float | None] = field(default_factory=dict)
    requests: int = 0
    costs: array[float] = field(default_factory=lambda: array("d"))
    scenario: dict[str, Any] = field(default_factory=dict)
    stated: dict[str, Any] = field(default_factory=dict)
    world: dict[str, Any] = field(default_factory=dict)

    @property
    def clean(self) -> bool:
        return not self.problems

    def raise_if_problems(self) -> None:
        """Do nothing if all is well.

        Raises:
            AuditError: there are problems; the message lists them.
        """
        if self.problems:
            raise AuditError("\n  ".join([f"{self.folder}: the audit found", *self.problems]))
