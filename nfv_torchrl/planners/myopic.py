"""``myopic_optimal``: the cheapest feasible embedding of each request by itself."""

from __future__ import annotations

from nfv_torchrl.planners.base import CompiledPlanner, over_rows
from nfv_torchrl.search.cheapest import Scratch, grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.search.walks import unit_costs
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.tables import Tables


@part
def plan_myopic(world, b, scratch, plan):
    """``plan_cheapest`` at the unit costs of the substrate."""
    return plan_cheapest(world, b, unit_costs(world, b), scratch, plan)


class MyopicPlanner(CompiledPlanner):
    """Exact minimum of the utilisation cost (eq. main_problem of the paper) for one request in the present state.

    No method spends less on a request in the same state; that does not make it a ceiling on how many are accepted.
    """

    own: Scratch
    kernel = over_rows(plan_myopic)

    def make(self, tables: Tables) -> Scratch:
        """See ``CompiledPlanner``."""
        return make_scratch(tables)

    def grow(self, tables: Tables) -> Scratch:
        """See ``CompiledPlanner``."""
        return grow_scratch(tables, self.own)
