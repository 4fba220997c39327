"""Links as a file lists them (parallel ones, loops, either direction) made into the links of a substrate."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError, ScenarioWarning


class Links(NamedTuple):
    """Undirected links: ``ends`` int64 [L, 2], ``capacity`` (Mbit/s), ``delay`` (ms), ``unit_cost`` float64 [L]."""

    ends: np.ndarray
    capacity: np.ndarray
    delay: np.ndarray
    unit_cost: np.ndarray


def merge_links(links: Links, source: str) -> Links:
    """The simple graph's links: u < v, sorted, parallel ones merged.

    Of parallel links the capacities add, the smallest delay and the smallest unit cost stay. Links from a node to
    itself are dropped with a warning that names ``source``.
    """
    ends = np.sort(np.asarray(links.ends, np.int64).reshape(-1, 2), axis=1)
    proper = ends[:, 0] != ends[:, 1]
    if not proper.all():
        nodes = sorted(set(ends[~proper, 0].tolist()))
        warnings.warn(f"{source}: dropped links from a node to itself, at nodes {nodes}", ScenarioWarning, stacklevel=2)
    unique, group = np.unique(ends[proper], axis=0, return_inverse=True)
    group = group.reshape(-1)
    capacity = np.zeros(len(unique))
    delay = np.full(len(unique), np.inf)
    unit_cost = np.full(len(unique), np.inf)
    np.add.at(capacity, group, np.asarray(links.capacity, np.float64)[proper])
    with np.errstate(invalid="ignore"):  # a NaN stays one, for the substrate to refuse
        np.minimum.at(delay, group, np.asarray(links.delay, np.float64)[proper])
        np.minimum.at(unit_cost, group, np.asarray(links.unit_cost, np.float64)[proper])
    return Links(unique, capacity, delay, unit_cost)


DIRECTED = ("pairs", "merge")


def has_way_back(ends: np.ndarray) -> bool:
    """Whether some arc of ``ends`` int64 [E, 2], from source to target, has another in the other direction."""
    arcs = {(u, v) for u, v in ends.tolist() if u != v}
    return not arcs.isdisjoint({(v, u) for u, v in arcs})


def pair_arcs(arcs: Links, rule: str, source: str, name_of: Callable[[int], str]) -> Links:
    """The undirected links of a directed file: each stands for the arcs from u to v and those from v to u.

    With ``rule`` ``pairs`` the arcs of both directions must have the same numbers, which the links take. With ``merge``
    parallel arcs are merged as links are, then a link takes the smaller capacity, the larger delay and the larger unit
    cost of its directions; an arc without one back becomes a link. NaN stands for a number that is not known.

    Args:
        arcs: the file's arcs, ``ends`` from source to target.
        rule: ``pairs`` or ``merge``.
        source: the file, for messages.
        name_of: what messages call the arc of a number.

    Raises:
        ScenarioError: arcs that do not pair up.
    """
    ends = np.asarray(arcs.ends, np.int64).reshape(-1, 2)
    numbers = np.stack(arcs[1:], axis=1)
    directions: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
    for arc, (u, v) in enumerate(ends.tolist()):
        directions.setdefault((min(u, v), max(u, v)), ([], []))[u > v].append(arc)
    kept: list[tuple[tuple[int, int], np.ndarray]] = []
    for pair, (there, back) in directions.items():
        if rule == "merge":
            sides = [_merge_parallel(numbers[side]) for side in (there, back) if side]
            kept.append((pair, _worse(*sides) if len(sides) == 2 else sides[0]))
            continue
        if pair[0] != pair[1] and not _agree(numbers[there], numbers[back]):
            flaw = "its way back has other numbers" if there and back else "there is no arc back"
            raise ScenarioError(
                f"{source}: is directed, and of {name_of((there or back)[0])} {flaw}; links serve both directions, so "
                "correct the file or set substrate.directed=merge (smaller capacity, larger delay and unit cost)"
            )
        kept += [(pair, numbers[arc]) for arc in there]
    table = np.array([row for _, row in kept], np.float64).reshape(-1, 3)
    return Links(np.array([pair for pair, _ in kept], np.int64).reshape(-1, 2), *table.T)


def _agree(there: np.ndarray, back: np.ndarray) -> bool:
    """Whether both directions' numbers, float64 [n, 3], are the same in some order."""
    if there.shape != back.shape:
        return False
    return np.array_equal(there[np.lexsort(there.T)], back[np.lexsort(back.T)], equal_nan=True)


def _merge_parallel(numbers: np.ndarray) -> np.ndarray:
    """Capacity, delay and unit cost float64 [3] of parallel links [n, 3]; unknown if one of them is."""
    return np.array([numbers[:, 0].sum(), *numbers[:, 1:].min(axis=0)])


def _worse(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The smaller capacity, larger delay and unit cost of two directions, float64 [3]; the known one if one is not."""
    return np.array([np.fmin(one[0], other[0]), *np.fmax(one[1:], other[1:])])
