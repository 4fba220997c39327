"""Plans of NFVdeep under construction: one function a decision, routes between by shortest path, backtracking.

Compiled, one draft for each of B environments, against what their networks offer: nothing is reserved before the plan
is complete and played in the simulator, so a draft keeps books of its own earlier use.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import decode_action, encode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.search.walks import cheaper, hop_delay, make_problem, may_leave, place_delay, unit_costs
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.reasons import NO_REASON
from nfv_torchrl.simulator.state import OUTCOME
from nfv_torchrl.simulator.steps import fits
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE, Rules, Tables

OPEN, COMPLETE, REFUSED = 0, 1, 2


class FunctionNumbers(NamedTuple):
    """Numbers of the function in hand in the observation."""

    load: int  # of the largest
    rate: int  # of the largest
    delay: int  # left, of the tolerable
    functions: int  # left, of the longest chain


AT = columns(FunctionNumbers)


class Options(NamedTuple):
    """How plans are made: routes by link cost instead of delay, backtracks a request, whether it may be refused."""

    by_cost: bool
    backtracks: int
    may_refuse: bool


class Drafts(NamedTuple):
    """B plans under construction."""

    state: np.ndarray  # int64 [B]: OPEN, COMPLETE or REFUSED
    placed: np.ndarray  # int64 [B], functions placed
    node: np.ndarray  # int64 [B], where the walk is
    elapsed: np.ndarray  # float64 [B], ms
    steps: np.ndarray  # int64 [B], actions written
    backtracks: np.ndarray  # int64 [B]
    action: np.ndarray  # int64 [B, J]
    link: np.ndarray  # int64 [B, J], link used by each action, -1 for none
    vm_used: np.ndarray  # int64 [B, N, V, R], ledger units that the draft itself uses
    link_used: np.ndarray  # int64 [B, L]
    choice: np.ndarray  # int64 [B, F], node of each placed function
    before_steps: np.ndarray  # int64 [B, F], and what was so before it was placed
    before_node: np.ndarray  # int64 [B, F]
    before_elapsed: np.ndarray  # float64 [B, F]
    excluded: np.ndarray  # bool [B, F, N], nodes that backtracking has ruled out for a function
    distance: np.ndarray  # float64 [B, N], routes from the current node
    delay: np.ndarray  # float64 [B, N], ms
    hops: np.ndarray  # int64 [B, N]
    via_node: np.ndarray  # int64 [B, N]
    via_link: np.ndarray  # int64 [B, N]
    closed: np.ndarray  # bool [B, N]
    vm: np.ndarray  # int64 [B, N], VM that would take the next function
    mask: np.ndarray  # bool [B, N + 1], nodes that may be chosen, and to refuse
    flat: np.ndarray  # float32 [B, 4 N + 4], see ``NFVdeepEnv``


def make_drafts(tables: Tables, rules: Rules, batch: int) -> Drafts:
    """Room for ``batch`` drafts on the networks of ``tables``."""
    _, nodes, vms, kinds = tables.vm_capacity.shape
    links, functions = tables.link_capacity.shape[1], tables.load.shape[1]

    def whole(*shape: int) -> np.ndarray:
        return np.zeros((batch, *shape), np.int64)

    def real(*shape: int) -> np.ndarray:
        return np.zeros((batch, *shape))

    def flag(*shape: int) -> np.ndarray:
        return np.zeros((batch, *shape), np.bool_)

    return Drafts(
        state=whole(),
        placed=whole(),
        node=whole(),
        elapsed=real(),
        steps=whole(),
        backtracks=whole(),
        action=whole(rules.max_steps),
        link=whole(rules.max_steps),
        vm_used=whole(nodes, vms, kinds),
        link_used=whole(links),
        choice=whole(functions),
        before_steps=whole(functions),
        before_node=whole(functions),
        before_elapsed=real(functions),
        excluded=flag(functions, nodes),
        distance=real(nodes),
        delay=real(nodes),
        hops=whole(nodes),
        via_node=whole(nodes),
        via_link=whole(nodes),
        closed=flag(nodes),
        vm=whole(nodes),
        mask=flag(nodes + 1),
        flat=np.zeros((batch, 4 * nodes + len(AT)), np.float32),
    )


# --------------------------------------------------------------------------------------------- routes and nodes


@part
def _find_routes(problem, options, drafts, b):
    """Dijkstra from the current node over links that still carry the request; no route leads on from the egress."""
    distance, delay, hops, closed = drafts.distance[b], drafts.delay[b], drafts.hops[b], drafts.closed[b]
    start, i = drafts.node[b], drafts.placed[b]
    distance[:] = np.inf
    closed[:] = False
    distance[start] = 0.0
    delay[start] = 0.0
    hops[start] = 0
    while True:
        node = -1
        least = np.inf
        for n in range(problem.nodes):
            if not closed[n] and distance[n] < least:
                node, least = n, distance[n]
        if node < 0:
            return
        closed[node] = True
        if not may_leave(problem, node, i):
            continue
        for k in range(problem.degree[node]):
            after = problem.neighbour[node, k]
            link = problem.neighbour_link[node, k]
            if not fits(problem.link_offered[link] - drafts.link_used[b, link], problem.rate_units[i]):
                continue
            hop = hop_delay(problem, link, i)
            weight = problem.link_price[link] if options.by_cost else hop
            if distance[node] + weight < distance[after]:
                distance[after] = distance[node] + weight
                delay[after] = delay[node] + hop
                hops[after] = hops[node] + 1
                drafts.via_node[b, after] = node
                drafts.via_link[b, after] = link


@part
def _has_room(problem, drafts, b, node, vm, i):
    """Whether a VM has room for function ``i`` beside what the draft itself uses."""
    for kind in range(problem.kinds):
        left = problem.vm_offered[node, vm, kind] - drafts.vm_used[b, node, vm, kind]
        if not fits(left, problem.load_units[i, kind]):
            return False
    return True


@part
def _cheapest_vm(problem, drafts, b, node, latest):
    """The cheapest VM of ``node`` with room for the next function that is done with it by ``latest`` ms, -1: none.

    ``latest`` counts from the arrival at the node.
    """
    i = drafts.placed[b]
    best = -1
    for vm in range(problem.vm_count[node]):
        if not _has_room(problem, drafts, b, node, vm, i):
            continue
        if place_delay(problem, node, vm, i) > latest:
            continue
        if best < 0 or cheaper(problem, node, vm, best, i):
            best = vm
    return best


@part
def _is_chosen(drafts, b, node, i):
    """Whether one of the first ``i`` functions stands on ``node``."""
    found = False
    for function in range(i):
        found = found or drafts.choice[b, function] == node
    return found


@part
def _find_nodes(problem, options, drafts, b):
    """Nodes that can take the next function, with their routes and VMs; returns how many."""
    mask, vm = drafts.mask[b], drafts.vm[b]
    i, here = drafts.placed[b], drafts.node[b]
    budget = problem.budget - 0.5 * DELAY_TOLERANCE  # sums in another order may differ by less
    _find_routes(problem, options, drafts, b)
    mask[:] = False
    count = 0
    for node in range(problem.nodes):
        if drafts.excluded[b, i, node] or drafts.distance[b, node] == np.inf:
            continue
        if problem.distinct and _is_chosen(drafts, b, node, i):
            continue
        if node == here and not (problem.colocation or problem.distinct or here == problem.egress):
            continue
        if drafts.steps[b] + max(drafts.hops[b, node], 1) > problem.max_steps:
            continue
        left = budget - drafts.elapsed[b] - drafts.delay[b, node] - problem.delay_to[node, problem.egress]
        vm[node] = _cheapest_vm(problem, drafts, b, node, left)
        if vm[node] >= 0:
            mask[node] = True
            count += 1
    return count


# ------------------------------------------------------------------------------------------------ doing, undoing


@part
def _go(problem, drafts, b, node, vm):
    """Write the route to ``node`` and, unless ``vm`` is -1, the next function on it there."""
    vms, i = problem.vm_offered.shape[1], drafts.placed[b]
    first = drafts.steps[b]
    hops = drafts.hops[b, node]
    steps = max(hops, 1)
    at = node
    for k in range(first + hops - 1, first - 1, -1):
        drafts.action[b, k] = encode_action(at, 0, 0, vms)
        drafts.link[b, k] = drafts.via_link[b, at]
        drafts.link_used[b, drafts.via_link[b, at]] += problem.rate_units[i]
        at = drafts.via_node[b, at]
    if hops == 0:
        drafts.link[b, first] = -1
    elapsed = drafts.elapsed[b] + drafts.delay[b, node]
    if vm >= 0:
        drafts.action[b, first + steps - 1] = encode_action(node, vm, 1, vms)
        for kind in range(problem.kinds):
            drafts.vm_used[b, node, vm, kind] += problem.load_units[i, kind]
        elapsed += place_delay(problem, node, vm, i)
    drafts.steps[b] = first + steps
    drafts.node[b] = node
    drafts.elapsed[b] = elapsed


@part
def _place(problem, drafts, b, node):
    """Place the next function on ``node``."""
    i = drafts.placed[b]
    drafts.choice[b, i] = node
    drafts.before_steps[b, i] = drafts.steps[b]
    drafts.before_node[b, i] = drafts.node[b]
    drafts.before_elapsed[b, i] = drafts.elapsed[b]
    _go(problem, drafts, b, node, drafts.vm[b, node])
    drafts.placed[b] = i + 1
    if i + 1 < problem.functions:
        drafts.excluded[b, i + 1] = False


@part
def _undo(problem, drafts, b):
    """Take the last placement back and rule its node out for that function."""
    vms = problem.vm_offered.shape[1]
    i = drafts.placed[b] - 1
    for k in range(drafts.before_steps[b, i], drafts.steps[b]):
        if drafts.link[b, k] >= 0:
            drafts.link_used[b, drafts.link[b, k]] -= problem.rate_units[i]
    last = drafts.action[b, drafts.steps[b] - 1]
    for kind in range(problem.kinds):
        drafts.vm_used[b, drafts.choice[b, i], decode_action(last, vms)[1], kind] -= problem.load_units[i, kind]
    drafts.steps[b] = drafts.before_steps[b, i]
    drafts.node[b] = drafts.before_node[b, i]
    drafts.elapsed[b] = drafts.before_elapsed[b, i]
    drafts.excluded[b, i, drafts.choice[b, i]] = True
    drafts.placed[b] = i
    drafts.backtracks[b] += 1


@part
def _finish(problem, options, drafts, b):
    """Route to the egress when all functions are placed; returns whether it could be reached in time."""
    egress = problem.egress
    if drafts.node[b] == egress:
        return True
    _find_routes(problem, options, drafts, b)
    if drafts.distance[b, egress] == np.inf or drafts.steps[b] + drafts.hops[b, egress] > problem.max_steps:
        return False
    if drafts.elapsed[b] + drafts.delay[b, egress] > problem.budget - 0.5 * DELAY_TOLERANCE:
        return False
    _go(problem, drafts, b, egress, -1)
    return True


@part
def _settle(problem, options, drafts, b):
    """Go on until a node is to be chosen, the plan is complete, or only to refuse is left.

    Where nothing fits, the last placement is undone, as often as ``options.backtracks`` allows.
    """
    while True:
        if drafts.placed[b] == problem.functions:
            if _finish(problem, options, drafts, b):
                drafts.state[b] = COMPLETE
                return
        elif _find_nodes(problem, options, drafts, b) > 0:
            drafts.mask[b, drafts.mask.shape[1] - 1] = options.may_refuse
            return
        if drafts.placed[b] == 0 or drafts.backtracks[b] >= options.backtracks:
            drafts.mask[b, :] = False
            drafts.mask[b, drafts.mask.shape[1] - 1] = True
            return
        _undo(problem, drafts, b)


# --------------------------------------------------------------------------------------------------- observation


@part
def _observe(problem, tables, drafts, b):
    """Write the observation: free VM capacity and bandwidth of every node, the function in hand, node and egress."""
    flat, net = drafts.flat[b], problem.net
    nodes = drafts.mask.shape[1] - 1
    flat[:] = 0.0
    most_vm, most_link = 1.0, 1.0
    for node in range(problem.nodes):
        free, total = 0.0, 0.0
        for vm in range(problem.vm_count[node]):
            free += problem.vm_offered[node, vm, 0] - drafts.vm_used[b, node, vm, 0]
            total += tables.vm_capacity[net, node, vm, 0]
        flat[node] = free / max(total, 1.0)
        most_vm = max(most_vm, total)
        free, total = 0.0, 0.0
        for k in range(problem.degree[node]):
            link = problem.neighbour_link[node, k]
            free += problem.link_offered[link] - drafts.link_used[b, link]
            total += tables.link_capacity[net, link]
        flat[nodes + node] = free / total
        most_link = max(most_link, total)
    # Shares of the largest node, so that amounts can be compared between nodes.
    for node in range(problem.nodes):
        total = 0.0
        for vm in range(problem.vm_count[node]):
            total += tables.vm_capacity[net, node, vm, 0]
        flat[node] *= total / most_vm
        total = 0.0
        for k in range(problem.degree[node]):
            total += tables.link_capacity[net, problem.neighbour_link[node, k]]
        flat[nodes + node] *= total / most_link
    base = 2 * nodes
    i = drafts.placed[b]
    if i < problem.functions:
        flat[base + AT.load] = problem.load[i, 0] / tables.largest_amount[0]
    flat[base + AT.rate] = problem.rate[i] / tables.largest_rate
    flat[base + AT.delay] = 1.0 - drafts.elapsed[b] / problem.budget
    flat[base + AT.functions] = (problem.functions - i) / tables.load.shape[1]
    flat[base + len(AT) + drafts.node[b]] = 1.0
    flat[base + len(AT) + nodes + problem.egress] = 1.0


# ------------------------------------------------------------------------------------------- begin, choose, answer


@part
def _begin(world, problem, options, drafts, b):
    drafts.state[b] = OPEN
    drafts.placed[b] = 0
    drafts.node[b] = problem.ingress
    drafts.elapsed[b] = 0.0
    drafts.steps[b] = 0
    drafts.backtracks[b] = 0
    drafts.vm_used[b] = 0
    drafts.link_used[b] = 0
    drafts.excluded[b, 0] = False
    _settle(problem, options, drafts, b)
    _observe(problem, world.tables, drafts, b)


@part
def _choose(world, problem, choice, options, drafts, b):
    nodes = drafts.mask.shape[1] - 1
    if choice < 0 or choice >= nodes or not drafts.mask[b, choice]:
        drafts.state[b] = REFUSED
        return
    _place(problem, drafts, b, choice)
    _settle(problem, options, drafts, b)
    if drafts.state[b] == OPEN:
        _observe(problem, world.tables, drafts, b)


@kernel
def begin_rows(world, rows, options, drafts):
    """Begin a draft for the request of every environment of ``rows``."""
    for b in rows:
        _begin(world, make_problem(world, b, unit_costs(world, b)), options, drafts, b)


@kernel
def choose_rows(world, rows, choices, options, drafts):
    """Put the next function of every draft of ``rows`` on the node in ``choices`` int64 [R]; N refuses."""
    for k in range(rows.size):
        b = rows[k]
        _choose(world, make_problem(world, b, unit_costs(world, b)), choices[k], options, drafts, b)


@part
def _rest(drafts, b):
    """Past the horizon there is only to refuse."""
    drafts.state[b] = OPEN
    drafts.mask[b, :] = False
    drafts.mask[b, drafts.mask.shape[1] - 1] = True
    drafts.flat[b] = 0.0


@part
def _begin_env(world, options, drafts, b):
    """Begin a draft for environment b's request in hand."""
    if world.env[b].done == 1:
        _rest(drafts, b)
        return
    _begin(world, make_problem(world, b, unit_costs(world, b)), options, drafts, b)


