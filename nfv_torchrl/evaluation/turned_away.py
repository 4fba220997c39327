"""Which rejected requests still fitted: a run is made again, and the exact search is asked wherever it rejected."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.codec import encode_action
from nfv_torchrl.errors import AuditError
from nfv_torchrl.evaluation.metrics import service_shares
from nfv_torchrl.evaluation.records import FORWARD, RunRecord
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.vocabulary import TABLE


def turned_away(record: RunRecord) -> np.ndarray:
    """The requests that were rejected although the network, as it was then, had a feasible walk for them.

    Args:
        record: of any method.

    Returns:
        bool [R]. A rejected request with False had no walk at all: whoever decides, it had to be rejected.

    Raises:
        AuditError: the run comes out differently when it is made again.
    """
    simulator = Simulator(record.scenario.replace(admission_control=True), 1, record=True)
    simulator.start(0, record.workload, record.timeline)
    planner, found = MyopicPlanner(), np.zeros(record.num_requests, np.bool_)
    planner.prepare(simulator.world)
    walks = _actions(record, simulator.tables.vm_capacity.shape[2])
    first, env = np.zeros(1, np.int64), simulator.world.env
    plans, lengths = np.zeros((1, simulator.world.rules.max_steps), np.int64), np.zeros(1, np.int64)
    while not env["done"][0]:
        request = int(env["cursor"][0])
        if record.accepted[request]:
            walk = walks[record.step_offsets[request] : record.step_offsets[request + 1]]
            plans[0, : len(walk)], lengths[0] = walk, len(walk)
        else:
            planner.plan_rows(simulator.world, first, plans, lengths)
            found[request], lengths[0] = lengths[0] > 0, 0
        simulator.answer(plans, lengths)
        env = simulator.world.env
    again = simulator.world.log.cost[0, : record.num_requests]
    if not np.array_equal(again, record.cost, equal_nan=True):
        raise AuditError(f"{record.method}: the run comes out differently when it is made again; report this")
    return found


def shares_turned_away(record: RunRecord) -> dict[str, float]:
    """``turned_away/SERVICE`` of a run, for every service: the share of its requests, NaN where none arrived."""
    key = TABLE["turned_away/SERVICE"].key
    return {key(name): share for name, share in service_shares(record, turned_away(record)).items()}


def _actions(record: RunRecord, vms: int) -> np.ndarray:
    """The actions of all steps, int64; those of rejected requests may be none."""
    places = record.step_function != FORWARD
    return np.asarray(encode_action(record.step_node.astype(np.int64), record.step_vm, places, vms), np.int64)
