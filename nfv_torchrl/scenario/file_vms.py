"""The VMs that a network file gives its nodes, others drawn."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import unique_keys
from nfv_torchrl.scenario.attributes import DRAWN, FileNumbers
from nfv_torchrl.scenario.quoting import shown
from nfv_torchrl.scenario.resources import ResourceRanges, VmDraw, draw_vms
from nfv_torchrl.scenario.substrate import check_vm_slots, kinds_of, vms_of


def file_vms(numbers: FileNumbers, kept: list[int], ranges: ResourceRanges, seed: int) -> VmDraw:
    """VMs of the nodes at places ``kept`` of a file: those of the file, what it lacks drawn.

    A node lists them as ``vms``, or all its VMs are alike: ``vm_count`` of ``vm_capacity`` and ``vm_unit_cost``, each
    of which may be missing. If every node's count is known, V is the file's ``max_vms`` or the largest count, otherwise
    at least the upper bound of ``ranges.vms``.

    Raises:
        ScenarioError: a list of VMs that is none, a count that is no integer, or ``max_vms`` below a count.
    """
    file = numbers.file
    kinds = kinds_of(file.attributes, file.source)
    lists = [_listed(numbers, place, kinds) for place in kept]
    count = np.array(
        [_count(numbers, place) if vms is None else len(vms) for vms, place in zip(lists, kept, strict=True)], np.int64
    )
    # A node whose VMs have no capacity has none.
    count[numbers.values["vm_capacity"][kept] == 0.0] = 0
    slots = _slots(file.attributes.get("max_vms"), count, ranges, file.source)
    drawn = draw_vms(len(kept), seed, ranges, count)
    capacity, unit_cost = (_resized(table, slots) for table in (drawn.vm_capacity, drawn.vm_unit_cost))
    vms = VmDraw(drawn.vm_count, capacity, unit_cost)
    for node, place in enumerate(kept):
        held = slice(0, int(vms.vm_count[node]))
        for key, table in (("vm_capacity", vms.vm_capacity), ("vm_unit_cost", vms.vm_unit_cost)):
            if not np.isnan(numbers.values[key][place]):
                table[node, held] = numbers.values[key][place]
    unknown = [place for place, known in zip(kept, count >= 0, strict=True) if not known]
    if 0 < len(unknown) < len(kept):
        numbers.say_gaps("VMs", [file.node_name(place) for place in unknown], DRAWN)
    return _filled(vms, lists, kinds, file.source)


def _filled(
    vms: VmDraw, lists: list[list[tuple[list[float], list[float]]] | None], kinds: tuple[str, ...], source: str
) -> VmDraw:
    """``vms`` with the numbers of those that nodes list, of all kinds."""
    if len(kinds) > 1 and None in lists:
        raise ScenarioError(f"{source}: has several kinds of 'resources'; every node must list its VMs under 'vms'")
    extra = np.zeros((2, *vms.vm_capacity.shape, len(kinds) - 1))
    for node, listed in enumerate(lists):
        if listed:
            table = np.array(listed)  # [VMs, capacity or unit cost, kinds]
            vms.vm_capacity[node, : len(listed)], vms.vm_unit_cost[node, : len(listed)] = table[:, :, 0].T
            extra[:, node, : len(listed)] = table[:, :, 1:].transpose(1, 0, 2)
    if len(kinds) == 1:
        return vms._replace(resources=kinds)
    return vms._replace(resources=kinds, extra_capacity=extra[0], extra_unit_cost=extra[1])


def _listed(numbers: FileNumbers, place: int, kinds: tuple[str, ...]) -> list[tuple[list[float], list[float]]] | None:
    """The VMs that a node lists, None if it does not."""
    value = numbers.file.nodes[place].get("vms")
    if value is None:
        return None
    where = f"{numbers.file.source}: {numbers.file.node_name(place)}"
    # GraphML holds text; GML reads a list of one as its only entry.
    entries = _parsed(value, where) if isinstance(value, str) else [value] if isinstance(value, dict) else value
    return vms_of({"vms": entries}, where, kinds)


def _parsed(text: str, where: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError):
        raise ScenarioError(
            f'{where}: \'vms\' is {shown(text)}; use JSON such as [{{"capacity": 500, "unit_cost": 50}}], or vm_count, '
            "vm_capacity and vm_unit_cost"
        ) from None


def _count(numbers: FileNumbers, place: int) -> int:
    """``vm_count`` of a node, -1 if the file has none."""
    value = numbers.values["vm_count"][place]
    if np.isnan(value):
        return -1
    if value != int(value):
        raise ScenarioError(
            f"{numbers.file.source}: {numbers.file.node_name(place)}: vm_count is {value}; use an integer"
        )
    return int(value)


def _slots(max_vms: Any, count: np.ndarray, ranges: ResourceRanges, source: str) -> int:
    """V: columns of the tables of VMs."""
    largest = max(int(count.max()), 1 if (count >= 0).all() else int(ranges.vms[1]))
    slots = largest if max_vms is None else max_vms
    if isinstance(slots, bool) or not isinstance(slots, int) or slots < largest:
        raise ScenarioError(
            f"{source}: 'max_vms' is {shown(max_vms)}, but nodes have up to {largest} VMs; raise or remove it"
        )
    check_vm_slots(slots, source)
    return slots


def _resized(table: np.ndarray, slots: int) -> np.ndarray:
    """``table`` [N, V] with ``slots`` columns; those that are cut off or added hold no VMs."""
    return np.pad(table, ((0, 0), (0, max(0, slots - table.shape[1]))))[:, :slots]
