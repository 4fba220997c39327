"""A good walk without proof: a limit for an exact search, and its answer where it may not go on.

A label search that extends only the cheapest few of the walks to a node with as many functions placed, and holds each
to every rule at every step. It misses walks, so that it may miss the best one, but its work is bounded. Where it finds
none the greedy walk of ``roaming`` is the answer. A request with ``distinct`` has one early: what it costs is a limit
that leaves out many labels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.critical import Critical, begin_request, make_critical
from nfv_torchrl.search.labels import FOUND, Labels, Search, make_labels, search_labels
from nfv_torchrl.search.roaming import Roaming, make_roaming, roam
from nfv_torchrl.search.walks import Prices, walk_totals
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.tables import Tables

WIDTH = 3
"""Walks that are extended of those to one node with as many functions placed."""
LEAST, LARGEST = 1024, 1 << 16
"""Labels that there is room for; where they are not enough there is no walk."""
STARTS = 10
"""Nodes at which the greedy rule tries the first function of a request with a free ingress, as ``greedy`` does."""


@by_reference
class Narrow(NamedTuple):
    """What ``narrow_walk`` works in; one for each thread."""

    labels: Labels
    critical: Critical
    roaming: Roaming


def make_narrow(tables: Tables) -> Narrow:
    """Scratch for any network and request of ``tables``."""
    _, nodes, vms, kinds = tables.vm_capacity.shape
    functions, most_degree = tables.load.shape[1], tables.neighbour.shape[2]
    # Every label that is extended opens one at each neighbour, and one on each of their VMs.
    pool = WIDTH * (functions + 1) * nodes * (vms + (vms + 1) * most_degree)
    labels = make_labels(nodes, functions, min(max(pool, LEAST), LARGEST), 1)
    labels.width[0] = WIDTH
    critical = make_critical((nodes, vms, kinds), tables.link_capacity.shape[1], functions, 1)
    return Narrow(labels, critical, make_roaming(tables, STARTS))


@part
def narrow_walk(search, narrow, walk):
    """Steps of a feasible walk that costs at most ``search.labels.limit``, written to ``walk``; 0 if none was found.

    Args:
        search: the request and its bounds; its labels and critical resources stay.
        narrow: ``Narrow``.
        walk: receives the walk.
    """
    problem, labels, critical = search.problem, narrow.labels, narrow.critical
    begin_request(problem, critical)
    critical.tracked[1] = 1
    critical.nodes[:] = ~np.uint64(0)
    labels.extended[:] = 0
    labels.most[0] = labels.cost.size
    labels.limit[0] = search.labels.limit[0]
    found, steps = search_labels(
        Search(problem, search.cost_to_go, search.delay_to_go, labels, critical, search.barred), walk
    )
    if found == FOUND:
        return steps
    prices = Prices(problem.vm_price, problem.link_price)
    steps = roam(problem, prices, narrow.roaming)
    if walk_totals(problem, prices, narrow.roaming.best, steps)[0] > labels.limit[0]:
        return 0
    return copy_walk(narrow.roaming.best, steps, walk)


@part
def copy_walk(walk, steps, into):
    """Copy a walk; returns its steps."""
    for j in range(steps):
        into.node[j] = walk.node[j]
        into.link[j] = walk.link[j]
        into.vm[j] = walk.vm[j]
    return steps
