"""Exact label-setting search over (node, functions placed) with cost, delay and the use of scarce resources.

A label is a walk from the ingress. One label dominates another at the same node and function when it is no worse in
cost and delay and leaves at least as much of every *critical* resource, one that an earlier round of the search was
found to have used beyond what is offered. With no critical resource that is the usual shortest path problem with a
resource constraint; adding resources only where they were overused keeps the search small and exact (decremental state
space relaxation, Righini and Salani 2008). Where functions may not share a node, a walk likewise remembers only
critical nodes, ones on which an earlier round has put two; ``both_ways`` says how its rounds go.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.critical import Critical, link_number, node_bit, offered_of, vm_number, words_for
from nfv_torchrl.search.walks import (
    CUT_SHORT,
    OVERFLOW,
    Problem,
    ends_at,
    hop_cost,
    hop_delay,
    link_fits,
    may_leave,
    may_stay,
    place_cost,
    place_delay,
    vm_fits,
)
from nfv_torchrl.simulator.compiled import inlined, part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

FOUND = 1
NONE = 0
UNFINISHED = 2
NO_LIMIT = int(np.iinfo(np.int64).max)
"""As many labels as there is memory for."""
DEEPER_FIRST = 1e-12
"""Share of its bound by which a label goes earlier for every function that it has placed, with ``distinct``."""


@by_reference
class Labels(NamedTuple):
    """Pool of P labels, the lists of labels of each (node, function) and the heap of open ones."""

    cost: np.ndarray  # float64 [P]
    delay: np.ndarray  # float64 [P], ms
    node: np.ndarray  # int64 [P]
    placed: np.ndarray  # int64 [P], functions placed
    steps: np.ndarray  # int64 [P]
    parent: np.ndarray  # int64 [P]
    link: np.ndarray  # int64 [P], link of the last step, -1: none
    vm: np.ndarray  # int64 [P], VM of the last step, -1: only forwarded
    following: np.ndarray  # int64 [P], next label of the same list
    alive: np.ndarray  # bool [P]
    usage: np.ndarray  # int64 [P, C], ledger units taken of the critical resources
    nodes: np.ndarray  # uint64 [P, W], one bit a node: those with a function it remembers; with ``distinct`` only
    first: np.ndarray  # int64 [F + 1, N], head of a list, -1: empty
    heap_key: np.ndarray  # float64 [P]
    heap_label: np.ndarray  # int64 [P]
    size: np.ndarray  # int64 [2]: labels in the pool, labels in the heap
    limit: np.ndarray  # float64 [1], $: labels whose walks cost more are not kept; inf: all are
    most: np.ndarray  # int64 [1]: labels after which a search is left unfinished; with ``distinct`` only
    allowed: np.ndarray  # int64 [1]: labels that all searches of a request may use together
    spent: np.ndarray  # int64 [1]: those that its searches before this one have used
    width: np.ndarray  # int64 [1]: labels of one list that are extended, each held to all rules; 0: see ``narrow``
    extended: np.ndarray  # int64 [F + 1, N], how many were; with a width only
    found: np.ndarray  # float64 [1], $: what the walk found costs; of a search that was left before: at least
    moved: np.ndarray  # float64 [F + 1, N], $: least cost of a label that came by a hop and placed nothing with it


class Search(NamedTuple):
    """One search: the request, lower bounds on what is still to come, and the scratch it works in."""

    problem: Problem
    cost_to_go: np.ndarray  # float64 [F + 1, N], $
    delay_to_go: np.ndarray  # float64 [F + 1, N], ms
    labels: Labels
    critical: Critical
    barred: np.ndarray  # bool [F, N], functions that must not stand on a node; heeded with ``distinct``


def make_labels(nodes: int, functions: int, pool: int, columns: int) -> Labels:
    """Scratch for at most ``pool`` labels."""
    return Labels(
        cost=np.zeros(pool),
        delay=np.zeros(pool),
        node=np.zeros(pool, np.int64),
        placed=np.zeros(pool, np.int64),
        steps=np.zeros(pool, np.int64),
        parent=np.zeros(pool, np.int64),
        link=np.zeros(pool, np.int64),
        vm=np.zeros(pool, np.int64),
        following=np.zeros(pool, np.int64),
        alive=np.zeros(pool, np.bool_),
        usage=np.zeros((pool, columns), np.int64),
        nodes=np.zeros((pool, words_for(nodes)), np.uint64),
        first=np.zeros((functions + 1, nodes), np.int64),
        heap_key=np.zeros(pool),
        heap_label=np.zeros(pool, np.int64),
        size=np.zeros(2, np.int64),
        limit=np.full(1, np.inf),
        most=np.zeros(1, np.int64),
        allowed=np.full(1, NO_LIMIT),
        spent=np.zeros(1, np.int64),
        width=np.zeros(1, np.int64),
        extended=np.zeros((functions + 1, nodes), np.int64),
        found=np.zeros(1),
        moved=np.zeros((functions + 1, nodes)),
    )


@part
def search_labels(search, walk):
    """Cheapest walk within the delay that does not overuse a critical resource, into ``walk``.

    Returns:
        (FOUND, steps), (NONE, 0) if there is no such walk, (OVERFLOW, 0) if the pool is too small, (UNFINISHED, 0) with
        ``distinct`` after ``labels.most``, (CUT_SHORT, 0) if the request has used ``labels.allowed``.
    """
    problem, labels = search.problem, search.labels
    labels.spent[0] += labels.size[0]
    labels.first[:] = -1
    labels.size[:] = 0
    if problem.distinct:
        labels.moved[:] = np.inf
    label = _take(labels)
    labels.cost[label] = 0.0
    labels.delay[label] = 0.0
    labels.node[label] = problem.ingress
    labels.placed[label] = 0
    labels.steps[label] = 0
    labels.parent[label] = -1
    for c in range(search.critical.tracked[0]):
        labels.usage[label, c] = 0
    labels.nodes[label, :] = 0
    if problem.ingress >= 0:
        _list_and_open(labels, label, search.cost_to_go[0, problem.ingress])
    elif not _open_everywhere(search, label):
        return OVERFLOW, 0
    while labels.size[1] > 0:
        if problem.distinct and labels.size[0] > labels.most[0]:
            labels.found[0] = labels.heap_key[0]
            return UNFINISHED, 0
        if labels.spent[0] + labels.size[0] > labels.allowed[0]:
            labels.found[0] = labels.heap_key[0]
            return CUT_SHORT, 0
        label = _pop(labels)
        if not labels.alive[label] or (labels.width[0] > 0 and not _in_width(labels, label)):
            continue
        if labels.placed[label] == problem.functions and ends_at(problem, labels.node[label]):
            labels.found[0] = labels.cost[label]
            return FOUND, trace(labels, label, walk)
        if not _expand(search, label):
            return OVERFLOW, 0
    return NONE, 0


@part
def _open_everywhere(search, label):
    """Open every VM that can take the first function of a request with a free ingress; False if the pool is full."""
    problem, labels = search.problem, search.labels
    for node in range(problem.nodes):
        if labels.size[0] + problem.vm_count[node] >= labels.cost.size:
            return False
        for vm in range(problem.vm_count[node]):
            if vm_fits(problem, node, vm, 0):
                _open(search, label, node, -1, vm)
    return True


@inlined
def _expand(search, label):
    """Open every step that can follow ``label``; False if the pool is full."""
    problem, labels, cost_to_go = search.problem, search.labels, search.cost_to_go
    node = labels.node[label]
    i = labels.placed[label]
    # Room for all that one expansion can open, so that no check is needed below.
    if labels.size[0] + problem.vm_count[node] >= labels.cost.size:
        return False
    if i < problem.functions and may_stay(problem, node, i):
        for vm in range(problem.vm_count[node]):
            if vm_fits(problem, node, vm, i):
                _open(search, label, node, -1, vm)
    if not may_leave(problem, node, i):
        return True
    for k in range(problem.degree[node]):
        link = problem.neighbour_link[node, k]
        after = problem.neighbour[node, k]
        if not link_fits(problem, link, i):
            continue
        if labels.size[0] + problem.vm_count[after] + 1 >= labels.cost.size:
            return False
        if cost_to_go[i, after] < np.inf:
            _open(search, label, after, link, -1)
        if i < problem.functions and cost_to_go[i + 1, after] < np.inf:
            for vm in range(problem.vm_count[after]):
                if vm_fits(problem, after, vm, i):
                    _open(search, label, after, link, vm)
    return True


@inlined
def _open(search, parent, node, link, vm):
    """Extend ``parent`` by one step unless the result is infeasible or dominated."""
    problem, labels, critical = search.problem, search.labels, search.critical
    i = labels.placed[parent]
    if problem.distinct and vm >= 0 and search.barred[i, node]:
        return
    placed = i + 1 if vm >= 0 else i
    cost = labels.cost[parent]
    step_delay = 0.0
    if link >= 0:
        cost += hop_cost(problem, link, i)
        step_delay = hop_delay(problem, link, i)
    if vm >= 0:
        cost += place_cost(problem, node, vm, i)
        step_delay += place_delay(problem, node, vm, i)
    # Before all checks: a walk that may not go on from here without a placement may do so with one.
    if problem.distinct and (vm < 0 or placed == problem.functions) and cost < labels.moved[placed, node]:
        labels.moved[placed, node] = cost
    delay = labels.delay[parent] + step_delay
    # The bound was summed in another order, so it gets the tolerance once more; the delay itself does not.
    if delay > problem.budget or delay + search.delay_to_go[placed, node] > problem.budget + DELAY_TOLERANCE:
        return
    bound = cost + search.cost_to_go[placed, node]
    if bound == np.inf or bound > labels.limit[0]:
        return
    steps = labels.steps[parent] + 1
    if critical.tracked[1] > 0 and steps + problem.functions - placed > problem.max_steps:
        return
    if labels.width[0] > 0 and not _has_room(search, parent, node, link, vm):
        return
    label = labels.size[0]
    labels.cost[label] = cost
    labels.delay[label] = delay
    labels.placed[label] = placed
    labels.steps[label] = steps
    if problem.distinct:
        if not _meet(search, parent, label, node, vm):
            return
        # Of walks that cost the same those that have placed more go first: where many do, that is most of the work.
        bound -= DEEPER_FIRST * placed * (bound + 1.0)
    if critical.tracked[0] > 0 and not _use(search, parent, label, node, link, vm):
        return
    if not _keep(search, label, node):
        return
    _take(labels)
    labels.node[label] = node
    labels.parent[label] = parent
    labels.link[label] = link
    labels.vm[label] = vm
    _list_and_open(labels, label, bound)


@inlined
def _in_width(labels, label):
    """Count ``label`` among those of its list that are extended; False if there are enough of them."""
    placed, node = labels.placed[label], labels.node[label]
    labels.extended[placed, node] += 1
    return labels.extended[placed, node] <= labels.width[0]


@part
def _has_room(search, parent, node, link, vm):
    """Whether link and VM have room for one more step, beside all that the walk to ``parent`` takes of them."""
    problem, labels = search.problem, search.labels
    i = labels.placed[parent]
    rates = problem.rate_units[i]
    label = parent
    while link >= 0 and labels.parent[label] >= 0:
        before = labels.parent[label]
        if labels.link[label] == link:
            rates += problem.rate_units[labels.placed[before]]
        label = before
    if link >= 0 and not fits(problem.link_offered[link], rates):
        return False
    for kind in range(problem.kinds if vm >= 0 else 0):
        load = problem.load_units[i, kind]
        label = parent
        while labels.parent[label] >= 0:
            if labels.vm[label] == vm and labels.node[label] == node:
                load += problem.load_units[labels.placed[label] - 1, kind]
            label = labels.parent[label]
        if not fits(problem.vm_offered[node, vm, kind], load):
            return False
    return True


@inlined
def _meet(search, parent, label, node, vm):
    """Remember critical nodes with a function; False if a second one is put on one of them."""
    labels, critical = search.labels, search.critical.nodes
    word, bit = node // 64, node_bit(node)
    if vm >= 0 and labels.nodes[parent, word] & bit:
        return False
    for w in range(labels.nodes.shape[1]):
        labels.nodes[label, w] = labels.nodes[parent, w]
    if vm >= 0:
        labels.nodes[label, word] |= bit & critical[word]
    return True


@inlined
def _use(search, parent, label, node, link, vm):
    """Book the step's use of critical resources; False if one of them has not enough left."""
    problem, labels, critical = search.problem, search.labels, search.critical
    for c in range(critical.tracked[0]):
        labels.usage[label, c] = labels.usage[parent, c]
    i = labels.placed[parent]
    if link >= 0:
        c = critical.column[link_number(problem, link)]
        if c >= 0:
            labels.usage[label, c] += problem.rate_units[i]
            if not fits(problem.link_offered[link], labels.usage[label, c]):
                return False
    if vm >= 0:
        for kind in range(problem.kinds):
            c = critical.column[vm_number(problem, node, vm, kind)]
            if c >= 0:
                labels.usage[label, c] += problem.load_units[i, kind]
                if not fits(problem.vm_offered[node, vm, kind], labels.usage[label, c]):
                    return False
    if problem.distinct:
        for c in range(critical.tracked[0]):
            if not critical.holds[node, c]:
                labels.usage[label, c] = 0
    return True


