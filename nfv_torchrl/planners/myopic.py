"""``myopic_optimal``: the cheapest feasible embedding of each request by itself."""

from __future__ import annotations

from nfv_torchrl.planners.base import ExactPlanner, over_rows
from nfv_torchrl.search.cheapest import Scratch, grow_scratch, plan_cheapest
from nfv_torchrl.search.walks import unit_costs
from nfv_torchrl.settings.values import Count
from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.tables import Tables


@part
def plan_myopic(world, b, scratch, plan):
    """``plan_cheapest`` at the unit costs of the substrate."""
    return plan_cheapest(world, b, unit_costs(world, b), scratch, plan)


class MyopicPlanner(ExactPlanner):
    """Exact minimum of the utilisation cost (eq. main_problem of the paper) for one request in the present state.

    No method spends less on a request in the same state; that does not make it a ceiling on how many are accepted.
    With ``labels`` both hold only for requests that stay below that limit.

    Args:
        labels: limit on the search for one request, see ``ExactPlanner``; what goes beyond it is not proved optimal,
            and counted as ``unproved``. None: no limit.

    Raises:
        ScenarioError: labels < 1.
    """

    own: Scratch
    kernel = over_rows(plan_myopic)

    def __init__(self, *, labels: Count | None = None) -> None:
        super().__init__(labels)

    def make(self, tables: Tables) -> Scratch:
        """See ``CompiledPlanner``."""
        return self.make_search(tables)

    def grow(self, tables: Tables) -> Scratch:
        """See ``CompiledPlanner``."""
        return grow_scratch(tables, self.own)