@kernel
def revise_env(world, options, drafts, b):
    """Find once more which nodes the next function of environment b's draft may go to, and what is seen of it."""
    if world.env[b].done == 1:
        _rest(drafts, b)
        return
    problem = make_problem(world, b, unit_costs(world, b))
    refuse = drafts.mask.shape[1] - 1
    if _find_nodes(problem, options, drafts, b) > 0:
        drafts.mask[b, refuse] = options.may_refuse
    else:
        drafts.mask[b, refuse] = True
    _observe(problem, world.tables, drafts, b)


@kernel
def begin_env(world, options, drafts, b):
    """``begin_rows`` for environment b of a simulator's world."""
    _begin_env(world, options, drafts, b)


@kernel
def advance(world, options, drafts, choices):
    """One decision of every environment; a plan that is complete, or refused, is played in the world.

    Afterwards ``world.outcome`` tells of the environments whose request was answered, and is empty for the others.

    Returns the least number of free records, free entries and free log places left in any of them.
    """
    reject = world.seen.mask.shape[1] - 1
    records = entries = places = np.int64(1) << 60
    for b in range(choices.size):
        e = world.env[b]
        for column in range(world.outcome.shape[1]):
            world.outcome[b, column] = 0.0
        world.outcome[b, OUTCOME.reason] = NO_REASON
        world.outcome[b, OUTCOME.done] = e.done
        if e.done == 0:
            problem = make_problem(world, b, unit_costs(world, b))
            _choose(world, problem, choices[b], options, drafts, b)
            if drafts.state[b] == COMPLETE:
                for k in range(drafts.steps[b]):
                    step_env(world, b, drafts.action[b, k])
            elif drafts.state[b] == REFUSED:
                step_env(world, b, np.int64(reject))
            if drafts.state[b] != OPEN:
                _begin_env(world, options, drafts, b)
        records = min(records, e.free_records)
        entries = min(entries, e.free_entries)
        places = min(places, world.log.action.shape[1] - e.log_length)
    return records, entries, places
