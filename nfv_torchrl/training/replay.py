"""The replay memory of a run, made of a storage, a sampler and a writer, and tried once before anything is begun."""

from __future__ import annotations

import copy
import inspect
import pkgutil
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torchrl
from hydra.utils import instantiate
from tensordict import TensorDictBase
from torchrl import _torchrl
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import LazyMemmapStorage, PrioritizedSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers.storages import TensorStorage

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.scenario.limits import check_memory
from nfv_torchrl.training.disk import tensor_bytes
from nfv_torchrl.training.memory import MemoryState
from nfv_torchrl.training.setup import check_device

_TRIED = 4
"""Items in a batch of the trial."""


def make_buffer(
    parts: Mapping[str, Any], *, size: int, batch_size: int, device: torch.device | str
) -> TensorDictReplayBuffer:
    """The replay memory that the config group ``buffer`` describes.

    Batches of a memory on the CPU are pinned if the learner is on a GPU, so that ``to(device, non_blocking=True)`` does
    not wait.

    Args:
        parts: ``storage``, ``sampler`` and ``writer``, a mapping with ``_target_`` each.
        size: items at most; the storage gets it as ``max_size``, and a sampler that wants it as ``max_capacity``.
        batch_size: items drawn at a time.
        device: where the learner is, and the items unless ``storage.device`` says otherwise. Items that are drawn by
            priority stay on the CPU where this TorchRL has no trees of priorities for a GPU; PyPI's wheel has none.

    Raises:
        ScenarioError: the storage is none that can be saved, or lies where its sampler cannot draw.
    """
    storage = instantiate(parts["storage"], max_size=size, **_device(parts, device))
    if not isinstance(storage, TensorStorage) or storage.ndim != 1:
        raise ScenarioError(
            f"buffer.storage: {type(storage).__name__} does not hold items in tensors one after the other, as "
            "checkpoints need it; use torchrl.data.LazyTensorStorage or torchrl.data.LazyMemmapStorage"
        )
    capacity = {"max_capacity": size} if "max_capacity" in _arguments(parts["sampler"]) else {}
    pinned = torch.device(storage.device).type == "cpu" and torch.device(device).type == "cuda"
    return TensorDictReplayBuffer(
        storage=storage,
        sampler=instantiate(parts["sampler"], **capacity),
        writer=instantiate(parts["writer"]),
        batch_size=batch_size,
        pin_memory=pinned,
    )


def some_rows(loss: Any, env: NFVEnv, *, steps: int) -> TensorDictBase:
    """What the loss keeps of ``steps`` steps of ``env``, [rows]; nothing of loss or random numbers changes."""
    with _same_random_numbers():
        loss = copy.deepcopy(loss).to("cpu")
        with torch.no_grad():
            data = env.rollout(steps, loss.actor, break_when_any_done=False)
        return loss.prepare(data)


def check_replay(loss: Any, rows: TensorDictBase, parts: Mapping[str, Any], *, size: int) -> int:
    """Let a small memory of the same parts work once: write, draw, give priorities, save and load.

    Nothing of loss or random numbers changes.

    Args:
        loss: as the run has it; a copy of it is asked.
        rows: of ``some_rows``.
        parts: the config group ``buffer``.
        size: items that the run's memory holds at most.

    Returns:
        Bytes of one item.

    Raises:
        ScenarioError: too little memory or disk for ``size`` items, or parts that do not work together; names the part.
    """
    item = tensor_bytes(rows.to_dict()) // len(rows)
    _check_place(parts["storage"], float(item) * size, size)
    make_buffer(parts, size=size, batch_size=_TRIED, device="cpu")
    with _same_random_numbers():
        small = {**parts, "storage": {"_target_": "torchrl.data.LazyTensorStorage"}}
        _try(copy.deepcopy(loss).to("cpu"), rows, small)
    return item


@contextmanager
def _same_random_numbers() -> Iterator[None]:
    """Afterwards the global random numbers are as before."""
    before = copy.deepcopy(GlobalRNGState().state_dict())
    try:
        yield
    finally:
        GlobalRNGState().load_state_dict(before)


