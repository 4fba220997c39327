"""What the rest of a chain costs where a walk cannot leave any more: exact packing on the VMs of the egress.

The bounds of ``togo`` ignore that functions share VMs. On the way that matters little, since there are other nodes. At
the egress it decides: a walk that arrives there places all that is left on that node's VMs, or is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.togo import relax_layer, seed_layer, weigh_links, weigh_places
from nfv_torchrl.search.walks import place_cost, vm_fits
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.steps import fits

MOST_TRIES = 10_000
"""Placements that are tried for one rest of a chain; beyond them its bound is what the parts cost, packed apart."""


class Packing(NamedTuple):
    """What ``pack_egress`` finds, and what it works in."""

    cost: np.ndarray  # float64 [F + 1], $: least for all functions from i on together, inf where they do not fit
    alone: np.ndarray  # float64 [F], $: least for a function by itself
    spent: np.ndarray  # float64 [F + 1]
    choice: np.ndarray  # int64 [F], VM that a function is on, -1: none
    left: np.ndarray  # int64 [V, R], ledger units


def make_packing(functions: int, vms: int, kinds: int) -> Packing:
    """Scratch for chains of at most ``functions`` on nodes of at most ``vms``."""
    return Packing(
        cost=np.zeros(functions + 1),
        alone=np.zeros(functions),
        spent=np.zeros(functions + 1),
        choice=np.zeros(functions, np.int64),
        left=np.zeros((vms, kinds), np.int64),
    )


@part
def pack_egress(problem, packing):
    """Fill ``packing.cost``: for each rest of the chain the least cost on the VMs of the egress, at the problem's
    prices."""
    last = problem.functions
    packing.cost[last] = 0.0
    for i in range(last - 1, -1, -1):
        packing.alone[i] = np.inf
        for vm in range(problem.vm_count[problem.egress]):
            if vm_fits(problem, problem.egress, vm, i):
                packing.alone[i] = min(packing.alone[i], place_cost(problem, problem.egress, vm, i))
        # The rest without i costs no less with i there, so this is a bound; mostly it is attained at once.
        bound = packing.alone[i] + packing.cost[i + 1]
        packing.cost[i] = _pack_from(problem, packing, i, bound) if bound < np.inf else np.inf


@part
def _pack_from(problem, packing, first, bound):
    """Least cost of the functions from ``first`` on, by depth-first search; no less than ``bound``."""
    for vm in range(packing.left.shape[0]):
        for kind in range(problem.kinds):
            packing.left[vm, kind] = problem.vm_offered[problem.egress, vm, kind]
    best = np.inf
    i, tries = first, 0
    packing.choice[i] = -1
    packing.spent[i] = 0.0
    while i >= first and best > bound:
        tries += 1
        if tries > MOST_TRIES:
            return bound
        if not _next_choice(problem, packing, i, best):
            i -= 1
        elif i == problem.functions - 1:
            best = packing.spent[i + 1]
        else:
            i += 1
            packing.choice[i] = -1
    return best


@part
def _next_choice(problem, packing, i, best):
    """Put function ``i`` on the next VM that has room, if the whole can still cost less than ``best``; else on none."""
    before = packing.choice[i]
    if before >= 0:
        for kind in range(problem.kinds):
            packing.left[before, kind] += problem.load_units[i, kind]
    packing.choice[i] = -1
    for vm in range(before + 1, problem.vm_count[problem.egress]):
        cost = packing.spent[i] + place_cost(problem, problem.egress, vm, i)
        room = cost + packing.cost[i + 1] < best
        for kind in range(problem.kinds):
            room = room and fits(packing.left[vm, kind], problem.load_units[i, kind])
        if room:
            for kind in range(problem.kinds):
                packing.left[vm, kind] -= problem.load_units[i, kind]
            packing.choice[i] = vm
            packing.spent[i + 1] = cost
            return True
    return False


@part
def fill_packed_cost(problem, to_go, packing):
    """``fill_cost_to_go``, but with what the rest of the chain really costs once the walk is at the egress."""
    if problem.egress >= 0:
        pack_egress(problem, packing)
    weigh_places(problem, to_go, False)
    for i in range(problem.functions, -1, -1):
        if i == problem.functions or not problem.one_rate:
            weigh_links(problem, to_go, i, False)
        seed_layer(problem, to_go, i)
        if problem.egress >= 0:
            to_go.value[i, problem.egress] = packing.cost[i]
            to_go.entering[problem.egress] = packing.cost[i]
        relax_layer(problem, to_go, i)
