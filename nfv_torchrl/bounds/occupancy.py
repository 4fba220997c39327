"""The linear programme behind the bounds on acceptance: who may be let in so that no resource ever overflows.

A resource here is a sum of many, such as all VMs of the network together, or all links that leave a set of nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, vstack

from nfv_torchrl.errors import ScenarioError


class Columns(NamedTuple):
    """C groups of requests that the programme need not tell apart.

    ``until``: the first slot without them; C slots after the horizon are all the same. ``value``: what one accepted
    request is worth (1 to count them). ``law``: which of M laws of lifetimes each follows.
    """

    start: np.ndarray  # int64 [C], arrival slot
    until: np.ndarray  # int64 [C], departure slot, at most the horizon T
    size: np.ndarray  # float64 [C], requests in the group
    demand: np.ndarray  # float64 [K, C], what each of them takes of each of K resources
    value: np.ndarray  # float64 [C]
    law: np.ndarray  # int64 [C]


class Occupancy(NamedTuple):
    """A relaxation's solution and what it proves."""

    accepted: np.ndarray  # float64 [C], requests of each group let in by the optimum
    bound: float  # no admission is worth more, by weak duality and so whatever the solver's tolerance
    prices: np.ndarray  # float64 [K, T], the dual prices that prove it: worth per unit of each resource and slot
    count_price: float  # dual value of the required number, 0 without one


def maximise_value(
    columns: Columns, capacity: np.ndarray, keep: np.ndarray, at_least: float | None = None
) -> Occupancy:
    """Maximise the worth of the accepted requests while occupancy stays within capacity in every slot.

    The occupancy of a resource in slot t is keep[t] times that of slot t - 1, less what leaves, plus what arrives; for
    the requests of each law apart, whose occupancies share the capacity.

    Args:
        columns: the requests, in groups.
        capacity: float64 [K, T].
        keep: float64 [M, T] in [0, 1], the share of last slot's occupancy that is still there, by law; 1 if ``until``
            says all.
        at_least: number of requests to be accepted in all, if required. ``bound`` then holds for the Lagrangian, in
            which every request is worth ``count_price`` more.

    Raises:
        ScenarioError: HiGHS found no solution (``at_least`` may ask for more than fits).
    """
    groups, (resources, slots) = columns.start.size, capacity.shape
    if groups == 0:
        return Occupancy(np.zeros(0), 0.0, np.zeros(capacity.shape), 0.0)
    unit = np.maximum(columns.demand.max(axis=1), 1e-12)  # keeps the coefficients near 1
    laws, cells = len(keep), resources * slots
    balance = _balance(columns, keep, unit)
    room = (capacity / unit[:, None]).ravel()
    limits, most = [], []
    if at_least is not None:
        limits.append(coo_array(np.r_[-np.ones(groups), np.zeros(laws * cells)][None, :]))
        most.append([-at_least])
    if laws > 1:  # several laws share each resource
        cell = np.tile(np.arange(cells), laws)
        entries = (np.ones(laws * cells), (cell, groups + np.arange(laws * cells)))
        limits.append(coo_array(entries, shape=(cells, groups + laws * cells)))
        most.append(room)
    upper = np.r_[columns.size, room if laws == 1 else np.full(laws * cells, np.inf)]
    shared = {"A_ub": vstack(limits).tocsr(), "b_ub": np.concatenate(most)} if limits else {}
    result = linprog(
        np.r_[-columns.value, np.zeros(laws * cells)],
        A_eq=balance,
        b_eq=np.zeros(laws * cells),
        bounds=np.stack([np.zeros_like(upper), upper], axis=1),
        method="highs-ds",
        # Presolve would substitute the chains of slots away and fill the matrix: 50 times slower.
        options={"presolve": False},
        **shared,
    )
    if result.status != 0:
        raise ScenarioError(f"HiGHS gave up on the admission programme: {result.message}")
    marginals = result.upper.marginals[groups:] if laws == 1 else result.ineqlin.marginals[-cells:]
    prices = np.maximum(-marginals.reshape(resources, slots), 0.0) / unit[:, None]
    count_price = max(-float(result.ineqlin.marginals[0]), 0.0) if at_least is not None else 0.0
    worth = columns._replace(value=columns.value + count_price)
    return Occupancy(result.x[:groups], certificate(worth, capacity, keep, prices), prices, count_price)


def certificate(columns: Columns, capacity: np.ndarray, keep: np.ndarray, prices: np.ndarray) -> float:
    """What the accepted requests can be worth at most, proved by any ``prices`` float64 [K, T] >= 0.

    Whoever is let in either pays for the capacity it occupies or is worth more than that: the worth of all is at most
    the price of all capacity plus the surplus of those who have one.
    """
    if np.all(keep == 1.0):
        charge = price_of_stay(prices, columns.start, columns.until)
    else:
        charge = np.stack([expected_price(prices, each) for each in keep])[columns.law, :, columns.start].T
    surplus = columns.value - (columns.demand * charge).sum(axis=0)
    return float((capacity * prices).sum() + (columns.size * np.maximum(surplus, 0.0)).sum())


def price_of_stay(prices: np.ndarray, start: np.ndarray, until: np.ndarray) -> np.ndarray:
    """Price float64 [K, R] of a unit of each resource from slot ``start`` to before slot ``until``, int64 [R] each."""
    total = np.zeros((prices.shape[0], prices.shape[1] + 1))
    np.cumsum(prices, axis=1, out=total[:, 1:])
    return total[:, until] - total[:, start]


def expected_price(prices: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Price float64 [K, T] of a stay that begins in slot t and goes on from slot to slot with probability ``keep``."""
    ahead = prices.copy()
    for t in range(prices.shape[1] - 2, -1, -1):
        ahead[:, t] += keep[t + 1] * ahead[:, t + 1]
    return ahead


def _balance(columns: Columns, keep: np.ndarray, unit: np.ndarray) -> coo_array:
    """Rows [M K T]: arrivals - departures + keep * occupancy before - occupancy now = 0."""
    groups, (laws, slots), resources = columns.start.size, keep.shape, unit.size
    slot = np.arange(slots)
    rows, cols, values = [], [], []
    for law in range(laws):
        group = np.flatnonzero(columns.law == law)
        leaving = group[columns.until[group] < slots]
        for k in range(resources):
            demand = columns.demand[k] / unit[k]
            row = (law * resources + k) * slots
            first = groups + row  # variable of this resource's occupancy in slot 0
            rows += [row + columns.start[group], row + columns.until[leaving], row + slot, row + slot[1:]]
            cols += [group, leaving, first + slot, first + slot[:-1]]
            values += [demand[group], -demand[leaving], -np.ones(slots), keep[law, 1:]]
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
    count = laws * resources * slots
    return coo_array(entries, shape=(count, groups + count)).tocsr()
