"""The cheapest feasible embedding of one request at given prices, exactly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.search.both_ways import BothWays, make_both_ways, remember, search_both_ways
from nfv_torchrl.search.critical import Critical, add_overused, begin_request, make_critical
from nfv_torchrl.search.hosting import Hosting, make_hosting, match_hosts
from nfv_torchrl.search.labels import FOUND, NO_LIMIT, Labels, Search, make_labels, search_labels
from nfv_torchrl.search.narrow import Narrow, copy_walk, make_narrow, narrow_walk
from nfv_torchrl.search.togo import ToGo, best_start, fill_cost_to_go, fill_delay_to_go, make_to_go
from nfv_torchrl.search.walks import (
    CUT_SHORT,
    OVERFLOW,
    PlannedWalk,
    Prices,
    encode_walk,
    ends_at,
    make_problem,
    make_walk,
    unit_costs,
    walk_totals,
)
from nfv_torchrl.simulator.compiled import inlined, kernel, part, shared
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.tables import Tables

POOL = 4096
COLUMNS = 8
LARGEST = 4 << 30
"""Bytes that the labels of one search may take."""
PROOF = 1e-9
"""Share by which a walk may be dearer than a bound and yet be the cheapest, since sums were made in another order."""


@by_reference
class Scratch(NamedTuple):
    """What ``plan_cheapest`` writes to while it works; one for each thread."""

    cost: ToGo
    delay: ToGo
    labels: Labels
    critical: Critical
    back: BothWays
    hosting: Hosting
    walk: PlannedWalk
    vm_price: np.ndarray  # float64 [N, V, R], for callers that compute prices
    link_price: np.ndarray  # float64 [L]
    result: np.ndarray  # float64 [3]: priced cost ($), true cost ($), delay (ms) of the last plan; inf if none
    rounds: np.ndarray  # int64 [4]: requests that needed no, one, two, more label searches
    narrow: Narrow
    unproved: np.ndarray  # int64 [B]: requests of each environment whose answer is not proved the best, since counted
    cut: np.ndarray  # int64 [1]: 1 if the last answer is not


def make_scratch(
    tables: Tables,
    pool: int = POOL,
    columns: int = COLUMNS,
    allowed: int = NO_LIMIT,
    unproved: np.ndarray | None = None,
) -> Scratch:
    """Scratch arrays for any network and service of ``tables``.

    Args:
        tables: the simulator's tables.
        pool: labels that a search may hold.
        columns: critical resources that a search may track.
        allowed: labels that all searches of a request may use together.
        unproved: int64 [B] that counts requests which used them up, for every environment; needed with ``allowed``.
    """
    _, nodes, vms, kinds = tables.vm_capacity.shape
    links = tables.link_capacity.shape[1]
    functions = tables.load.shape[1]
    hosting = make_hosting(nodes, functions)
    labels = make_labels(nodes, functions, max(pool, 2 * vms + 2), columns)
    labels.allowed[0] = allowed
    return Scratch(
        cost=make_to_go(nodes, links, functions, hosting.barred),
        delay=make_to_go(nodes, links, functions, hosting.barred),
        labels=labels,
        critical=make_critical((nodes, vms, kinds), links, functions, columns),
        back=make_both_ways(tables),
        hosting=hosting,
        # A walk that repeats no node between two placements is no longer than this.
        walk=make_walk((functions + 1) * (nodes + 1) + functions),
        vm_price=np.zeros((nodes, vms, kinds)),
        link_price=np.zeros(links),
        result=np.full(3, np.inf),
        rounds=np.zeros(4, np.int64),
        narrow=make_narrow(tables),
        unproved=np.zeros(1, np.int64) if unproved is None else unproved,
        cut=np.zeros(1, np.int64),
    )


def grow_scratch(tables: Tables, scratch: Scratch) -> Scratch:
    """Twice the labels or twice the critical resources of ``scratch``, whichever it lacked.

    Raises:
        ScenarioError: a request needs more than ``LARGEST`` bytes of labels.
    """
    pool, columns = scratch.labels.cost.size, scratch.critical.resource.size
    if scratch.critical.tracked[0] == columns:
        columns *= 2
    else:
        pool *= 2
    size = pool * (columns + 12) * 8
    if size > LARGEST:
        raise ScenarioError(
            f"the exact search of a request needs more than {LARGEST >> 30} GB of memory, since very many walks are as "
            "good as each other; give the planner a limit (+method.NAME.planner.labels=100000), or use method=greedy "
            "here, or a smaller network or load"
        )
    grown = make_scratch(tables, pool, columns, int(scratch.labels.allowed[0]), scratch.unproved)
    grown.rounds[:] = scratch.rounds
    return grown


@kernel
def plan_cheapest(world, b, prices, scratch, plan):
    """Find the walk of least priced cost among all that Algorithm 3 of the paper would accept.

    A walk may cross a link and use a VM several times as long as the sums fit what is offered. Exact: no feasible walk
    is cheaper at the given prices (but for rounding). Only where the scratch allows a number of labels, and the request
    has used them, it may be another walk, or none, and ``scratch.unproved`` counts it.

    Args:
        world: the simulator's ``World``; only read.
        b: environment whose request is planned.
        prices: ``Prices``, any non-negative numbers.
        scratch: ``Scratch`` of the tables. ``scratch.result`` tells priced cost, true cost and delay afterwards.
        plan: receives the actions, int64 [max_steps].

    Returns:
        Number of actions, 0 if the request has no feasible walk, OVERFLOW (-1) if the scratch must grow.
    """
    return plan_within(world, b, prices, np.inf, scratch, plan)


@shared
def plan_within(world, b, prices, limit, scratch, plan):
    """``plan_cheapest`` among the walks whose priced cost ($) is at most ``limit``; 0 also if there is none of them.

    The cost of any walk that is known to be feasible is such a limit. It leaves the cheapest walk as it is, and saves
    the search the labels that could not become part of it.
    """
    problem = make_problem(world, b, prices)
    scratch.result[:] = np.inf
    scratch.labels.limit[0] = limit
    steps = cheapest_walk(problem, scratch)
    if steps != OVERFLOW:
        scratch.unproved[b if scratch.cut[0] > 0 else 0] += scratch.cut[0]
    if steps <= 0:
        return steps
    encode_walk(scratch.walk, steps, problem.vm_offered.shape[1], plan)
    scratch.result[0], scratch.result[2] = walk_totals(problem, prices, scratch.walk, steps)
    scratch.result[1] = walk_totals(problem, unit_costs(world, b), scratch.walk, steps)[0]
    return steps


@part
def cheapest_walk(problem, scratch):
    """Steps of the best walk, written to ``scratch.walk``.

    The walk that is cheapest without delay limit and without counting repeated use is a by-product of the bounds; if
    it happens to be feasible, it is the answer. Otherwise labels are searched, tracking the resources that the walk
    before overused, until the walk found overuses none.
    """
    critical = scratch.critical
    _begin(problem, scratch)
    if problem.distinct and not match_hosts(problem, scratch.hosting):
        return 0
    fill_cost_to_go(problem, scratch.cost)
    start = problem.ingress if problem.ingress >= 0 else best_start(problem, scratch.cost)
    if start < 0 or (problem.ingress >= 0 and scratch.cost.value[0, start] == np.inf):
        return 0
    if problem.ingress >= 0 and scratch.cost.value[0, start] > scratch.labels.limit[0]:
        return 0
    steps = _follow(problem, scratch.cost, scratch.walk, start)
    prices = Prices(problem.vm_price, problem.link_price)
    in_time = walk_totals(problem, prices, scratch.walk, steps)[1] <= problem.budget
    outcome = _track(problem, scratch, steps)
    if outcome == OVERFLOW:
        return OVERFLOW
    if outcome == 0 and in_time:
        scratch.rounds[0] += 1
        return steps
    fill_delay_to_go(problem, scratch.delay)
    return _search_labels(
        problem,
        scratch,
        Search(problem, scratch.cost.value, scratch.delay.value, scratch.labels, critical, scratch.hosting.barred),
    )


@part
def cheapest_walk_within(problem, scratch, cost_to_go, delay_to_go):
    """``cheapest_walk`` where bounds are known already: float64 [F + 1, N], $ and ms, never above what it takes."""
    if problem.ingress >= 0 and cost_to_go[0, problem.ingress] == np.inf:
        return 0
    _begin(problem, scratch)
    if problem.distinct and not match_hosts(problem, scratch.hosting):
        return 0
    return _search_labels(
        problem,
        scratch,
        Search(problem, cost_to_go, delay_to_go, scratch.labels, scratch.critical, scratch.hosting.barred),
    )


@inlined
def _begin(problem, scratch):
    """Forget the request before."""
    begin_request(problem, scratch.critical)
    scratch.cut[0] = 0
    scratch.labels.size[0] = 0
    scratch.labels.spent[0] = 0


@shared
def _search_labels(problem, scratch, search):
    """Steps of the best walk; with all labels used, of the best one known."""
    if not problem.distinct:
        steps = _search_in_rounds(problem, scratch, search)
    else:
        steps = search_both_ways(search, scratch.back, scratch.narrow, scratch.walk, scratch.rounds)
    if steps != CUT_SHORT:
        return steps
    if problem.distinct:
        steps = copy_walk(scratch.back.best, scratch.back.known[0], scratch.walk)
    else:
        steps = narrow_walk(search, scratch.narrow, scratch.walk)
    cost = walk_totals(problem, Prices(problem.vm_price, problem.link_price), scratch.walk, steps)[0]
    # No walk is cheaper than the label that the search would have taken next.
    if steps == 0 or cost > scratch.labels.found[0] * (1.0 + PROOF):
        scratch.cut[0] = 1
    return steps


@part
def _search_in_rounds(problem, scratch, search):
    """Steps of the best walk by label searches, each with the resources that the walk before overused."""
    searches = 0
    while True:
        searches += 1
        found, steps = search_labels(search, scratch.walk)
        if found in (OVERFLOW, CUT_SHORT):
            return found
        outcome = _track(problem, scratch, steps) if found == FOUND else 0
        if outcome == OVERFLOW:
            return OVERFLOW
        if outcome == 0:
            scratch.rounds[min(searches, 3)] += 1
            return steps


@part
def _track(problem, scratch, steps):
    """Make critical what the walk overused: resources, or the number of steps. 0 if nothing was."""
    if problem.distinct:
        return remember(problem, scratch.walk, steps, scratch.critical)
    outcome = add_overused(problem, scratch.walk, steps, scratch.critical)
    if steps > problem.max_steps:
        scratch.critical.tracked[1] = 1
        return 1 if outcome == 0 else outcome
    return outcome


@part
def _follow(problem, to_go, walk, start):
    """The walk that the bounds describe; ``start``: the ingress, or where the first function goes if that is free."""
    node = start
    i = 0
    steps = 0
    if problem.ingress < 0:
        walk.node[0], walk.link[0], walk.vm[0] = node, -1, to_go.place_vm[0, node]
        i = 1
        steps = 1
    while i < problem.functions or not ends_at(problem, node):
        after = to_go.node[i, node]
        walk.node[steps] = after
        walk.link[steps] = to_go.link[i, node]
        walk.vm[steps] = -1
        if to_go.places[i, node]:
            walk.vm[steps] = to_go.place_vm[i, after]
            i += 1
        node = after
        steps += 1
    return steps
