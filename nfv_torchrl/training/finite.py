"""Numbers that are not finite end a run, before they reach a checkpoint or ``best.pt``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from nfv_torchrl.errors import TrainingError

KEPT = "the last checkpoint and best.pt are from before"


def check_learning(learning: Mapping[str, Any], progress: Any) -> None:
    """Check the losses and gradient norm of an iteration's last update; earlier faults show there, too.

    Raises:
        TrainingError: one of them is not finite.
    """
    for name, value in learning.items():
        if name.startswith(("loss", "gradient_norm")) and not math.isfinite(value):
            raise TrainingError(
                f"learner.lr: {name} is {float(value)} at update {progress.updates}, frame {progress.frames}; try a "
                f"smaller learner.lr, or learner.max_grad_norm=10 if it is null ({KEPT})"
            )


def check_weights(module: nn.Module, name: str, progress: Any) -> None:
    """Refuse weights that are not finite before they are written or evaluated.

    Raises:
        TrainingError: a weight of ``module`` is not.
    """
    for key, value in module.named_parameters():
        if not torch.isfinite(value).all():
            raise TrainingError(
                f"learner.lr: weights of {name} ({key}) are not finite at update {progress.updates}, frame "
                f"{progress.frames}; try a smaller learner.lr ({KEPT})"
            )


def check_fitness(fitness: Sequence[float], generation: int) -> None:
    """The fitness of every candidate of a generation.

    Raises:
        TrainingError: one is not finite.
    """
    for number, value in enumerate(fitness):
        if not math.isfinite(value):
            raise TrainingError(
                f"fitness: candidate {number} of generation {generation} has fitness {value}; check fitness and the "
                f"costs of the scenario, or try a smaller strategy.sigma ({KEPT})"
            )