def _try(loss: Any, rows: TensorDictBase, parts: Mapping[str, Any]) -> None:
    """Write, draw, give priorities, save and load.

    Raises:
        ScenarioError: one of these fails.
    """
    buffer, other = (make_buffer(parts, size=2 * len(rows), batch_size=_TRIED, device="cpu") for _ in range(2))
    names = ", ".join(type(part).__name__ for part in (buffer.sampler, buffer.writer))
    try:
        for _ in range(3):  # once round the memory and on
            buffer.extend(rows.clone())
        batch = buffer.sample()
    except Exception as error:  # whatever a class of one's own raises
        raise ScenarioError(f"buffer: {names} do not work here ({one_line(error)}); try buffer=uniform") from error
    if isinstance(buffer.sampler, PrioritizedSampler):
        with warnings.catch_warnings(action="ignore"):  # the copy has no target updater
            loss(batch)
        if buffer.priority_key not in batch.keys():  # noqa: SIM118
            raise ScenarioError(
                f"buffer.sampler: {type(buffer.sampler).__name__} draws by the errors of items (td_error), which "
                f"{type(loss).__name__} does not write; use buffer=uniform, or see docs/extending.md"
            )
    try:
        buffer.update_tensordict_priority(batch)
        MemoryState(other).load_state_dict(MemoryState(buffer).state_dict())
    except ScenarioError:
        raise
    except Exception as error:
        raise ScenarioError(f"buffer: {names} cannot be saved ({one_line(error)}); try buffer=uniform") from error


def _check_place(storage: Mapping[str, Any], needed: float, size: int) -> None:
    """There is room for the items: in memory, or on the disk for a storage that is mapped from there."""
    if not issubclass(_class(storage), LazyMemmapStorage):
        check_memory({f"buffer.size={size}": needed})
        return
    folder = Path(storage.get("scratch_dir") or tempfile.gettempdir()).resolve()
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise ScenarioError(
            f"buffer.size={size} needs {needed / 1e9:.1f} GB on the disk of {folder}, which has {free / 1e9:.1f} GB "
            "free; use a smaller memory, or another buffer.storage.scratch_dir"
        )


def _class(spec: Mapping[str, Any]) -> type:
    return pkgutil.resolve_name(spec["_target_"])


def _arguments(spec: Mapping[str, Any]) -> Mapping[str, inspect.Parameter]:
    made = _class(spec)
    # Of a class its own `__init__`: TorchRL's samplers have a metaclass that takes anything.
    return inspect.signature(made.__init__ if inspect.isclass(made) else made).parameters  # type: ignore[misc]


def _device(parts: Mapping[str, Any], device: torch.device | str) -> dict[str, str]:
    """The learner's device for a storage that can be there; files cannot."""
    storage = parts["storage"]
    if "device" in storage:
        _check_device(parts)
        return {}
    if issubclass(_class(storage), LazyMemmapStorage) or "device" not in _arguments(storage):
        return {}
    return {"device": "cpu" if _draws_on_cpu(parts["sampler"]) else str(device)}


def _check_device(parts: Mapping[str, Any]) -> None:
    """Items can lie, and be drawn, where the settings say."""
    place = check_device("buffer.storage.device", parts["storage"]["device"], "leave that key out")
    if place.type == "cuda" and _draws_on_cpu(parts["sampler"]):
        raise ScenarioError(
            f"buffer.storage.device: this TorchRL ({torchrl.__version__}) has no trees of priorities on a GPU; leave "
            "that key out, and the items stay on the CPU"
        )


def _draws_on_cpu(sampler: Mapping[str, Any]) -> bool:
    """Whether it draws by priorities in trees that TorchRL was built without for a GPU."""
    kind = _class(sampler)
    return (
        inspect.isclass(kind)
        and issubclass(kind, PrioritizedSampler)
        and not hasattr(_torchrl, "CudaSumSegmentTreeFp32")
    )
