"""The metrics of one run, all from its ``nfv_torchrl.evaluation.records.RunRecord``.

Each is one number under a flat key; a part of a whole follows a slash (``aar/voip``, ``rejected/delay``). A metric that
does not exist in the run (the mean delay when nothing was accepted) is NaN, in files ``null``.
"""

from __future__ import annotations

import math

import numpy as np

from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.scenario.units import to_ledger
from nfv_torchrl.simulator.reasons import REASON_NAMES


def compute_metrics(record: RunRecord) -> dict[str, float]:
    """All metrics of a run. With ``scenario.warmup`` = w, the first w slots and the requests arriving in them are left
    out; a request that arrived before and still runs counts in what is measured slot by slot.

    Returns:
        ``rho``: offered load. ``arrived``, ``accepted``: requests. ``aar``, ``aar/SERVICE``: accepted / arrived.
        ``anuc``: mean over slots of the cost of all running requests ($). ``cost_per_accepted``(``/SERVICE``): $.
        ``rejected/REASON``: share of arrived. ``mean_hops``: links used, ``mean_delay_ms``: both of accepted requests.
        ``vm_utilisation``, ``link_utilisation``: used / total capacity of the network, mean over slots, and
        ``..._peak``: its largest value. ``interrupted``: share of accepted requests cut short by a failure,
        ``lost_service_time``: the slots (s) that these still had to run, in all. ``decision_seconds``,
        ``decisions_per_second``: wall time of the decisions, of the whole run.
    """
    counted = record.workload.slot >= record.scenario.warmup
    accepted = record.accepted & counted
    arrived_count, accepted_count = int(counted.sum()), int(accepted.sum())
    metrics: dict[str, float] = {
        "rho": float(record.scenario.offered_load()),
        "arrived": arrived_count,
        "accepted": accepted_count,
        "aar": _ratio(accepted_count, arrived_count),
    }
    services = [service.name for service in record.scenario.catalogue.types]
    of_service = [record.workload.service == k for k in range(len(services))]
    for name, mine in zip(services, of_service, strict=True):
        metrics[f"aar/{name}"] = _ratio(int((accepted & mine).sum()), int((counted & mine).sum()))
    metrics["anuc"] = float(per_slot_cost(record)[record.scenario.warmup :].mean())
    metrics["cost_per_accepted"] = _mean(record.cost[accepted])
    for name, mine in zip(services, of_service, strict=True):
        metrics[f"cost_per_accepted/{name}"] = _mean(record.cost[accepted & mine])
    for code, name in enumerate(REASON_NAMES):
        metrics[f"rejected/{name}"] = _ratio(int((counted & (record.reason == code)).sum()), arrived_count)
    metrics["mean_hops"] = _mean(record.hops[accepted])
    metrics["mean_delay_ms"] = _mean(record.delay_ms[accepted])
    metrics |= _utilisation(record)
    cut = accepted & (record.interrupted_at >= 0)
    metrics["interrupted"] = _ratio(int(cut.sum()), accepted_count)
    metrics["lost_service_time"] = int((record.workload.departure - record.interrupted_at)[cut].sum())
    metrics["decision_seconds"] = float(record.seconds)
    metrics["decisions_per_second"] = record.decisions_per_second
    return metrics


def per_slot_cost(record: RunRecord) -> np.ndarray:
    """Phi_t, float64 [T]: the sum of phi over the requests that run after slot t's arrivals ($)."""
    return running_total(record, np.where(record.accepted, record.cost, 0.0))


def per_slot_running(record: RunRecord) -> np.ndarray:
    """Number of running requests after each slot's arrivals, int64 [T]."""
    return running_total(record, np.ones(record.num_requests, np.int64))


def running_total(record: RunRecord, amount: np.ndarray) -> np.ndarray:
    """Sum of ``amount`` [R] over the requests that run after each slot's arrivals, [T], of ``amount``'s dtype.

    An accepted request runs from its slot up to, not including, its departure slot or the slot that interrupts it.
    """
    horizon = record.scenario.horizon
    end = np.where(record.interrupted_at >= 0, record.interrupted_at, record.workload.departure)
    change = np.zeros(horizon + 1, amount.dtype)
    here = record.accepted
    np.add.at(change, record.workload.slot[here], amount[here])
    np.subtract.at(change, np.minimum(end[here], horizon), amount[here])
    return np.cumsum(change[:horizon])


def paired_cost(record: RunRecord, reference: RunRecord) -> float:
    """Cost of ``record`` over that of ``reference``, summed over the requests that both accept; NaN if there are none.

    The fair comparison of cost: a method that drops the costly requests gains nothing by it.
    """
    both = record.accepted & reference.accepted & (record.workload.slot >= record.scenario.warmup)
    return _ratio(float(record.cost[both].sum()), float(reference.cost[both].sum()))


def _utilisation(record: RunRecord) -> dict[str, float]:
    substrate, catalogue = record.scenario.substrate, record.scenario.catalogue
    # An accepted request places its whole chain, so its load is that of its service.
    load = to_ledger(catalogue.load).sum(axis=1)[record.workload.service]
    rate = to_ledger(catalogue.rate)[record.workload.service] * record.hops
    result = {}
    for name, amount, capacity in (
        ("vm_utilisation", load, substrate.vm_capacity),
        ("link_utilisation", rate, substrate.link_capacity),
    ):
        used = running_total(record, amount)[record.scenario.warmup :] / int(to_ledger(capacity).sum())
        result[name] = float(used.mean())
        result[f"{name}_peak"] = float(used.max())
    return result


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan
