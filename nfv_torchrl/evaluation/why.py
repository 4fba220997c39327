"""Why a method rejected a request: what ended it, and what the exact search would have done at that moment."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.reasons import REASON_NAMES
from nfv_torchrl.simulator.state import OUTCOME

ENDED_BY = {
    "link_capacity": "a step asked for more than its link offers",
    "vm_capacity": "a function was put on a VM that offers too little",
    "delay": "the walk took longer than the service tolerates",
    "step_limit": "the walk was too long",
    "no_feasible_action": "nothing but rejecting was left",
    "rejected_by_policy": "the method chose to reject it",
    "invalid_action": "the method chose a step that the mask forbids",
}


def why_rejected(record: RunRecord, request: int) -> str:
    """One sentence on a rejected request, one on what was possible.

    The run is played again up to the request. Then the exact search looks for the cheapest walk in the network as it
    was.

    Args:
        record: a run.
        request: the number of a request in arrival order, from 0.

    Raises:
        ScenarioError: there is no such request, or it was accepted.

    Example:
        >>> lost = np.flatnonzero(~record.accepted)
        >>> print(why_rejected(record, int(lost[0])))
    """
    if not 0 <= request < record.num_requests:
        raise ScenarioError(f"request {request}: the run has requests 0 to {record.num_requests - 1}")
    if record.accepted[request]:
        raise ScenarioError(f"request {request} was accepted; name a rejected one")
    workload, label = record.workload, record.scenario.substrate.end_label
    kind = record.scenario.catalogue.types[workload.service[request]]
    reason = REASON_NAMES[record.reason[request]]
    ingress, egress = label(workload.ingress[request]), label(workload.egress[request])
    said = (
        f"Request {request} ({kind.name} from {ingress} to {egress}, slot {workload.slot[request]}) was rejected by "
        f"{record.method}: {ENDED_BY[reason]} ({reason})."
    )
    return f"{said} {_possible(simulator_before(record, request))}"


def simulator_before(record: RunRecord, request: int) -> Simulator:
    """A simulator of one environment in the state in which the run met ``request``."""
    simulator = Simulator(record.scenario, 1)
    simulator.start(0, record.workload, record.timeline)
    reject, vms = simulator.num_actions - 1, record.scenario.substrate.vm_capacity.shape[1]
    steps = slice(0, record.step_offsets[request])
    node = record.step_node[steps].astype(np.int64)
    places = record.step_function[steps] >= 0
    actions = np.where(node < 0, reject, encode_action(node, record.step_vm[steps], places, vms))
    for action in actions:
        simulator.step(action[None])
    return simulator


def _possible(simulator: Simulator) -> str:
    """What the exact search finds for the request in hand."""
    world = simulator.world
    plan = np.zeros(world.rules.max_steps, np.int64)
    planner = MyopicPlanner()
    lengths = np.zeros(1, np.int64)
    planner.prepare(world)
    planner.plan_rows(world, np.zeros(1, np.int64), plan[None], lengths)
    if not lengths[0]:
        return "The exact search finds no walk within the capacities and the delay left."
    for action in plan[: lengths[0]]:
        simulator.step(action[None])
    outcome = simulator.world.outcome[0]
    return (
        f"The exact search finds a walk of {outcome[OUTCOME.request_hops]:.0f} hops, "
        f"{outcome[OUTCOME.request_delay]:.0f} ms and {outcome[OUTCOME.request_cost]:,.1f} $."
    )
