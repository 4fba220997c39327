"""Failures and repairs of VMs and links (the paper's Algorithm 1 names them), drawn ahead for the whole horizon."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nfv_torchrl.codec import count_vms, link_resource, split_vm, vm_resource
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.limits import MAX_SLOTS
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.settings.values import parse, shown


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
            value = parse(getattr(self, field.name), float, f"failures.{field.name}")
            if not 0 <= value <= 1:
                raise ScenarioError(f"failures.{field.name}: {value} is no probability; use a number in [0, 1]")

    @property
    def off(self) -> bool:
        """Whether nothing ever fails."""
        return self.p_fail_vm == 0 and self.p_fail_link == 0

    def expected_events(self, substrate: Substrate, horizon: int) -> float:
        """Mean number of failures and repairs in ``horizon`` slots, rounded up a little."""
        vms, links = int(substrate.vm_count.sum()), substrate.num_links
        return sum(
            count * _expected_events(p_fail, self.p_repair, horizon)
            for count, p_fail in ((vms, self.p_fail_vm), (links, self.p_fail_link))
        )


@dataclass(frozen=True, eq=False)
class FailureTimeline:
    """All failures and repairs of a horizon, in the order in which they are applied: by slot, repairs first.

    Attributes:
        slot: int64 [E].
        resource: int64 [E]; numbered as in ``nfv_torchrl.codec``, with V the substrate's ``max_vms``.
        up: bool [E]; True is a repair, False a failure.

    Raises:
        ScenarioError: columns of other kinds or lengths, or events out of order.
    """

    slot: np.ndarray
    resource: np.ndarray
    up: np.ndarray

    def __post_init__(self) -> None:
        for name, kinds, kind in (("slot", "iu", np.int64), ("resource", "iu", np.int64), ("up", "b", np.bool_)):
            column = np.asarray(getattr(self, name))
            if column.ndim != 1 or column.shape != np.shape(self.slot) or column.dtype.kind not in kinds:
                raise ScenarioError(
                    f"failure timeline: {name} is {column.dtype} {list(column.shape)}; use {kind.__name__} [E]"
                )
            object.__setattr__(self, name, column.astype(kind, copy=False))
        # Twice the slot, plus one for a failure: repairs come first within a slot.
        if len(self) and (self.slot[0] < 0 or np.any(np.diff(2 * self.slot + ~self.up) < 0)):
            raise ScenarioError("failure timeline: is out of order; sort by slot from 0, repairs before failures")

    def check_fits(self, substrate: Substrate) -> None:
        """Refuse events that the substrate cannot have.

        Raises:
            ScenarioError: a resource that is not there, a failure of what has failed, a repair of what works.
        """
        exists = np.arange(substrate.max_vms) < substrate.vm_count[:, None]
        there = np.r_[exists.ravel(), np.ones(substrate.num_links, bool)]
        if not len(self):
            return
        if self.resource.min() < 0 or self.resource.max() >= len(there) or not there[self.resource].all():
            raise ScenarioError("failure timeline: names a VM or link that the substrate does not have; draw it anew")
        order = np.argsort(self.resource, kind="stable")
        place, resource = np.arange(len(order)), self.resource[order]
        first = np.maximum.accumulate(np.where(np.diff(resource, prepend=-1) != 0, place, 0))
        if np.any(self.up[order] != ((place - first) % 2 == 1)):
            raise ScenarioError("failure timeline: fails what has failed or repairs what works; draw it anew")

    def __len__(self) -> int:
        return len(self.slot)

    @classmethod
    def empty(cls) -> FailureTimeline:
        """The timeline on which nothing fails."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool))

    def to_events(self, substrate: Substrate) -> list[dict[str, Any]]:
        """For JSON: ``slot``, ``event`` (``repair`` or ``failure``), and ``vm`` [node, VM] or ``link`` [u, v]."""
        events = []
        vms = count_vms(substrate.num_nodes, substrate.max_vms)
        for slot, resource, up in zip(self.slot.tolist(), self.resource.tolist(), self.up.tolist(), strict=True):
            event: dict[str, Any] = {"slot": slot, "event": "repair" if up else "failure"}
            if resource < vms:
                event["vm"] = list(split_vm(resource, substrate.max_vms))
            else:
                event["link"] = substrate.links[resource - vms].tolist()
            events.append(event)
        return events

    @classmethod
    def from_events(cls, events: Any, substrate: Substrate, source: str = "failure_timeline") -> FailureTimeline:
        """The inverse of ``to_events``.

        Raises:
            ScenarioError: an entry is no such event, is out of order, names what the substrate does not have, repairs
                what works or fails what has failed.
        """
        if not isinstance(events, list):
            raise ScenarioError(f"{source}: must be a list of events; write the file again")
        indices = _resource_indices(substrate)
        rows: list[tuple[int, bool, int]] = []
        down: set[int] = set()
        for place, event in enumerate(events):
            where = f"{source}, entry {place}"
            slot, up, resource = _parse_event(event, indices, where)
            if rows and (slot, not up) < (rows[-1][0], not rows[-1][1]):
                raise ScenarioError(f"{where}: is out of order; sort by slot, repairs before failures")
            if up != (resource in down):
                raise ScenarioError(f"{where}: {event} changes nothing: it {'works' if up else 'has failed'} already")
            (down.discard if up else down.add)(resource)
            rows.append((slot, up, resource))
        columns = zip(*rows, strict=True) if rows else ((), (), ())
        slots, ups, resources = columns
        return cls(np.array(slots, np.int64), np.array(resources, np.int64), np.array(ups, bool))


def _resource_indices(substrate: Substrate) -> dict[tuple[str, int, int], int]:
    """Index of every existing resource by ("vm", node, VM) or ("link", u, v)."""
    width = substrate.max_vms
    vms = {
        ("vm", node, vm): vm_resource(node, vm, width)
        for node, count in enumerate(substrate.vm_count.tolist())
        for vm in range(count)
    }
    links = enumerate(substrate.links.tolist())
    return vms | {("link", u, v): link_resource(link, substrate.num_nodes, width) for link, (u, v) in links}


def _parse_event(event: Any, indices: dict[tuple[str, int, int], int], where: str) -> tuple[int, bool, int]:
    """Slot, whether it is a repair, and the resource's index."""
    if isinstance(event, dict) and event.get("event") in ("repair", "failure") and type(event.get("slot")) is int:
        for kind in ("vm", "link"):
            match event.get(kind):
                case [int(first), int(second)] if 0 <= event["slot"] <= MAX_SLOTS and (kind, first, second) in indices:
                    return event["slot"], event["event"] == "repair", indices[kind, first, second]
    raise ScenarioError(f"{where}: {shown(event)} is no repair or failure of a VM or link of the substrate")


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


def _expected_events(p_fail: float, p_repair: float, horizon: int) -> float:
    """Of one resource. A cycle of failure and repair lasts 1 / p_fail - 1 + 1 / p_repair slots on average."""
    if p_fail == 0:
        return 0.0
    if p_repair == 0:
        return min(1.0, p_fail * horizon)
    return 2 + 2 * horizon / (1 / p_fail - 1 + 1 / p_repair)


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
