"""What a label search from one end of a request tells that from the other: better bounds on what is still to come."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.search.walks import hop_cost, link_fits, may_stay, place_cost, vm_fits
from nfv_torchrl.simulator.compiled import part

ROUNDING = 1e-9
"""Share by which a bound is lowered, for sums that were made in another order."""


@part
def raise_bounds(labels, problem, own, other, most):
    """Raise the bounds ``other`` of walks from the other end by what the search for ``problem`` has found out.

    From a node on the other search goes where this one came from. The cheapest way there that this search knows is a
    bound, unless there is one that it has not looked at. That goes on from a label which was open, whose cost and bound
    together were at least ``labels.found``. On the way from there the bound can have fallen by more than the steps
    cost, since bounds that were learned know of what some walks have used up; ``most`` says where it was highest.

    Args:
        labels: of the search, ended or left unfinished.
        problem: what it searched for.
        own: float64 [F + 1, N], $: the bounds that it used.
        other: float64 [F + 1, N], $.
        most: float64 [F + 1, N], scratch.
    """
    least = labels.found[0] * (1.0 - ROUNDING)
    _raise_along_steps(problem, own, most)
    for placed in range(1, problem.functions + 1):
        for node in range(problem.nodes):
            known = min(labels.moved[placed, node] * (1.0 - ROUNDING), least - most[placed, node])
            if own[placed, node] < np.inf and known > other[problem.functions - placed, node]:
                other[problem.functions - placed, node] = known


@part
def _raise_along_steps(problem, own, most):
    """Fill ``most``: of every state the highest bound of any from which steps lead to it, less what these cost."""
    for placed in range(problem.functions + 1):
        for node in range(problem.nodes):
            most[placed, node] = own[placed, node] if own[placed, node] < np.inf else -np.inf
        if placed > 0:
            for node in range(problem.nodes):
                _raise_by_placing(problem, most, placed, node)
        changed = True
        while changed:
            changed = False
            for node in range(problem.nodes):
                for k in range(problem.degree[node]):
                    after, link = problem.neighbour[node, k], problem.neighbour_link[node, k]
                    if link_fits(problem, link, placed):
                        left = most[placed, node] - hop_cost(problem, link, placed)
                        if left > most[placed, after]:
                            most[placed, after] = left
                            changed = True


@part
def _raise_by_placing(problem, most, placed, node):
    """The same of steps from ``node`` that place the function before ``placed``."""
    i = placed - 1
    if may_stay(problem, node, i):
        _raise_at(problem, most, placed, node, most[i, node])
    for k in range(problem.degree[node]):
        link = problem.neighbour_link[node, k]
        if link_fits(problem, link, i):
            _raise_at(problem, most, placed, problem.neighbour[node, k], most[i, node] - hop_cost(problem, link, i))


@part
def _raise_at(problem, most, placed, node, left):
    for vm in range(problem.vm_count[node]):
        if vm_fits(problem, node, vm, placed - 1):
            most[placed, node] = max(most[placed, node], left - place_cost(problem, node, vm, placed - 1))
