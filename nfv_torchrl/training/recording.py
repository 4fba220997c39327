"""Transitions of any method, recorded to files that offline learning reads."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_json, write_atomically
from nfv_torchrl.folders import check_place, claim, refuse_foreign
from nfv_torchrl.methods import Method
from nfv_torchrl.training.recorded import Form, check_part, flat_keys, read_array

MANIFEST = "dataset.json"
FORMAT = 2
LARGEST_MANIFEST = 10**7  # bytes; a real one has some thousand
OURS = re.compile(r"part_\d{4,}|dataset\.json|\.part_\d{4,}\.partial|\.dataset\.json\..*\.tmp|\.nfv_torchrl\.lock")
"""What may be in a folder that is recorded to: anything else there is a user's."""


class MethodPolicy(TensorDictModuleBase):
    """A method as the policy of a collector: looks at the simulator of ``env``, writes ``action`` int64 [B]."""

    def __init__(self, method: Method, env: NFVEnv) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["action_mask"], ["action"]
        self.method, self.env = method, env
        self._ready = False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        simulator = self.env.simulator
        if not self._ready:  # only now have the horizons begun
            self.method.prepare(simulator, range(simulator.batch_size))
            self._ready = True
        return tensordict.set("action", torch.from_numpy(self.method.act(simulator)))


