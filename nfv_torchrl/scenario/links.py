"""Links as a file lists them (parallel ones, loops, either direction) made into the links of a substrate."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np


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
        warnings.warn(f"{source}: dropped links from a node to itself, at nodes {nodes}", stacklevel=2)
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
