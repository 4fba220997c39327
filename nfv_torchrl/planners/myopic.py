"""``myopic_optimal``: the cheapest feasible embedding of each request by itself."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.planners.base import CompiledPlanner
from nfv_torchrl.planners.cheapest import Scratch, grow_scratch, make_scratch, plan_cheapest
from nfv_torchrl.planners.compiled import kernel
from nfv_torchrl.planners.walks import OVERFLOW
from nfv_torchrl.simulator.tables import Rules, Tables


@kernel
def plan_myopic(tables, rules, net, vm_offered, link_offered, service, ingress, egress, scratch, plan):
    """``plan_cheapest`` at the unit costs of the substrate; same arguments and return value."""
    return plan_cheapest(
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
        scratch,
        plan,
    )


@kernel
def plan_myopic_batch(
    tables, rules, rows, env_net, vm_offered, link_offered, service, ingress, egress, scratch, plans, lengths
):
    """``plan_myopic`` for every environment in ``rows``; returns how many were answered before an overflow."""
    for done in range(rows.size):
        b = rows[done]
        lengths[b] = plan_myopic(
            tables,
            rules,
            env_net[b],
            vm_offered[b],
            link_offered[b],
            service[b],
            ingress[b],
            egress[b],
            scratch,
            plans[b],
        )
        if lengths[b] == OVERFLOW:
            return done
    return rows.size


class MyopicPlanner(CompiledPlanner):
    """Exact minimum of the utilisation cost (eq. main_problem of the paper) for one request in the present state.

    No method spends less on a request in the same state; that does not make it a ceiling on how many are accepted.
    """

    _scratch: Scratch

    def _make(self, tables: Tables, rules: Rules) -> Scratch:
        return make_scratch(tables)

    def _grow(self, tables: Tables) -> Scratch:
        return grow_scratch(tables, self._scratch)

    def _kernel(self, *request: Any) -> int:
        return plan_myopic(*request[:-1], self._scratch, request[-1])

    def _batch(self, *requests: Any) -> int:
        return plan_myopic_batch(*requests[:-2], self._scratch, *requests[-2:])
