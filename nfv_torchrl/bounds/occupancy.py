"""The linear programme behind the bounds on acceptance: who may be let in so that no resource ever overflows.

A resource here is a sum of many, such as all VMs of the network together, or all links that leave a set of nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

from nfv_torchrl.errors import ScenarioError


class Columns(NamedTuple):
    """C groups of requests that the programme need not tell apart.

    ``until``: the first slot without them; C slots after the horizon are all the same. ``value``: what one accepted
    request is worth (1 to count them).
    """

    start: np.ndarray  # int64 [C], arrival slot
    until: np.ndarray  # int64 [C], departure slot, at most the horizon T
    size: np.ndarray  # float64 [C], requests in the group
    demand: np.ndarray  # float64 [K, C], what each of them takes of each of K resources
    value: np.ndarray  # float64 [C]


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

    The occupancy of a resource in slot t is keep[t] times that of slot t - 1, less what leaves, plus what arrives.

    Args:
        columns: the requests, in groups.
        capacity: float64 [K, T].
        keep: float64 [T] in [0, 1], the share of last slot's occupancy that is still there; 1 if ``until`` says all.
        at_least: number of requests to be accepted in all, if required. ``bound`` then holds for the Lagrangian, in
            which every request is worth ``count_price`` more.

    Raises:
        ScenarioError: HiGHS found no solution (``at_least`` may ask for more than fits).
    """
    groups, (resources, slots) = columns.start.size, capacity.shape
    if groups == 0:
        return Occupancy(np.zeros(0), 0.0, np.zeros(capacity.shape), 0.0)
    unit = np.maximum(columns.demand.max(axis=1), 1e-12)  # keeps the coefficients near 1
    balance = _balance(columns, keep, unit)
    number = {}
    if at_least is not None:
        row = np.r_[-np.ones(groups), np.zeros(resources * slots)]
        number = {"A_ub": coo_array(row[None, :]).tocsr(), "b_ub": np.array([-at_least])}
    upper = np.r_[columns.size, (capacity / unit[:, None]).ravel()]
    result = linprog(
        np.r_[-columns.value, np.zeros(resources * slots)],
        A_eq=balance,
        b_eq=np.zeros(resources * slots),
        bounds=np.stack([np.zeros_like(upper), upper], axis=1),
        method="highs-ds",
        # Presolve would substitute the chains of slots away and fill the matrix: 50 times slower.
        options={"presolve": False},
        **number,
    )
    if result.status != 0:
        raise ScenarioError(f"HiGHS gave up on the admission programme: {result.message}")
    prices = np.maximum(-result.upper.marginals[groups:].reshape(resources, slots), 0.0) / unit[:, None]
    count_price = max(-float(result.ineqlin.marginals[0]), 0.0) if number else 0.0
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
        charge = expected_price(prices, keep)[:, columns.start]
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
    """Rows [K T]: arrivals - departures + keep * occupancy before - occupancy now = 0."""
    groups, slots, resources = columns.start.size, keep.size, unit.size
    group, slot = np.arange(groups), np.arange(slots)
    leaves = columns.until < slots
    rows, cols, values = [], [], []
    for k in range(resources):
        demand = columns.demand[k] / unit[k]
        first = groups + k * slots  # variable of this resource's occupancy in slot 0
        rows += [k * slots + columns.start, k * slots + columns.until[leaves], k * slots + slot, k * slots + slot[1:]]
        cols += [group, group[leaves], first + slot, first + slot[:-1]]
        values += [demand, -demand[leaves], -np.ones(slots), keep[1:]]
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
    return coo_array(entries, shape=(resources * slots, groups + resources * slots)).tocsr()
