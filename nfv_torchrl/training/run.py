"""One training run: its folder, its progress and its evaluations on held-out workloads."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import nn

from nfv_torchrl import __version__
from nfv_torchrl.errors import CheckpointError, ScenarioError, one_line
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import (
    claim,
    contents,
    holds_runs,
    is_marked,
    lock_folder,
    refuse_foreign,
    remove_leftovers,
    set_aside,
)
from nfv_torchrl.inputs import file_digests, world_digests
from nfv_torchrl.locks import Lock
from nfv_torchrl.methods import save_policy
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.checking import check_parts, load_part
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.finite import check_weights
from nfv_torchrl.training.setup import quote, run_folder

MAY_CHANGE = (
    "resume", "run_dir", "device", "logger", "saving", "generations",
    "collector.total_frames", "collector.address", "collector.cpus", "parallel",
)  # fmt: skip
"""Config keys that a resumed run may set anew."""
_NOT_PLAIN = r"[^\w./+-]"


class RunFolder:
    """The folder of a run: ``config.yaml``, ``checkpoint_*.pt``, ``best.pt`` and TensorBoard's event files.

    Making it checks it; nothing on disk moves before ``open``, which comes after all that may be refused. While the
    run lives it holds a lock on the folder.

    Args:
        config: the resolved config of the run; ``run_dir``, ``resume`` and how many checkpoints to keep are in it.
        scenarios: what the run trains on; a resumed run has to build the same.

    Raises:
        ScenarioError: the folder is in use, or not one that a run may take.
        CheckpointError: nothing to resume.
    """

    def __init__(self, config: dict[str, Any], scenarios: Iterable[Scenario]) -> None:
        self.path = path = run_folder(config["run_dir"])
        self.config = config
        self.resume: bool = config["resume"]
        self.inputs = file_digests(config) | world_digests(scenarios)
        self.checkpoints = CheckpointFolder(path, config["saving"]["keep"])
        refuse_foreign("run_dir", path, "run")
        if self.resume and not self.checkpoints.files():
            raise CheckpointError(f"resume: {path} holds no checkpoint to go on from; start without resume=true")
        self._lock = self._lock_older() if contents(path) else None
        self._carried: dict[str, Any] = {}
        self._read: dict[str, Any] = {}

    def carry(self, name: str, part: Any) -> None:
        """Save ``part`` with every checkpoint, too; for what is made after ``load``.

        When resuming it gets its state; a checkpoint of an older version has none, and ``part`` begins anew.

        Raises:
            CheckpointError: a state that is not one of ``part``.
        """
        self._carried[name] = part
        if name in self._read:
            load_part(self.path, name, part, self._read[name])

    def open(self) -> None:
        """Take the folder. When resuming, what a kill left in it is removed; otherwise an older run is renamed."""
        if self.resume:
            assert self._lock is not None
            self._lock.passing = False
            remove_leftovers(self.path)
            return
        older_lock = self._lock
        if contents(self.path):
            older_lock = older_lock or self._lock_older()
            try:
                older = set_aside(self.path)
            except OSError as error:
                raise ScenarioError(f"run_dir: {self.path} cannot be renamed ({error.strerror})") from error
            print(f"An older run was at {self.path}; it is now at {self.path.with_name(older.name)}.")
        self._lock = claim("run_dir", self.path, "run")
        if older_lock is not None:
            older_lock.release()
        write_atomically(self.path / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(self.config)))

    def _lock_older(self) -> Lock:
        marked = is_marked(self.path)
        lock = lock_folder("run_dir", self.path, "run")
        lock.passing = not marked  # a command that is refused leaves nothing in an older version's run
        inner = None if self.resume else holds_runs(self.path)
        if inner is not None:
            lock.release()
            raise ScenarioError(f"run_dir: {self.path} holds {inner}, which would be renamed, too; name another folder")
        return lock

    def save(self, state: Mapping[str, Any], frames: int) -> None:
        """Write a checkpoint of every part of ``state``.

        Raises:
            CheckpointError: the folder is no longer this run's.
            TrainingError: weights are not finite; the checkpoints there stay.
        """
        self._check_in_place()
        for name, part in state.items():
            if isinstance(part, nn.Module):
                check_weights(part, name, state["progress"])
        content = {name: _plain(part.state_dict()) for name, part in {**state, **self._carried}.items()}
        content["config"] = self.config
        content["inputs"] = self.inputs
        content["versions"] = {"nfv_torchrl": __version__, "torch": str(torch.__version__)}
        self.checkpoints.save(frames, content)

    def save_best(self, content: Mapping[str, Any]) -> None:
        """Write ``best.pt``.

        Raises:
            CheckpointError: the folder is no longer this run's.
        """
        self._check_in_place()
        save_policy(self.path / "best.pt", content)

    def _check_in_place(self) -> None:
        if self._lock is not None and not self._lock.in_place():
            raise CheckpointError(
                f"{self.path} was moved or replaced while its run was at work, so nothing more is written there; go "
                "on from its last checkpoint with run_dir=WHERE_IT_IS resume=true"
            )

    def load(self, state: Mapping[str, Any]) -> None:
        """When resuming, bring every part of ``state`` to the newest whole checkpoint.

        Raises:
            CheckpointError: the config, or the content of an input file, is not what the run was started with.
        """
        if not self.resume:
            return
        path, content = self.checkpoints.load_newest()
        config, inputs = content.get("config"), content.get("inputs", {})
        if not isinstance(config, Mapping) or not isinstance(inputs, Mapping):
            raise CheckpointError(f"{path} lacks 'config' or 'inputs'; it is no checkpoint of a run, use another one")
        try:
            changed = sorted(_differences(config, self.config))
        except Exception as error:  # a stranger's config may hold tensors, which compare to no truth value
            raise CheckpointError(f"{path} has a config that no recipe has ({one_line(error)})") from error
        if changed:
            raise CheckpointError(
                f"{path} was written with another config ({', '.join(changed)} differ); resume with the settings of "
                f"{self.path / 'config.yaml'}, or start a new run in another run_dir"
            )
        self._check_inputs(path, inputs)
        check_parts(path, content, state)
        for name, part in state.items():
            load_part(path, name, part, content[name])
        self._random_numbers = content["rng"]
        self._read = {name: part for name, part in content.items() if name not in state}
        print(f"Resumed from {path}.")

    def _check_inputs(self, path: Path, before: Mapping[str, str]) -> None:
        # What was not there then or is gone now is not compared: a policy that a run began with is read only once.
        changed = [key for key, digest in self.inputs.items() if str(before.get(key, digest)) != digest]
        if changed:
            raise CheckpointError(
                f"{path} was written with other inputs (the content of {', '.join(changed)} differs); give back what "
                "the run was started with, or start a new run in another run_dir"
            )

    def load_random_numbers(self, state: Mapping[str, Any]) -> None:
        """When resuming, set the random numbers of ``state["rng"]`` once more, as the last step before the loop."""
        if self.resume:
            state["rng"].load_state_dict(self._random_numbers)

    def print_ending(self, *, interrupted: bool) -> None:
        """Print where results are and how to continue."""
        if interrupted:
            where = shlex.quote(f"run_dir={quote(self.path) if re.search(_NOT_PLAIN, str(self.path)) else self.path}")
            print(f"\nStopped and saved. Go on with the same command and: {where} resume=true")
        best = self.path / "best.pt"
        if best.exists():
            print(f"Best policy: {best}")
        print(f"TensorBoard: tensorboard --logdir {self.path}, then http://localhost:6006/#custom_scalars")


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
        if name in MAY_CHANGE:
            continue
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            changed |= _differences(a, b, f"{name}.")
        elif a != b:
            changed.add(name)
    return changed
