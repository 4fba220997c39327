"""Whether ``checkpoint`` is given where a method reads it, and only there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from nfv_torchrl.errors import ScenarioError


def check_checkpoint(checkpoint: str | None, method: Mapping[str, Any]) -> None:
    """``method=checkpoint`` needs ``checkpoint=PATH``, and the other way round.

    Raises:
        ScenarioError: one is there without the other.
    """
    if checkpoint is None and "checkpoint" in method:
        raise ScenarioError("checkpoint: is null; method=checkpoint needs a file, such as checkpoint=runs/dqn/best.pt")
    check_is_read(checkpoint, method)


def check_is_read(checkpoint: str | Sequence[str] | None, method: Mapping[str, Any]) -> None:
    """``checkpoint=PATH``, or ``checkpoints=[...]``, needs ``method=checkpoint``.

    Raises:
        ScenarioError: no method would read the files.
    """
    if checkpoint is not None and "checkpoint" not in method:
        named = checkpoint if isinstance(checkpoint, str) else ", ".join(checkpoint)
        raise ScenarioError(f"checkpoint: {named} would not be read; add it to the methods: method=[greedy,checkpoint]")
