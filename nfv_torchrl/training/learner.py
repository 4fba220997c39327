"""The step that every learner takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from nfv_torchrl.losses import has_target


class NoUpdater:
    """In place of a target updater, for a loss without target networks."""

    def step(self) -> None:
        """Nothing to move."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing to save."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing to load."""


def target_updater(config: DictConfig, loss: LossModule) -> TargetNetUpdater | NoUpdater:
    """What ``config`` makes for ``loss``, if it has a target network."""
    return instantiate(config)(loss) if has_target(loss) else NoUpdater()


def gradient_step(
    loss: Callable[[TensorDictBase], TensorDictBase],
    optimizer: torch.optim.Optimizer,
    batch: TensorDictBase,
    max_grad_norm: float | None = None,
) -> TensorDictBase:
    """Learn from one batch, without waiting for the numbers.

    Args:
        loss: a ``RequestLoss``; what it returns under names that begin with ``loss`` is summed and minimised.
        optimizer: of the loss's parameters.
        batch: rows of ``prepare``, [R].
        max_grad_norm: clip the norm of the gradient to this; None: do not clip.

    Returns:
        What the loss says, all [], with ``loss``, the sum, and ``gradient_norm``, before clipping.
    """
    values = loss(batch)
    total = sum(value for key, value in values.items() if key.startswith("loss"))
    optimizer.zero_grad()
    total.backward()
    parameters = [weights for group in optimizer.param_groups for weights in group["params"]]
    norm = nn.utils.clip_grad_norm_(parameters, max_grad_norm or float("inf"))
    optimizer.step()
    return values.detach().update({"loss": total.detach(), "gradient_norm": norm.detach()})


class Rate(Protocol):
    """The learning rate of a recipe: ``lr``, and ``lr_end``, what it falls to (null: it stays)."""

    lr: float
    lr_end: float | None


@contextmanager
def falling_rate(optimizer: torch.optim.Optimizer, learner: Rate, done: float) -> Iterator[None]:
    """Let ``optimizer`` learn at a rate on the straight line from ``lr`` to ``lr_end``, if there is one.

    ``done``: the share of the run that is done. In closed form, so that a resumed run goes on exactly; a checkpoint
    has the rate that the run was started with.
    """
    rate = learner.lr
    if learner.lr_end is not None:
        rate += (learner.lr_end - learner.lr) * min(done, 1.0)
    for group in optimizer.param_groups:
        group["lr"] = rate
    yield
    for group in optimizer.param_groups:
        group["lr"] = learner.lr
