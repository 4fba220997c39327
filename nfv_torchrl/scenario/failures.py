"""Failures and repairs of VMs and links (the paper's Algorithm 1 names them), drawn ahead for the whole horizon."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.substrate import Substrate


@dataclass(frozen=True)
class FailureModel:
    """Probabilities per slot: a failed resource is repaired, then a working one fails. All zero: no failures.

    Raises:
        ScenarioError: a value outside [0, 1].
    """

    p_fail_vm: float = 0.0
    p_fail_link: float = 0.0
    p_repair: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value <= 1:
                raise ScenarioError(f"failures.{field.name}: {value} is no probability; use a number in [0, 1]")

    @property
    def off(self) -> bool:
        """Whether nothing ever fails."""
        return self.p_fail_vm == 0 and self.p_fail_link == 0


@dataclass(frozen=True, eq=False)
class FailureTimeline:
    """All failures and repairs of a horizon, in the order in which they are applied: by slot, repairs first.

    Attributes:
        slot: int64 [E].
        resource: int64 [E]; VM v of node n is n * V + v, link l is N * V + l (V the substrate's ``max_vms``).
        up: bool [E]; True is a repair, False a failure.
    """

    slot: np.ndarray
    resource: np.ndarray
    up: np.ndarray

    def __len__(self) -> int:
        return len(self.slot)

    @classmethod
    def empty(cls) -> FailureTimeline:
        """The timeline on which nothing fails."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool))

    def to_lists(self) -> dict[str, list[Any]]:
        """The three columns as plain lists, for JSON."""
        return {"slot": self.slot.tolist(), "resource": self.resource.tolist(), "up": self.up.tolist()}

    @classmethod
    def from_lists(cls, data: Any, source: str = "failure timeline") -> FailureTimeline:
        """The inverse of :meth:`to_lists`.

        Raises:
            ScenarioError: a column is missing or not a list of the right kind, or their lengths differ.
        """
        columns = {name: data.get(name) if isinstance(data, dict) else None for name in ("slot", "resource", "up")}
        for name, column in columns.items():
            kind = bool if name == "up" else int
            if not isinstance(column, list) or any(type(value) is not kind for value in column):
                raise ScenarioError(f"{source}: {name!r} must be a list of {kind.__name__}; write the file again")
        if len({len(column) for column in columns.values() if column is not None}) != 1:
            raise ScenarioError(f"{source}: 'slot', 'resource' and 'up' differ in length; write the file again")
        slot, resource = (np.array(columns[name], np.int64) for name in ("slot", "resource"))
        return cls(slot, resource, np.array(columns["up"], bool))


def sample_timeline(
    model: FailureModel, substrate: Substrate, horizon: int, rng: np.random.Generator
) -> FailureTimeline:
    """Draw what fails and what is repaired in slots 0 .. horizon - 1, starting with everything up.

    In each slot every failed resource is repaired with ``p_repair``, then every working one, the just repaired
    included, fails with its ``p_fail``. Waiting times are geometric, so they are drawn instead of slot after slot.
    """
    if model.off:
        return FailureTimeline.empty()
    resources, p_fail = _what_can_fail(model, substrate)
    events: list[tuple[np.ndarray, np.ndarray, bool]] = []
    now = np.zeros(len(resources), np.int64)  # the first slot in which each resource may fail
    while len(resources):
        now = now + _wait(p_fail, len(resources), horizon, rng) - 1
        resources, p_fail, now = _still_running(now < horizon, resources, p_fail, now)
        events.append((now, resources, False))
        now = now + _wait(model.p_repair, len(resources), horizon, rng)
        resources, p_fail, now = _still_running(now < horizon, resources, p_fail, now)
        events.append((now, resources, True))
    slot = np.concatenate([slots for slots, _, _ in events])
    resource = np.concatenate([names for _, names, _ in events])
    up = np.concatenate([np.full(len(slots), repaired) for slots, _, repaired in events])
    order = np.lexsort((resource, ~up, slot))
    return FailureTimeline(slot[order], resource[order], up[order])


def _what_can_fail(model: FailureModel, substrate: Substrate) -> tuple[np.ndarray, np.ndarray]:
    """Indices int64 of existing VMs and links that may fail, and their probabilities float64."""
    exists = np.arange(substrate.max_vms) < substrate.vm_count[:, None]
    vms = np.flatnonzero(exists.ravel()) if model.p_fail_vm > 0 else np.zeros(0, np.int64)
    links = exists.size + np.arange(substrate.num_links if model.p_fail_link > 0 else 0)
    p_fail = np.repeat([model.p_fail_vm, model.p_fail_link], [len(vms), len(links)])
    return np.concatenate([vms, links]), p_fail


def _wait(probability: np.ndarray | float, count: int, horizon: int, rng: np.random.Generator) -> np.ndarray:
    """Slots until a thing of ``probability`` happens, 1 if in the first; cut off past the horizon."""
    if np.all(np.asarray(probability) == 0):
        return np.full(count, horizon + 1, np.int64)
    return np.minimum(rng.geometric(probability, size=count), horizon + 1)


def _still_running(within: np.ndarray, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(array[within] for array in arrays)