@inlined
def _keep(search, label, node):
    """False if a label of the same node and function dominates ``label``; those it dominates are dropped."""
    labels = search.labels
    placed = labels.placed[label]
    before = -1
    other = labels.first[placed, node]
    while other >= 0:
        after = labels.following[other]
        if _dominates(search, other, label):
            return False
        if _dominates(search, label, other):
            labels.alive[other] = False
            if before < 0:
                labels.first[placed, node] = after
            else:
                labels.following[before] = after
        else:
            before = other
        other = after
    return True


@inlined
def _dominates(search, a, b):
    """Whether every completion of label ``b`` also completes ``a``, no dearer."""
    problem, labels, critical = search.problem, search.labels, search.critical
    if labels.cost[a] > labels.cost[b] or labels.delay[a] > labels.delay[b]:
        return False
    if critical.tracked[1] > 0 and labels.steps[a] > labels.steps[b]:
        return False
    placed = labels.placed[a]
    if problem.distinct and placed < problem.functions:
        for word in range(labels.nodes.shape[1]):
            if labels.nodes[a, word] & ~labels.nodes[b, word]:
                return False
    for c in range(critical.tracked[0]):
        if labels.usage[a, c] > labels.usage[b, c]:
            resource = critical.resource[c]
            # More than the rest of a walk can need is as good as unused.
            if resource >= link_number(problem, 0):
                need = critical.link_tail[placed]
            else:
                need = critical.tail[placed, resource % problem.kinds]
            if offered_of(problem, resource) - labels.usage[a, c] < need:
                return False
    return True