class Dataset:
    """A folder of recorded transitions: ``part_0000``, ``part_0001``, ... with one ``.npy`` file for each key.

    Each part is what a collector returns: the keys of ``NFVEnv``, shapes [B, T, ...]. ``dataset.json`` is written last
    and says how it was recorded, and the shape and dtype of every key; a folder without it was interrupted and is
    recorded anew. The files hold no pickled objects, and every one is checked when it is read: it may be a stranger's.

    Args:
        folder: where it is or is to be.
        origin: what determines the recording (scenario, method, reward, ...), as plain numbers, strings and lists.
        env: records, and says which keys, shapes and ranges there have to be.
        frames: steps in all, at least.
        steps: T, of each environment in a part.
        apart_from: folder of the run that reads it, if the user named the dataset: it must not be moved with the run.
            None: it is that run's own.

    Raises:
        ScenarioError: the folder holds something else, a recording of another origin, or one without a key.
    """

    def __init__(
        self,
        folder: str | Path,
        origin: Mapping[str, Any],
        env: NFVEnv,
        *,
        frames: int,
        steps: int,
        apart_from: Path | None = None,
    ) -> None:
        self.folder, self._own = Path(folder), apart_from is None
        if apart_from is not None and check_place("dataset", folder).resolve().is_relative_to(apart_from.resolve()):
            raise ScenarioError(f"dataset: {folder} is in run_dir; leave it null, or name a folder of its own")
        self.origin = json.loads(json.dumps(origin))
        self.env = env
        self.batch = (env.simulator.batch_size, steps)
        self.num_parts = -(-frames // (env.simulator.batch_size * steps))
        self.forms = {
            name: Form(value.numpy().dtype, (*self.batch, *value.shape[1:]))
            for name, value in flat_keys(env.fake_tensordict())
        }
        with self._usable():
            self._check_folder()
            if self.complete:
                self._check_manifest()
            elif not self._own:
                refuse_foreign("dataset", self.folder, "dataset")

    @property
    def complete(self) -> bool:
        """Whether it has been recorded to the end."""
        return (self.folder / MANIFEST).is_file()

    def record(self, method: Method, progress: Callable[[int], object]) -> None:
        """Let ``method`` act in ``env``; ``progress`` is told the steps of each part.

        Raises:
            ScenarioError: the method took an action outside the mask, from which nothing can be learned, or the
                folder cannot be written, or another command records there.
        """
        lock = None if self._own else claim("dataset", self.folder, "dataset")
        policy, frames = MethodPolicy(method, self.env), self.batch[0] * self.batch[1]
        collector = Collector(self.env, policy, frames_per_batch=frames, total_frames=-1)
        with self._usable():
            self._remove_interrupted()
            for number, data in zip(range(self.num_parts), collector, strict=False):
                valid = data["action_mask"].gather(-1, data["action"].unsqueeze(-1))
                if not valid.all():
                    raise ScenarioError(
                        f"{method.name} took actions outside the mask; only valid ones can be learned from"
                    )
                self._write_part(number, data)
                progress(data.numel())
            about = {name: {"dtype": str(form.dtype), "shape": list(form.shape)} for name, form in self.forms.items()}
            manifest = {"format": FORMAT, "parts": self.num_parts, "arrays": about, "origin": self.origin}
            write_atomically(self.folder / MANIFEST, json.dumps(manifest, indent=2))
        collector.shutdown(close_env=False)
        if lock is not None:  # others may read it now
            lock.release()

    def parts(self) -> Iterator[TensorDict]:
        """The parts in the order of time, [B, T], read from the files as they are used and checked before.

        Raises:
            ScenarioError: a file is missing or damaged, or holds what cannot have been recorded in this scenario.
        """
        for number in range(self.num_parts):
            folder = self.folder / f"part_{number:04d}"
            part = TensorDict(batch_size=list(self.batch))
            for name, form in self.forms.items():
                part.set(tuple(name.split(".")), torch.from_numpy(read_array(folder / f"{name}.npy", form)))
            check_part(folder, part, self.env)
            yield part

    def check(self) -> None:
        """Read everything once.

        Raises:
            ScenarioError: see ``parts``.
        """
        for _ in self.parts():
            pass

    def _write_part(self, number: int, data: TensorDictBase) -> None:
        partial = self.folder / f".part_{number:04d}.partial"
        partial.mkdir(parents=True)
        for name, value in flat_keys(data.exclude("collector")):
            np.save(partial / f"{name}.npy", value.numpy(), allow_pickle=False)
        partial.rename(self.folder / f"part_{number:04d}")

    def _remove_interrupted(self) -> None:
        for path in (*self.folder.glob("part_*"), *self.folder.glob(".part_*.partial")):
            shutil.rmtree(path)

    @contextlib.contextmanager
    def _usable(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise ScenarioError(
                f"dataset: {self.folder} cannot be used ({error.strerror}); mend that, or name another folder"
            ) from error

    def _check_folder(self) -> None:
        """Refuse a folder that is a user's, or of the format of older versions, which could run code."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ScenarioError(f"dataset: {self.folder} is a file; name a folder")
        for path in sorted(self.folder.iterdir()) if self.folder.exists() else ():
            kinds = {each.suffix for each in path.iterdir()} if path.is_dir() else set()
            ours = OURS.fullmatch(path.name) is not None
            if ours and (path / "meta.json").exists():
                raise ScenarioError(
                    f"dataset: {self.folder} was recorded by an earlier version, in a format that is not read any more "
                    "because it could run code; record it again, in another folder"
                )
            if not ours or not kinds <= {".npy"}:
                raise ScenarioError(
                    f"dataset: {self.folder} holds {path.name}, which no recording has; name a new or an empty folder"
                )

    def _check_manifest(self) -> None:
        """Refuse a recording that is not the one these settings make."""
        path = self.folder / MANIFEST
        if path.stat().st_size > LARGEST_MANIFEST:
            raise ScenarioError(f"dataset: {path} is too large to be the list of a recording's arrays")
        there = read_json(path)
        origin, arrays = there.get("origin"), there.get("arrays")
        if there.get("format") != FORMAT or not isinstance(origin, dict) or not isinstance(arrays, dict):
            raise ScenarioError(f"dataset: {path} is not of this version's format; record it again, in another folder")
        differs = sorted(key for key in {*origin, *self.origin} if origin.get(key) != self.origin.get(key))
        if differs:
            raise ScenarioError(
                f"dataset: {self.folder} was recorded with another {', '.join(differs)}; name another folder"
            )
        for name, form in self.forms.items():
            if name not in arrays:
                raise ScenarioError(
                    f"dataset: {self.folder} lacks {name!r}; it was recorded for another network, name another folder"
                )
            if arrays[name] != {"dtype": str(form.dtype), "shape": list(form.shape)}:
                raise ScenarioError(
                    f"dataset: {path} says that {name} is of {arrays[name]!r:.80}; this scenario has {form}"
                )
        if there.get("parts") != self.num_parts:
            raise ScenarioError(f"dataset: {path} has not the {self.num_parts} parts of these settings of record")
