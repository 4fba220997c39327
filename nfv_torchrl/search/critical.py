"""What a label search tracks within one walk: resources that a walk could overuse, and nodes it could use twice.

Nothing is tracked at first. What the walk that a round found has overused is tracked from then on, see ``labels``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import count_vms, split_vm, vm_resource
from nfv_torchrl.search.walks import OVERFLOW
from nfv_torchrl.simulator.compiled import inlined
from nfv_torchrl.simulator.references import by_reference


@by_reference
class Critical(NamedTuple):
    """Resources whose use within one walk is tracked: kind r of VM v is number v R + r, link l is number N V R + l."""

    tracked: np.ndarray  # int64 [2]: how many resources; 1 if the number of steps is tracked too
    resource: np.ndarray  # int64 [C]
    column: np.ndarray  # int64 [N * V * R + L], place among the critical ones, -1: not critical
    used: np.ndarray  # int64 [N * V * R + L], scratch, all zero between uses
    tail: np.ndarray  # int64 [F + 1, R], ledger units that the functions from i on take together
    link_tail: np.ndarray  # int64 [F + 1], most that a link can be asked for once i functions are placed
    nodes: np.ndarray  # uint64 [W], one bit a node: those on which a walk remembers to have a function
    holds: np.ndarray  # bool [N, C], whether a walk on a node remembers its use of a critical one; with ``distinct``


def make_critical(shape: tuple[int, int, int], links: int, functions: int, columns: int) -> Critical:
    """Scratch for at most ``columns`` critical resources; ``shape``: nodes, VMs of each, kinds."""
    resources = shape[0] * shape[1] * shape[2] + links
    return Critical(
        tracked=np.zeros(2, np.int64),
        resource=np.zeros(columns, np.int64),
        column=np.full(resources, -1),
        used=np.zeros(resources, np.int64),
        tail=np.zeros((functions + 1, shape[2]), np.int64),
        link_tail=np.zeros(functions + 1, np.int64),
        nodes=np.zeros(words_for(shape[0]), np.uint64),
        holds=np.zeros((shape[0], columns), np.bool_),
    )


def words_for(nodes: int) -> int:
    """Words of 64 bits that hold one bit for each node."""
    return (nodes + 63) // 64


@inlined
def begin_request(problem, critical):
    """Forget the critical resources of the request before."""
    for c in range(critical.tracked[0]):
        critical.column[critical.resource[c]] = -1
    critical.tracked[:] = 0
    if problem.distinct:
        critical.nodes[:] = 0
        critical.holds[:] = False
    fill_tails(problem, critical)


@inlined
def fill_tails(problem, critical):
    """What the rest of a chain can take at most."""
    last = problem.functions
    critical.tail[last, :] = 0
    critical.link_tail[last] = problem.rate_units[last]
    for i in range(last - 1, -1, -1):
        for kind in range(problem.kinds):
            critical.tail[i, kind] = critical.tail[i + 1, kind] + problem.load_units[i, kind]
        # Between two placements a best walk visits no node twice before the hop that places, so it takes a link at most
        # twice there, once after the last.
        critical.link_tail[i] = critical.link_tail[i + 1] + 2 * problem.rate_units[i]


@inlined
def vm_number(problem, node, vm, kind):
    """Number of a kind of a VM among the resources, see ``Critical``."""
    return vm_resource(node, vm, problem.vm_offered.shape[1]) * problem.kinds + kind


@inlined
def link_number(problem, link):
    """Number of a link among them."""
    nodes, vms, kinds = problem.vm_offered.shape
    return count_vms(nodes, vms) * kinds + link


@inlined
def offered_of(problem, resource):
    """Ledger units that ``resource`` offers, a kind of a VM or a link."""
    first_link = link_number(problem, 0)
    if resource >= first_link:
        return problem.link_offered[resource - first_link]
    node, vm = split_vm(resource // problem.kinds, problem.vm_offered.shape[1])
    return problem.vm_offered[node, vm, resource % problem.kinds]


@inlined
def add_overused(problem, walk, steps, critical):
    """Mark every resource that the walk takes more of than is offered as critical.

    Returns:
        0 if nothing was overused, 1 if resources were added, OVERFLOW if there was no room for them.
    """
    i = 0
    outcome = 0
    for j in range(steps):
        if walk.link[j] >= 0:
            critical.used[link_number(problem, walk.link[j])] += problem.rate_units[i]
        if walk.vm[j] >= 0:
            for kind in range(problem.kinds):
                critical.used[vm_number(problem, walk.node[j], walk.vm[j], kind)] += problem.load_units[i, kind]
            i += 1
    for j in range(steps):
        if walk.link[j] >= 0:
            outcome = _mark(problem, critical, link_number(problem, walk.link[j]), outcome)
        if walk.vm[j] >= 0:
            for kind in range(problem.kinds):
                number = vm_number(problem, walk.node[j], walk.vm[j], kind)
                outcome = _mark(problem, critical, number, outcome)
    return outcome


@inlined
def _mark(problem, critical, resource, outcome):
    """Make ``resource`` critical if it is overused, and forget its use. Returns the new outcome."""
    if critical.used[resource] > offered_of(problem, resource):
        column = critical.tracked[0]
        if column < critical.resource.size:
            critical.resource[column] = resource
            critical.column[resource] = column
            critical.tracked[0] += 1
            outcome = 1 if outcome == 0 else outcome
        else:
            outcome = OVERFLOW
    critical.used[resource] = 0
    return outcome


@inlined
def node_bit(node):
    return np.uint64(1) << np.uint64(node % 64)
