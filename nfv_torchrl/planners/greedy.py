"""``greedy``: the cheapest of the k least-cost paths with functions in order on the cheapest VMs along it.

After Agarwal et al. (VNF placement and CPU allocation). The chain goes along the path in order: each function takes the
cheapest VM that fits anywhere from the place of the function before it to the egress. That choice is never taken back,
so one that jumps ahead to a cheap VM leaves less of the path to the functions after it, which is what makes it greedy.
Where an end of the request is free there are no such paths, and the chain roams from node to node
(``search/roaming.py``).
"""

from __future__ import annotations

from typing import NamedTuple

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import CompiledPlanner, over_rows
from nfv_torchrl.search.placing import Placing, encode_placement, grow_placing, make_placing, place_greedily
from nfv_torchrl.search.roaming import Roaming, make_roaming, roam
from nfv_torchrl.search.walks import OVERFLOW, encode_walk, make_problem, unit_costs
from nfv_torchrl.settings.values import Count
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.tables import Tables


class GreedyScratch(NamedTuple):
    """Scratch memory of ``greedy``, one for each thread."""

    placing: Placing
    roaming: Roaming


@part
def plan_greedy(world, b, own, plan):
    """Plan the request of environment b greedily.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``GreedyScratch``, whose size decides k.
        plan: receives the actions, int64 [max_steps].

    Returns:
        Number of actions, 0 if no path fits, OVERFLOW (-1) if the scratch must grow.
    """
    placing = own.placing
    problem = make_problem(world, b, unit_costs(world, b))
    if problem.ingress < 0 or problem.egress < 0:
        steps = roam(problem, unit_costs(world, b), own.roaming)
        encode_walk(own.roaming.best, steps, problem.vm_offered.shape[1], plan)
        return steps
    row, best = place_greedily(problem, world.tables, placing)
    if row == OVERFLOW:
        return OVERFLOW
    if best < 0:
        return 0
    number = row * placing.lacking.size + best
    return encode_placement(problem, placing, number, placing.position[best], placing.vm[best], plan)


class GreedyPlanner(CompiledPlanner):
    """The cheapest feasible greedy placement over the ``paths`` least-cost simple paths.

    Args:
        paths: k, how many simple paths from ingress to egress are looked at; where the ingress is free, nodes on which
            the first function is tried.

    Raises:
        ScenarioError: paths < 1.
    """

    own: GreedyScratch
    kernel = over_rows(plan_greedy)

    def __init__(self, *, paths: Count = 10) -> None:
        super().__init__()
        if paths < 1:
            raise ScenarioError(f"paths is {paths}; a greedy planner needs at least 1 path to look at")
        self.paths = int(paths)

    def make(self, tables: Tables) -> GreedyScratch:
        """See ``CompiledPlanner``."""
        return GreedyScratch(make_placing(tables, self.paths), make_roaming(tables, self.paths))

    def grow(self, tables: Tables) -> GreedyScratch:
        """See ``CompiledPlanner``."""
        return self.own._replace(placing=grow_placing(self.own.placing))
