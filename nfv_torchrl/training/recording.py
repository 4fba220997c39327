"""Transitions of any method, recorded to files that offline learning reads."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.methods import Method
from nfv_torchrl.files import write_atomically

MANIFEST = "dataset.json"


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
    """A folder of recorded transitions: ``part_0000``, ``part_0001``, ... as memory-mapped TensorDicts [B, T].

    Each part is what a collector returns: the keys of ``NFVEnv``, time in dimension 1. ``dataset.json`` is written last
    and says how it was recorded; a folder without it was interrupted and is recorded anew.

    Args:
        folder: where it is or is to be.
        origin: what determines the recording (scenario, method, reward, ...), as plain numbers, strings and lists.
        keys: what will be read from it.

    Raises:
        ScenarioError: the folder holds a recording of another origin, or without one of the keys.
    """

    def __init__(self, folder: str | Path, origin: Mapping[str, Any], keys: Sequence[NestedKey] = ()) -> None:
        self.folder = Path(folder)
        self.origin = json.loads(json.dumps(origin))
        if self.complete:
            self._check_origin()
            self._check_keys(keys)

    @property
    def complete(self) -> bool:
        """Whether it has been recorded to the end."""
        return (self.folder / MANIFEST).is_file()

    def record(
        self, env: NFVEnv, method: Method, *, frames: int, steps: int, progress: Callable[[int], object]
    ) -> None:
        """Let ``method`` act in ``env`` for at least ``frames`` steps in all, ``steps`` of each environment a part.

        Raises:
            ScenarioError: the method took an action outside the mask, from which nothing can be learned.
        """
        frames_per_batch = env.batch_size[0] * steps
        collector = Collector(env, MethodPolicy(method, env), frames_per_batch=frames_per_batch, total_frames=-1)
        parts = -(-frames // frames_per_batch)
        for number, data in zip(range(parts), collector, strict=False):
            valid = data["action_mask"].gather(-1, data["action"].unsqueeze(-1))
            if not valid.all():
                raise ScenarioError(f"{method.name} took actions outside the mask; only valid ones can be learned from")
            data.exclude("collector").memmap(self.folder / f"part_{number:04d}")
            progress(data.numel())
        collector.shutdown(close_env=False)
        write_atomically(self.folder / MANIFEST, json.dumps(self.origin, indent=2))

    def parts(self) -> Iterator[TensorDict]:
        """The parts in the order of time, read from the files as they are used."""
        for path in sorted(self.folder.glob("part_*")):
            yield TensorDict.load_memmap(path)

    def _check_origin(self) -> None:
        there = json.loads((self.folder / MANIFEST).read_text())
        differs = sorted(key for key in {*there, *self.origin} if there.get(key) != self.origin.get(key))
        if differs:
            raise ScenarioError(
                f"dataset: {self.folder} was recorded with another {', '.join(differs)}; name another folder"
            )

    def _check_keys(self, keys: Sequence[NestedKey]) -> None:
        there = set(next(self.parts()).keys(True, True))
        lacking = [key for key in map(unravel_key, keys) if key not in there]
        if lacking:
            raise ScenarioError(
                f"dataset: {self.folder} lacks {lacking[0]!r}; it was recorded for another network, name another folder"
            )
