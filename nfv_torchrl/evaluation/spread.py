"""An evaluation in pieces that do not depend on each other, for parallel workers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from nfv_torchrl.evaluation.bounds import aar_bounds
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import Method, PlannerMethod, RandomMethod, methods_from_config
from nfv_torchrl.scenario.scenario import Scenario


class Piece(NamedTuple):
    """A method, by its settings, on some of the seeds: all on one scenario, or each on its own."""

    method: Mapping[str, Any]
    scenarios: Sequence[Scenario]
    seeds: Sequence[int]


def pieces(
    entry: Mapping[str, Any], method: Method, scenarios: Sequence[Scenario], seeds: Sequence[int]
) -> list[Piece]:
    """The runs of one method, seed by seed if its decisions under a seed cannot depend on the other seeds.

    A network answers all seeds together: the last bit of a score may depend on how many there are, and the pieces shall
    be the same for any number of workers.

    Args:
        entry: settings of the method, as ``methods_from_config`` takes them, for it alone.
        method: what they make.
        scenarios: one for all seeds, or one for each.
        seeds: workload seeds.
    """
    if not _apart(method):
        return [Piece(entry, scenarios, seeds)]
    worlds = list(scenarios) * len(seeds) if len(scenarios) == 1 else scenarios
    return [Piece(entry, [world], [seed]) for world, seed in zip(worlds, seeds, strict=True)]


def run_piece(piece: Piece) -> list[RunRecord]:
    """The records of one piece, in the order of its seeds."""
    (method,) = methods_from_config(piece.method, piece.scenarios)
    return run_method(piece.scenarios, method, piece.seeds)


def bounds_of(run: tuple[Scenario, int]) -> dict[str, float]:
    """Upper bounds on the AAR of one workload."""
    return aar_bounds(*run)


def _apart(method: Method) -> bool:
    if isinstance(method, PlannerMethod):
        return getattr(method.planner, "actor", None) is None
    return isinstance(method, RandomMethod)
