"""Exact search where functions of a request stand on different nodes: label searches from both ends in turn.

The bounds of ``togo`` let a walk go to and fro between two nodes, so where nodes or links are nearly full they are far
below what a request costs. Each round here is a label search (``labels``) in which walks remember only critical nodes
with a function, and what they took of critical links, that only on nodes where it is needed (as in dynamic ng-routes,
Roberti and Mingozzi 2014). What the walks found do that they must not is remembered from then on. Rounds go from the
ingress and from the egress in turn: what a round has found out of every node is a bound for the next one, which goes
the other way. Forgetting only adds walks that are none, so a bound stays one, and the first walk from the ingress that
breaks nothing is the cheapest. After two rounds a narrow search finds a feasible walk, mostly a good one. Rounds then
look only for cheaper ones, and if there is none, that is the answer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.search.critical import fill_tails, link_number, node_bit
from nfv_torchrl.search.labels import FOUND, NONE, UNFINISHED, Search, search_labels, trace
from nfv_torchrl.search.narrow import copy_walk, narrow_walk
from nfv_torchrl.search.raising import ROUNDING, raise_bounds
from nfv_torchrl.search.togo import ToGo, fill_cost_to_go, fill_delay_to_go, make_to_go
from nfv_torchrl.search.walks import (
    CUT_SHORT,
    OVERFLOW,
    PlannedWalk,
    Prices,
    Problem,
    make_walk,
    walk_totals,
)
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.tables import Tables

BROKEN = 3
"""Outcome of a round: the walk found breaks something that was forgotten."""
SHORT_ROUND = 4096
"""Labels after which a round ends unfinished, since the other way may be far shorter. Doubled where both are not."""
SECOND = 2
"""Round after which a narrow search (``narrow``) looks for a walk that the rounds must beat: most end before."""
CLOSE = 0.01
"""Share by which other walks of a round may be dearer than the one found, for what they break to be remembered too."""


@by_reference
class BothWays(NamedTuple):
    """The request seen from its end, and bounds that rounds improve; one for each thread."""

    forth: np.ndarray  # float64 [F + 1, N], $: cost to go of walks from the ingress
    most: np.ndarray  # float64 [F + 1, N], $, scratch
    barred: np.ndarray  # bool [F, N], functions that must not stand on a node
    cost: ToGo  # of walks from the egress
    delay: ToGo
    rate: np.ndarray  # float64 [F + 1], and so on as in ``Problem``, in the order in which these walks meet it
    rate_units: np.ndarray
    load: np.ndarray
    load_units: np.ndarray
    work: np.ndarray
    fixed_delay: np.ndarray
    neighbour_link: np.ndarray
    other: PlannedWalk
    best: PlannedWalk  # the cheapest feasible walk known
    known: np.ndarray  # int64 [1], its steps; 0: none is


def make_both_ways(tables: Tables) -> BothWays:
    """Scratch for any network and request of ``tables``."""
    nodes, links, functions = tables.vm_capacity.shape[1], tables.link_capacity.shape[1], tables.load.shape[1]
    barred = np.zeros((functions, nodes), np.bool_)
    return BothWays(
        forth=np.zeros((functions + 1, nodes)),
        most=np.zeros((functions + 1, nodes)),
        barred=barred,
        cost=make_to_go(nodes, links, functions, barred),
        delay=make_to_go(nodes, links, functions, barred),
        rate=np.zeros(tables.rate.shape[1:]),
        rate_units=np.zeros(tables.rate_units.shape[1:], np.int64),
        load=np.zeros(tables.load.shape[1:]),
        load_units=np.zeros(tables.load_units.shape[1:], np.int64),
        work=np.zeros(tables.work.shape[1:]),
        fixed_delay=np.zeros(tables.fixed_delay.shape[1:]),
        neighbour_link=np.zeros(tables.neighbour_link.shape[1:], tables.neighbour_link.dtype),
        other=make_walk((functions + 1) * (nodes + 1) + functions),
        best=make_walk((functions + 1) * (nodes + 1) + functions),
        known=np.zeros(1, np.int64),
    )


@part
def search_both_ways(search, back, narrow, walk, rounds):
    """Steps of the cheapest walk on whose nodes no two functions meet, into ``walk``; 0: there is none.

    OVERFLOW if there is no room. CUT_SHORT if the request has used all its labels: ``back.best`` has the best walk
    known then, of ``back.known`` steps.
    """
    limit = search.labels.limit[0]
    steps = _search(search, back, narrow, walk, rounds)
    search.labels.limit[0] = limit
    return steps


@part
def _search(search, back, narrow, walk, rounds):
    problem, labels, critical = search.problem, search.labels, search.critical
    for i in range(problem.functions + 1):
        for node in range(problem.nodes):
            back.forth[i, node] = search.cost_to_go[i, node]
    forth = Search(problem, back.forth, search.delay_to_go, labels, critical, search.barred)
    reverse = _turn(problem, search.barred, back)
    fill_cost_to_go(reverse, back.cost)
    fill_delay_to_go(reverse, back.delay)
    other_way = Search(reverse, back.cost.value, back.delay.value, labels, critical, back.barred)
    labels.most[0] = SHORT_ROUND
    back.known[0] = 0
    searches, fruitless = 0, 0
    while True:
        searches += 1
        from_ingress = searches % 2 == 1
        turn, bounds = (forth, back.cost.value) if from_ingress else (other_way, back.forth)
        outcome, steps = _round(turn, bounds, back, walk)
        if outcome == OVERFLOW:
            return OVERFLOW
        if outcome == CUT_SHORT:
            _look_narrowly(forth, back, narrow)
            return CUT_SHORT
        if outcome == NONE or (outcome == FOUND and from_ingress):
            rounds[min(searches, 3)] += 1
            # None is cheaper than the one known, if there is one.
            return copy_walk(back.best, back.known[0], walk) if outcome == NONE else steps
        if searches == SECOND:
            _look_narrowly(forth, back, narrow)
        fruitless = 0 if outcome == BROKEN else fruitless + 1
        if fruitless == 2:
            labels.most[0] *= 2
            fruitless = 0


@part
def _look_narrowly(search, back, narrow):
    """Look for a walk cheaper than the best one known; from then on labels are kept only of walks cheaper than it."""
    problem = search.problem
    steps = narrow_walk(search, narrow, back.other)
    if steps > 0:
        cost = walk_totals(problem, Prices(problem.vm_price, problem.link_price), back.other, steps)[0]
        search.labels.limit[0] = min(search.labels.limit[0], cost * (1.0 - ROUNDING))
        back.known[0] = copy_walk(back.other, steps, back.best)


@part
def _round(search, bounds, back, walk):
    """One label search, after which ``bounds`` of the other way are better. Returns (outcome, steps)."""
    problem, labels, critical = search.problem, search.labels, search.critical
    fill_tails(problem, critical)
    found, steps = search_labels(search, walk)
    if found == FOUND:
        outcome = remember(problem, walk, steps, critical)
        if outcome == OVERFLOW:
            return OVERFLOW, 0
        if outcome == 1:
            _remember_others(problem, labels, back.other, critical)
            found = BROKEN
    if found in (FOUND, BROKEN, UNFINISHED):
        raise_bounds(labels, problem, search.cost_to_go, bounds, back.most)
    return found, steps


@part
def _turn(problem, barred, back):
    """The request as walks from its egress meet it: last function first, links in the other direction."""
    last = problem.functions
    for i in range(last + 1):
        back.rate[i] = problem.rate[last - i]
        back.rate_units[i] = problem.rate_units[last - i]
    for i in range(last):
        back.work[i] = problem.work[last - 1 - i]
        back.fixed_delay[i] = problem.fixed_delay[last - 1 - i]
        for kind in range(problem.kinds):
            back.load[i, kind] = problem.load[last - 1 - i, kind]
            back.load_units[i, kind] = problem.load_units[last - 1 - i, kind]
        for node in range(problem.nodes):
            back.barred[i, node] = barred[last - 1 - i, node]
    neighbour_link = problem.neighbour_link
    if problem.full_duplex:
        neighbour_link = back.neighbour_link
        for node in range(problem.nodes):
            for k in range(problem.degree[node]):
                neighbour_link[node, k] = problem.neighbour_link[node, k] ^ 1
    return Problem(
        problem.net,
        problem.nodes,
        problem.links,
        last,
        problem.kinds,
        problem.egress,
        problem.ingress,
        problem.colocation,
        problem.distinct,
        problem.full_duplex,
        problem.one_rate,
        problem.budget,
        problem.max_steps + 1,  # a function on the egress may take a step here that it does not take there
        back.rate,
        back.rate_units,
        back.load,
        back.load_units,
        back.work,
        back.fixed_delay,
        problem.degree,
        problem.neighbour,
        neighbour_link,
        problem.vm_count,
        problem.vm_speed,
        problem.link_delay,
        problem.link_speed,
        problem.delay_to,
        problem.vm_offered,
        problem.link_offered,
        problem.vm_price,
        problem.link_price,
    )


@part
def _remember_others(problem, labels, other, critical):
    """Have remembered also what other walks have forgotten that are as cheap as the one found or little dearer."""
    for node in range(problem.nodes):
        label = labels.first[problem.functions, node]
        while label >= 0:
            if labels.cost[label] <= labels.found[0] * (1.0 + CLOSE):
                steps = trace(labels, label, other)
                remember(problem, other, steps, critical)
            label = labels.following[label]


@part
def remember(problem, walk, steps, critical):
    """Have remembered what the walk should not have forgotten.

    Returns:
        0 if it keeps to all rules, 1 if it does not, OVERFLOW if there was no room.
    """
    met = _remember_nodes(walk, steps, critical)
    outcome = _remember_links(problem, walk, steps, critical)
    if steps > problem.max_steps:
        critical.tracked[1] = 1
        met = True
    return 1 if met and outcome == 0 else outcome


@part
def _remember_nodes(walk, steps, critical):
    """Have nodes on which the walk places two functions remembered; whether there were any."""
    found = False
    for j in range(steps):
        for k in range(j):
            if walk.vm[j] >= 0 and walk.vm[k] >= 0 and walk.node[j] == walk.node[k]:
                critical.nodes[walk.node[j] // 64] |= node_bit(walk.node[j])
                found = True
    return found


@part
def _remember_links(problem, walk, steps, critical):
    """Have the use of links that the walk takes more of than is offered remembered between its first and last use."""
    i = 0
    for j in range(steps):
        if walk.link[j] >= 0:
            critical.used[link_number(problem, walk.link[j])] += problem.rate_units[i]
        i += walk.vm[j] >= 0
    outcome = 0
    for j in range(steps):
        link = walk.link[j]
        if link < 0:
            continue
        number = link_number(problem, link)
        if critical.used[number] > problem.link_offered[link]:
            column = _column(critical, number)
            if column < 0:
                outcome = OVERFLOW
            else:
                outcome = 1 if outcome == 0 else outcome
                _hold(walk, j, steps, critical, column)
        critical.used[number] = 0
    return outcome


@part
def _column(critical, number):
    """Column of a critical resource, which it is given if it has none; -1 if there is none left."""
    column = critical.column[number]
    if column < 0 and critical.tracked[0] < critical.resource.size:
        column = critical.tracked[0]
        critical.resource[column] = number
        critical.column[number] = column
        critical.tracked[0] += 1
    return column


@part
def _hold(walk, first, steps, critical, column):
    """Have the nodes between step ``first``, which uses a link, and the last that uses it remember its use."""
    final = first
    for j in range(first + 1, steps):
        if walk.link[j] == walk.link[first]:
            final = j
    for j in range(first, final):
        critical.holds[walk.node[j], column] = True
