"""The figures by name."""

from __future__ import annotations

from collections.abc import Sequence

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.experiments.cost_weight import CostWeight
from nfv_torchrl.experiments.decision_time import DecisionTime
from nfv_torchrl.experiments.drawing import Experiment
from nfv_torchrl.experiments.learning_curves import LearningCurves
from nfv_torchrl.experiments.presence import PresenceProbability
from nfv_torchrl.experiments.sweeps import Sweep
from nfv_torchrl.experiments.walk_length import RewardAndWalkLength

RATE, LIFETIME, NODES = "mean arrivals λ (requests/s)", "mean lifetime μ (s)", "nodes N"

FIGURES: dict[str, Experiment] = {
    "aar_over_iterations": LearningCurves("aar"),
    "anuc_over_iterations": LearningCurves("anuc"),
    "anuc_vs_requests": Sweep("anuc", "arrival_rate", "arrival_rates", RATE),
    "aar_vs_requests": Sweep("aar", "arrival_rate", "arrival_rates", RATE),
    "aar_vs_cost_weight": CostWeight("aar"),
    "anuc_vs_cost_weight": CostWeight("anuc"),
    "presence_probability": PresenceProbability(),
    "aar_vs_lifetime": Sweep("aar", "mean_lifetime", "mean_lifetimes", LIFETIME),
    "aar_vs_nodes": Sweep("aar", "nodes", "nodes", NODES, at="nodes_at"),
    "anuc_vs_nodes": Sweep("anuc", "nodes", "nodes", NODES, at="nodes_at"),
    "decision_time_vs_nodes": DecisionTime(),
    "reward_and_walk_length": RewardAndWalkLength(),
}


def chosen(names: str | Sequence[str]) -> dict[str, Experiment]:
    """The figures of one name, a list of names, or ``all``.

    Raises:
        ScenarioError: no such figure.
    """
    wanted = [names] if isinstance(names, str) else list(names)
    if wanted == ["all"]:
        return dict(FIGURES)
    for name in wanted:
        if name not in FIGURES:
            raise ScenarioError(f"figure: {name!r} is unknown; use all or some of {', '.join(FIGURES)}")
    if not wanted:
        raise ScenarioError("figure: names none; use all or a name")
    return {name: FIGURES[name] for name in wanted}
