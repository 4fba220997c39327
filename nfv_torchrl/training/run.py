"""One training run: its folder, its progress and its evaluations on held-out workloads."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import nn

from nfv_torchrl import __version__
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.methods import Method
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.network_figure import draw_utilisation
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.files import write_atomically
from nfv_torchrl.networks import Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.settings.values import list_of_seeds
from nfv_torchrl.training.acting import acting_method
from nfv_torchrl.training.checking import check_parts, load_part
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.logger import RunLogger
from nfv_torchrl.training.policies import policy_content, q_network, save_policy
from nfv_torchrl.training.setup import set_aside

MAY_CHANGE = ("resume", "run_dir", "device", "logger", "checkpoint", "generations")
"""Config keys that a resumed run may set anew; so may ``collector.total_frames``."""


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
    _since: tuple[float, int, int, float] = field(default=(0.0, 0, 0, 0.0), repr=False)

    def speeds(self) -> dict[str, float]:
        """Frames/s of training and updates/s of the learner alone, since the last call."""
        now = (time.perf_counter(), self.frames, self.updates, self.learning_seconds)
        before, self._since = self._since, now
        if before[0] == 0.0:
            return {}
        values = {"speed/frames_per_second": (now[1] - before[1]) / (now[0] - before[0])}
        if now[3] > before[3]:
            values["speed/updates_per_second"] = (now[2] - before[2]) / (now[3] - before[3])
        return values

    def state_dict(self) -> dict[str, Any]:
        """Everything but the clocks."""
        return {key: value for key, value in asdict(self).items() if key not in ("_since", "learning_seconds")}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()``."""
        names = {f.name for f in fields(self)}
        for key, value in state.items():
            if key in names:
                setattr(self, key, value)


class RunFolder:
    """The folder of a run: ``config.yaml``, ``checkpoint_*.pt``, ``best.pt`` and TensorBoard's event files.

    Args:
        path: the folder.
        config: the resolved config of the run.
        resume: go on in it; otherwise an older run there is renamed.
        keep: how many checkpoints stay.

    Raises:
        CheckpointError: nothing to resume, or the config is not the one the run was started with.
    """

    def __init__(self, path: Path, config: dict[str, Any], *, resume: bool, keep: int) -> None:
        self.path = path
        self.config = config
        self.resume = resume
        self.checkpoints = CheckpointFolder(path, keep)
        if resume:
            if not self.checkpoints.files():
                raise CheckpointError(f"{path} holds no checkpoint to resume from; start without resume=true")
            return
        older = set_aside(path)
        if older is not None:
            print(f"An older run was at {path}; it is now at {older}.")
        write_atomically(path / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(config)))

    def save(self, state: Mapping[str, Any], frames: int) -> None:
        """Write a checkpoint of every part of ``state``."""
        content = {name: _plain(part.state_dict()) for name, part in state.items()}
        content["config"] = self.config
        content["versions"] = {"nfv_torchrl": __version__, "torch": str(torch.__version__)}
        self.checkpoints.save(frames, content)

    def load(self, state: Mapping[str, Any]) -> None:
        """When resuming, bring every part of ``state`` to the newest whole checkpoint."""
        if not self.resume:
            return
        path, content = self.checkpoints.load_newest()
        config = content.get("config")
        if not isinstance(config, Mapping):
            raise CheckpointError(f"{path} lacks 'config'; it is no checkpoint of a run, use another one")
        changed = sorted(_differences(config, self.config))
        if changed:
            raise CheckpointError(
                f"{path} was written with another config ({', '.join(changed)} differ); resume with the settings of "
                f"{self.path / 'config.yaml'}, or start a new run in another run_dir"
            )
        check_parts(path, content, state)
        for name, part in state.items():
            load_part(path, name, part, content[name])
        self._random_numbers = content["rng"]
        print(f"Resumed from {path}.")

    def load_random_numbers(self, state: Mapping[str, Any]) -> None:
        """When resuming, set the random numbers of ``state["rng"]`` once more, as the last step before the loop."""
        if self.resume:
            state["rng"].load_state_dict(self._random_numbers)

    def print_ending(self, *, interrupted: bool) -> None:
        """Say where things are and how to go on."""
        if interrupted:
            print(f"\nStopped and saved. Go on with the same command and: run_dir={self.path} resume=true")
        best = self.path / "best.pt"
        if best.exists():
            print(f"Best policy: {best}")
        print(f"TensorBoard: tensorboard --logdir {self.path}")


def evaluate_policy(
    loss: Any,
    scenario: Scenario,
    sizes: Sizes,
    config: Mapping[str, Any],
    folder: RunFolder,
    logger: RunLogger,
    progress: Progress,
    method: Method | None = None,
) -> None:
    """Act greedily on held-out workloads, log what came of it, and keep the policy if it is the best so far.

    ``method`` says how the loss's actor acts: by default step by step, as ``acting_method`` has it.

    Best means the highest AAR; among equals the lowest cost per accepted request.
    """
    actor = loss.actor
    device = next(actor.parameters()).device
    actor.eval()  # noisy networks act by their mean weights
    actor.to("cpu")
    method = method or acting_method(actor, q_network(loss), one_hot=config["one_hot"])
    records = run_method(scenario, method, list_of_seeds("eval.seeds", config["eval"]["seeds"]))
    actor.to(device)
    actor.train()
    runs = [compute_metrics(record) for record in records]
    scores = {key: sum(run[key] for run in runs) / len(runs) for key in runs[0]}
    logger.scalars({f"eval/{key}": value for key, value in scores.items() if value == value}, progress.frames)
    if config["logger"]["figures"]:
        logger.figure("network/utilisation", draw_utilisation(records[0]), progress.frames)
    aar, cost = scores["aar"], scores["cost_per_accepted"]
    if (aar, -cost) > (progress.best_aar, -progress.best_cost):
        progress.best_aar, progress.best_cost, progress.best_frames = aar, cost, progress.frames
        content = policy_content(loss, sizes, config, scenario, {"aar": aar, "cost_per_accepted": cost})
        save_policy(folder.path / "best.pt", content)


def _plain(value: Any) -> Any:
    """State dicts as plain dicts, lists, numbers and tensors, so that they load without pickle."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list) and not isinstance(value, torch.Size):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, nn.Parameter):
        return value.detach()
    return value


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> set[str]:
    """Keys whose values differ, but for those that a resumed run may set anew."""
    changed = set()
    for key in {*old, *new}:
        name = f"{prefix}{key}"
        if name in MAY_CHANGE or name == "collector.total_frames":
            continue
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            changed |= _differences(a, b, f"{name}.")
        elif a != b:
            changed.add(name)
    return changed
