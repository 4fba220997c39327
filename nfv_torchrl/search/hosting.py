"""Which functions may stand where, if each of a request needs a node of its own: a matching of functions to nodes.

Where few nodes have room for large functions, those nodes are not for small ones, and often there are too few. Bounds
that look at one function after the other see neither. A function is barred from a node if no matching of all functions
puts it there (Regin's filter of "all different", 1994), so no walk is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.walks import vm_fits
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.steps import fits


@by_reference
class Hosting(NamedTuple):
    """What ``match_hosts`` finds, and what it works in."""

    barred: np.ndarray  # bool [F, N]: functions that must not stand on a node, or have no room there
    function: np.ndarray  # int64 [N], function that is matched to a node, -1: none
    tried: np.ndarray  # bool [N]
    before: np.ndarray  # int64 [F], function that asks this one to move
    asked: np.ndarray  # int64 [F], node that it asks for
    queue: np.ndarray  # int64 [F]
    moves: np.ndarray  # bool [F, F + 1]: whether one can make another move, or (last) move with none of them moved


def make_hosting(nodes: int, functions: int) -> Hosting:
    """Scratch for chains of at most ``functions`` on at most ``nodes``."""
    return Hosting(
        barred=np.zeros((functions, nodes), np.bool_),
        function=np.zeros(nodes, np.int64),
        tried=np.zeros(nodes, np.bool_),
        before=np.zeros(functions, np.int64),
        asked=np.zeros(functions, np.int64),
        queue=np.zeros(functions, np.int64),
        moves=np.zeros((functions, functions + 1), np.bool_),
    )


@part
def match_hosts(problem, hosting):
    """Fill ``hosting.barred``. False if the functions cannot all stand on nodes of their own."""
    for node in range(problem.nodes):
        _bar_lacking(problem, hosting, node)
    hosting.function[:] = -1
    for i in range(problem.functions):
        if not _match(problem, hosting, i):
            return False
    _find_moves(problem, hosting)
    for node in range(problem.nodes):
        there = hosting.function[node]
        for i in range(problem.functions):
            if there >= 0 and i != there and not (hosting.moves[there, i] or hosting.moves[there, problem.functions]):
                hosting.barred[i, node] = True
    return True


@part
def _bar_lacking(problem, hosting, node):
    """Bar functions from a node that has no VM for them, or no links to come by and to go on by."""
    most = second = -1  # units that its links offer
    for k in range(problem.degree[node]):
        offered = problem.link_offered[problem.neighbour_link[node, k]]
        if offered > most:
            most, second = offered, most
        elif offered > second:
            second = offered
    for i in range(problem.functions):
        room = False
        for vm in range(problem.vm_count[node]):
            room = room or vm_fits(problem, node, vm, i)
        if room and 0 < i < problem.functions - 1 and not problem.full_duplex:
            low = min(problem.rate_units[i], problem.rate_units[i + 1])
            high = max(problem.rate_units[i], problem.rate_units[i + 1])
            room = fits(most, low + high) or (fits(most, high) and fits(second, low))
        hosting.barred[i, node] = not room


@part
def _match(problem, hosting, first):
    """Match function ``first`` to a node, others moving on where they must, breadth first; False if that cannot be."""
    hosting.tried[:] = False
    hosting.queue[0] = first
    hosting.before[first] = -1
    head, tail = 0, 1
    while head < tail:
        i = hosting.queue[head]
        head += 1
        for node in range(problem.nodes):
            if hosting.barred[i, node] or hosting.tried[node]:
                continue
            hosting.tried[node] = True
            other = hosting.function[node]
            if other >= 0:
                hosting.before[other] = i
                hosting.asked[other] = node
                hosting.queue[tail] = other
                tail += 1
                continue
            while i != first:
                hosting.function[node] = i
                node = hosting.asked[i]
                i = hosting.before[i]
            hosting.function[node] = first
            return True
    return False


@part
def _find_moves(problem, hosting):
    """Which functions each one can make move, over any number of others."""
    last = problem.functions
    moves = hosting.moves
    for i in range(last):
        for j in range(last + 1):
            moves[i, j] = False
        for node in range(problem.nodes):
            if not hosting.barred[i, node]:
                there = hosting.function[node]
                moves[i, there if there >= 0 else last] = True
    for k in range(last):
        for i in range(last):
            if moves[i, k]:
                for j in range(last + 1):
                    moves[i, j] = moves[i, j] or moves[k, j]