@inlined
def trace(labels, label, walk):
    """Steps that lead to ``label``, into ``walk``; returns their number."""
    steps = labels.steps[label]
    for j in range(steps - 1, -1, -1):
        walk.node[j] = labels.node[label]
        walk.link[j] = labels.link[label]
        walk.vm[j] = labels.vm[label]
        label = labels.parent[label]
    return steps


@inlined
def _take(labels):
    label = labels.size[0]
    labels.size[0] += 1
    return label


@inlined
def _list_and_open(labels, label, key):
    """Put a new label at the head of its list and into the heap, where the least ``key`` comes first."""
    node, placed = labels.node[label], labels.placed[label]
    labels.alive[label] = True
    labels.following[label] = labels.first[placed, node]
    labels.first[placed, node] = label
    hole = labels.size[1]
    labels.size[1] += 1
    while hole > 0:
        above = (hole - 1) // 2
        if labels.heap_key[above] <= key:
            break
        labels.heap_key[hole] = labels.heap_key[above]
        labels.heap_label[hole] = labels.heap_label[above]
        hole = above
    labels.heap_key[hole] = key
    labels.heap_label[hole] = label


@inlined
def _pop(labels):
    """Take the label with the least key out of the heap."""
    top = labels.heap_label[0]
    labels.size[1] -= 1
    size = labels.size[1]
    key, label = labels.heap_key[size], labels.heap_label[size]
    hole = 0
    while 2 * hole + 1 < size:
        below = 2 * hole + 1
        if below + 1 < size and labels.heap_key[below + 1] < labels.heap_key[below]:
            below += 1
        if labels.heap_key[below] >= key:
            break
        labels.heap_key[hole] = labels.heap_key[below]
        labels.heap_label[hole] = labels.heap_label[below]
        hole = below
    labels.heap_key[hole] = key
    labels.heap_label[hole] = label
    return top
