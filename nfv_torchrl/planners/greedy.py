"""``greedy``: the cheapest of the k least-cost paths with functions in order on the cheapest VMs along it.

After Agarwal et al. (VNF placement and CPU allocation). The chain goes along the path in order: each function takes the
cheapest VM that fits anywhere from the place of the function before it to the egress. That choice is never taken back,
so one that jumps ahead to a cheap VM leaves less of the path to the functions after it, which is what makes it greedy.
"""

from __future__ import annotations

from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import CompiledPlanner
from nfv_torchrl.planners.compiled import kernel, part
from nfv_torchrl.planners.placing import Placing, grow_placing, lay_walk, make_placing, place_greedily
from nfv_torchrl.planners.walks import OVERFLOW, encode_walk, make_problem, walk_totals
from nfv_torchrl.settings.values import Count
from nfv_torchrl.simulator.tables import Rules, Tables


@part
def encode_placement(problem, placing, number, position, vm, plan):
    """Write a feasible placement on path ``number`` as actions; returns how many, 0 if it fails the step checks."""
    steps = lay_walk(problem, placing, number, position, vm)
    # Delays are summed once more step by step, as the step checks do.
    _, delay = walk_totals(problem, placing.walk, steps, problem.vm_price, problem.link_price)
    if delay > problem.budget:
        return 0
    encode_walk(placing.walk, steps, problem.vm_offered.shape[1], plan)
    return steps


@kernel
def plan_greedy(tables, rules, net, vm_offered, link_offered, service, ingress, egress, placing, plan):
    """Plan one request greedily; see ``CompiledPlanner.plan``.

    Args:
        placing: ``Placing`` scratch, whose size decides k.

    Returns:
        Number of actions, 0 if no path fits, OVERFLOW (-1) if the scratch must grow.
    """
    problem = make_problem(
        tables,
        rules,
        net,
        vm_offered,
        link_offered,
        tables.vm_unit_cost[net],
        tables.link_unit_cost[net],
        service,
        ingress,
        egress,
    )
    row, best = place_greedily(problem, tables, net, placing)
    if row == OVERFLOW:
        return OVERFLOW
    if best < 0:
        return 0
    number = row * placing.lacking.size + best
    return encode_placement(problem, placing, number, placing.position[best], placing.vm[best], plan)


@kernel
def plan_greedy_batch(
    tables, rules, rows, env_net, vm_offered, link_offered, service, ingress, egress, placing, plans, lengths
):
    """``plan_greedy`` for every environment in ``rows``; returns how many were answered before an overflow."""
    for done in range(rows.size):
        b = rows[done]
        lengths[b] = plan_greedy(
            tables,
            rules,
            env_net[b],
            vm_offered[b],
            link_offered[b],
            service[b],
            ingress[b],
            egress[b],
            placing,
            plans[b],
        )
        if lengths[b] == OVERFLOW:
            return done
    return rows.size


class GreedyPlanner(CompiledPlanner):
    """The cheapest feasible greedy placement over the ``paths`` least-cost simple paths.

    Args:
        paths: k, how many simple paths from ingress to egress are looked at.

    Raises:
        ScenarioError: paths < 1.
    """

    _scratch: Placing

    def __init__(self, *, paths: Count = 10) -> None:
        super().__init__()
        if paths < 1:
            raise ScenarioError(f"paths is {paths}; a greedy planner needs at least 1 path to look at")
        self.paths = int(paths)

    def _make(self, tables: Tables, rules: Rules) -> Placing:
        return make_placing(tables, rules, self.paths)

    def _grow(self, tables: Tables) -> Placing:
        return grow_placing(self._scratch)

    def _kernel(self, *request: Any) -> int:
        return plan_greedy(*request[:-1], self._scratch, request[-1])

    def _batch(self, *requests: Any) -> int:
        return plan_greedy_batch(*requests[:-2], self._scratch, *requests[-2:])
