"""``tabu``: tabu search over placements on the k least-cost paths, from the greedy one on.

After Leivadeas et al. (VNF placement by tabu search). A solution is a path and a VM along it for every function. Moves:
one function to another VM between its neighbours in the chain, or the chain to another of the k paths, placed there in
order. Each iteration takes the best move that is not tabu even if it is worse, and forbids the way back for ``tenure``
iterations, unless that leads to the best feasible embedding so far (aspiration).

Where an end of the request is free there are no paths between two nodes (``search/rearranging.py``). A solution is then
a VM for every function, on any node. Moves: one function to any other VM that the rule of placement allows, with the
cheapest routes to and from it, so that the first function takes the start with it and the last one the end; or the
chain to the greedy one from another of the k cheapest starts. Those routes are the only ones: a chain is not led around
a link that it would use once too often itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import vm_resource
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import CompiledPlanner, over_rows
from nfv_torchrl.search.placing import (
    Placing,
    encode_placement,
    first_position,
    grow_placing,
    judge,
    last_position,
    make_placing,
    node_at,
    place_greedily,
)
from nfv_torchrl.search.rearranging import (
    AHEAD,
    BACK,
    PENALTY,
    Rearranging,
    cost_on,
    cost_without,
    judge_walk,
    keep_walk,
    lay_chains,
    make_rearranging,
    may_move,
    refresh_trees,
    stand,
    take_in_hand,
    try_chain,
    try_move,
)
from nfv_torchrl.search.walks import OVERFLOW, encode_walk, make_problem, unit_costs
from nfv_torchrl.settings.values import Count, Natural
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.tables import Tables


class TabuScratch(NamedTuple):
    """Scratch memory of ``tabu``, one for each thread."""

    placing: Placing
    rearranging: Rearranging
    listed: np.ndarray  # int64 [tenure, 3]: (function, VM, -1) or (-1, -1, path), oldest overwritten
    iterations: int  # E, moves made


@part
def plan_tabu(world, b, scratch, plan):
    """Plan the request of environment b by tabu search. Deterministic.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        scratch: ``TabuScratch``, whose sizes decide k and the tenure.
        plan: receives the actions, int64 [max_steps].

    Returns:
        Number of actions, 0 if no feasible embedding was met, OVERFLOW (-1) if the scratch must grow.
    """
    problem = make_problem(world, b, unit_costs(world, b))
    if problem.ingress < 0 or problem.egress < 0:
        steps = _rearrange(problem, scratch)
        encode_walk(scratch.rearranging.roaming.walk, steps, problem.vm_offered.shape[1], plan)
        return steps
    placing = scratch.placing
    row, start = place_greedily(problem, world.tables, placing)
    if row == OVERFLOW:
        return OVERFLOW
    best = _improve(problem, scratch, row, start)
    if best < 0:
        return 0
    kept = placing.position.shape[0] - 1
    number = row * placing.lacking.size + best
    return encode_placement(problem, placing, number, placing.position[kept], placing.vm[kept], plan)


@part
def _improve(problem, scratch, row, start):
    """Search from the greedy placement on path ``start`` (-1: the cheapest path, infeasible).

    Returns:
        Path of the best feasible embedding, whose placement is left in the last row of ``placing``; -1 if none.
    """
    placing, listed = scratch.placing, scratch.listed
    functions = problem.functions
    here, kept = placing.position.shape[0] - 2, placing.position.shape[0] - 1
    position, vm = placing.position[here], placing.vm[here]
    listed[:] = -1
    path = max(start, 0)
    _copy(placing, path, here, functions)
    best, least = -1, np.inf
    if start >= 0:
        best = start
        least = judge(problem, placing, row * placing.lacking.size + start, start, position, vm)[0]
        _copy(placing, here, kept, functions)
    for iteration in range(scratch.iterations):
        function, at, v, target = _best_move(problem, scratch, row, path, least)
        if function < 0 and target < 0:
            break
        slot = iteration % listed.shape[0]
        listed[slot] = -1
        if function >= 0:
            node = node_at(problem, placing.paths, row * placing.lacking.size + path, position[function])
            listed[slot, 0] = function
            listed[slot, 1] = vm_resource(node, vm[function], problem.vm_offered.shape[1])
            position[function] = at
            vm[function] = v
        else:
            listed[slot, 2] = path
            path = target
            _copy(placing, path, here, functions)
        cost, violation = judge(problem, placing, row * placing.lacking.size + path, path, position, vm)
        if violation == 0.0 and cost < least:
            best, least = path, cost
            _copy(placing, here, kept, functions)
    return best


@part
def _best_move(problem, scratch, row, path, least):
    """The move with the least penalised cost that is not tabu, or that beats ``least``.

    Returns:
        (function, position, VM, -1), or (-1, -1, -1, path), or four times -1 if there is no move.
    """
    placing = scratch.placing
    here = placing.position.shape[0] - 2
    position, vm = placing.position[here], placing.vm[here]
    vms = problem.vm_offered.shape[1]
    number = row * placing.lacking.size + path
    hops = placing.paths.hops[number]
    move = (-1, -1, -1, -1)
    lowest = np.inf
    for i in range(problem.functions if not placing.hopeless[path] else 0):
        old_at, old_vm = position[i], vm[i]
        first = first_position(problem, hops, position[i - 1] if i > 0 else -1)
        for at in range(first, last_position(problem, hops, i) + 1):
            if not _may_precede(problem, position, i, at, hops):
                break
            node = node_at(problem, placing.paths, number, at)
            for v in range(problem.vm_count[node]):
                if at == old_at and v == old_vm:
                    continue
                position[i], vm[i] = at, v
                cost, violation = judge(problem, placing, number, path, position, vm)
                score = cost + PENALTY * violation
                aspires = violation == 0.0 and cost < least
                if score < lowest and (aspires or not _is_tabu(scratch.listed, i, vm_resource(node, v, vms), -1)):
                    lowest = score
                    move = (i, at, v, -1)
        position[i], vm[i] = old_at, old_vm
    for j in range(placing.paths.found[row]):
        if j == path or placing.hopeless[j]:
            continue
        other = row * placing.lacking.size + j
        cost, violation = judge(problem, placing, other, j, placing.position[j], placing.vm[j])
        score = cost + PENALTY * violation
        aspires = violation == 0.0 and cost < least
        if score < lowest and (aspires or not _is_tabu(scratch.listed, -1, -1, j)):
            lowest = score
            move = (-1, -1, -1, j)
    return move


@part
def _may_precede(problem, position, i, at, hops):
    """Whether function ``i`` may stand at ``at`` without moving the one after it."""
    if i + 1 == problem.functions:
        return True
    return first_position(problem, hops, at) <= position[i + 1]


@part
def _is_tabu(listed, function, resource, path):
    for slot in range(listed.shape[0]):
        if listed[slot, 0] == function and listed[slot, 1] == resource and listed[slot, 2] == path:
            return True
    return False


@part
def _copy(placing, source, target, functions):
    for i in range(functions):
        placing.position[target, i] = placing.position[source, i]
        placing.vm[target, i] = placing.vm[source, i]


@part
def _rearrange(problem, scratch):
    """Search from the cheapest greedy chain; where an end is free.

    Returns:
        Steps of the best feasible walk, which is then ``rearranging.roaming.walk``; 0 if none was met.
    """
    own, listed = scratch.rearranging, scratch.listed
    kept = own.steps.size - 1
    chains, best, least = lay_chains(problem, own)
    if chains == 0:
        return 0
    own.steps[kept] = 0
    chain = max(best, 0)
    steps = try_chain(own, chain)
    take_in_hand(own, steps, -1, problem.functions)
    if best >= 0:
        keep_walk(own, kept, steps)
    listed[:] = -1
    for iteration in range(scratch.iterations):
        function, node, vm, target = _best_rearrangement(problem, scratch, chains, chain, least)
        if function < 0 and target < 0:
            break
        slot = iteration % listed.shape[0]
        listed[slot] = -1
        if function >= 0:
            listed[slot, 0] = function
            listed[slot, 1] = _resource(problem, own, function)
            steps = try_move(problem, own, function, node, vm)
        else:
            listed[slot, 2] = chain
            chain = target
            steps = try_chain(own, target)
        take_in_hand(own, steps, function, problem.functions)
        cost, violation = judge_walk(problem, own, steps)
        if violation == 0.0 and cost < least:
            least = cost
            keep_walk(own, kept, steps)
    return try_chain(own, kept)


@part
def _best_rearrangement(problem, scratch, chains, chain, least):
    """As ``_best_move``: (function, node, VM, -1), or (-1, -1, -1, chain), or four times -1.

    What a moved chain costs at least is known without its walk, and a walk is laid only where that is the lowest.
    """
    own, listed, vms = scratch.rearranging, scratch.listed, problem.vm_offered.shape[1]
    move = (-1, -1, -1, -1)
    lowest = np.inf
    for i in range(problem.functions):
        refresh_trees(problem, own, i)
        others, old = cost_without(problem, own, i), _resource(problem, own, i)
        for node in range(problem.nodes):
            route = others + own.distance[AHEAD, i, node] + own.distance[BACK, i, node]
            if not (route < lowest and may_move(problem, own, i, node)):
                continue
            for v in range(problem.vm_count[node]):
                resource = vm_resource(node, v, vms)
                bound = route + cost_on(problem, own, node, v, i)
                if resource == old or not bound < lowest:
                    continue
                forbidden = _is_tabu(listed, i, resource, -1)
                if forbidden and not bound < least:
                    continue
                cost, violation = judge_walk(problem, own, try_move(problem, own, i, node, v))
                score = cost + PENALTY * violation
                if score < lowest and (not forbidden or (violation == 0.0 and cost < least)):
                    lowest = score
                    move = (i, node, v, -1)
    for j in range(chains):
        if j == chain:
            continue
        cost, violation = judge_walk(problem, own, try_chain(own, j))
        score = cost + PENALTY * violation
        if score < lowest and (not _is_tabu(listed, -1, -1, j) or (violation == 0.0 and cost < least)):
            lowest = score
            move = (-1, -1, -1, j)
    return move


@part
def _resource(problem, own, i):
    """Number of the VM of function ``i`` of the chain in hand."""
    vm = own.vm[own.steps.size - 2, own.at[i]]
    return vm_resource(stand(problem, own, i), vm, problem.vm_offered.shape[1])


class TabuPlanner(CompiledPlanner):
    """Tabu search from the greedy placement; the best feasible embedding it meets. Deterministic.

    Args:
        paths: k, how many least-cost simple paths may be used; where the ingress is free, nodes on which the first
            function is tried to begin with.
        iterations: E, moves made for each request.
        tenure: iterations for which a move's way back is forbidden.

    Raises:
        ScenarioError: paths < 1, iterations < 0 or tenure < 1.
    """

    own: TabuScratch
    kernel = over_rows(plan_tabu)

    def __init__(self, *, paths: Count = 10, iterations: Natural = 30, tenure: Count = 5) -> None:
        super().__init__()
        if paths < 1:
            raise ScenarioError(f"paths is {paths}; a tabu planner needs at least 1 path to look at")
        if iterations < 0:
            raise ScenarioError(f"iterations is {iterations}; give 0 or more")
        if tenure < 1:
            raise ScenarioError(f"tenure is {tenure}; give 1 or more")
        self.paths = int(paths)
        self.iterations = int(iterations)
        self.tenure = int(tenure)

    def make(self, tables: Tables) -> TabuScratch:
        """See ``CompiledPlanner``."""
        placing, rearranging = make_placing(tables, self.paths), make_rearranging(tables, self.paths)
        return TabuScratch(placing, rearranging, np.full((self.tenure, 3), -1), self.iterations)

    def grow(self, tables: Tables) -> TabuScratch:
        """See ``CompiledPlanner``."""
        return self.own._replace(placing=grow_placing(self.own.placing))
