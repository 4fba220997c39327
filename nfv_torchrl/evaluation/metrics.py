"""The metrics of one run, all from its ``nfv_torchrl.evaluation.records.RunRecord``.

Each is one function, registered with its row of the table of all quantities (`nfv_torchrl.vocabulary`), from where it
reaches files, tables, TensorBoard and docs. A metric that does not exist in the run (the mean delay when nothing was
accepted) is NaN, in files ``null``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.evaluation.statistics import cost_ratio
from nfv_torchrl.scenario.units import LEDGER_UNITS, to_ledger
from nfv_torchrl.simulator.reasons import REASON_NAMES, Reason
from nfv_torchrl.vocabulary import TABLE, Quantity, add

Value = float | Mapping[str, float]
"""A number, or one for each part of a whole, by its name."""
FUNCTIONS: dict[str, Callable[[RunRecord], Value]] = {}
"""By name of the row."""


def metric(row: Quantity) -> Callable[[Callable[[RunRecord], Value]], Callable[[RunRecord], Value]]:
    """Make a function of a run a metric.

        @metric(Quantity("most_hops", "links", "links used by the longest accepted walk", head="most hops"))
        def most_hops(record: RunRecord) -> int:
            return int(record.hops[accepted(record)].max(initial=0))

    Where the row's name has a part (`aar/SERVICE`) the function returns a number for each. The audit needs its own
    arithmetic for it (`nfv_torchrl.evaluation.audit.recompute`), and says so where it has none.

    Raises:
        ValueError: another row has that name.
    """

    def register(function: Callable[[RunRecord], Value]) -> Callable[[RunRecord], Value]:
        FUNCTIONS[add(row).name] = function
        return function

    return register


def compute_metrics(record: RunRecord) -> dict[str, float]:
    """All metrics of a run by name, in the order of the table. With ``scenario.warmup`` = w, the first w slots and the
    requests arriving in them are left out; a request that arrived before and still runs counts in what is measured slot
    by slot."""
    metrics: dict[str, float] = {}
    for row in TABLE.values():
        if row.name in FUNCTIONS:
            value = FUNCTIONS[row.name](record)
            parts = value if isinstance(value, Mapping) else {"": value}
            metrics |= {row.key(part): number for part, number in parts.items()}
    return metrics


@metric(TABLE["rho"])
def rho(record: RunRecord) -> float:
    return float(record.scenario.offered_load())


@metric(TABLE["arrived"])
def arrived(record: RunRecord) -> int:
    return int(counted(record).sum())


@metric(TABLE["accepted"])
def accepted_requests(record: RunRecord) -> int:
    return int(accepted(record).sum())


@metric(TABLE["aar"])
def aar(record: RunRecord) -> float:
    return _share(accepted(record), counted(record))


@metric(TABLE["aar/SERVICE"])
def aar_by_service(record: RunRecord) -> dict[str, float]:
    return {name: _share(accepted(record) & mine, counted(record) & mine) for name, mine in _services(record)}


@metric(TABLE["anuc"])
def anuc(record: RunRecord) -> float:
    return float(per_slot_cost(record)[record.scenario.warmup :].mean())


@metric(TABLE["cost_per_accepted"])
def cost_per_accepted(record: RunRecord) -> float:
    return mean(record.cost[accepted(record)])


@metric(TABLE["cost_per_accepted/SERVICE"])
def cost_by_service(record: RunRecord) -> dict[str, float]:
    return {name: mean(record.cost[accepted(record) & mine]) for name, mine in _services(record)}


@metric(TABLE["rejected/REASON"])
def rejected(record: RunRecord) -> dict[str, float]:
    came = counted(record)
    return {name: _share(came & (record.reason == code), came) for code, name in enumerate(REASON_NAMES)}


@metric(TABLE["refused/SERVICE"])
def refused_by_service(record: RunRecord) -> dict[str, float]:
    return service_shares(record, record.reason == Reason.REJECTED_BY_POLICY)


@metric(TABLE["mean_hops"])
def mean_hops(record: RunRecord) -> float:
    return mean(record.hops[accepted(record)])


@metric(TABLE["mean_delay_ms"])
def mean_delay_ms(record: RunRecord) -> float:
    return mean(record.delay_ms[accepted(record)])


@metric(TABLE["vm_utilisation"])
def vm_utilisation(record: RunRecord) -> float:
    return float(_vm_use(record).mean())


@metric(TABLE["vm_utilisation_peak"])
def vm_utilisation_peak(record: RunRecord) -> float:
    return float(_vm_use(record).max())


@metric(TABLE["link_utilisation"])
def link_utilisation(record: RunRecord) -> float:
    return float(_link_use(record).mean())


@metric(TABLE["link_utilisation_peak"])
def link_utilisation_peak(record: RunRecord) -> float:
    return float(_link_use(record).max())


@metric(TABLE["interrupted"])
def interrupted(record: RunRecord) -> float:
    return _share(_cut_short(record), accepted(record))


@metric(TABLE["lost_service_time"])
def lost_service_time(record: RunRecord) -> int:
    return int((record.workload.departure - record.interrupted_at)[_cut_short(record)].sum())


@metric(TABLE["rac"])
def rac(record: RunRecord) -> dict[str, float]:
    return {"": _share(accepted(record), counted(record))} if has_revenue(record) else {}


@metric(TABLE["lrc"])
def lrc(record: RunRecord) -> dict[str, float]:
    if not has_revenue(record):
        return {}
    stay = np.where(accepted(record), record.workload.lifetime, 0.0)
    placed, routed = asked(record)
    cost = placed + carried(record) / LEDGER_UNITS
    spent = float(stay @ cost)
    return {"": float(stay @ (placed + routed)) / spent if spent else math.nan}


@metric(TABLE["lar"])
def lar(record: RunRecord) -> dict[str, float]:
    if not has_revenue(record):
        return {}
    work = record.workload
    last = float(work.slot[-1] if work.time is None else work.time[-1]) - record.scenario.warmup
    earned = float(np.where(accepted(record), work.lifetime, 0.0) @ sum(asked(record)))
    return {"": earned / last if last > 0 else math.nan}


@metric(TABLE["unproved"])
def unproved(record: RunRecord) -> dict[str, float]:
    return {} if record.unproved is None else {"": record.unproved}


@metric(TABLE["decision_seconds"])
def decision_seconds(record: RunRecord) -> float:
    return float(record.seconds)


@metric(TABLE["decisions_per_second"])
def decisions_per_second(record: RunRecord) -> float:
    return record.decisions_per_second


def has_revenue(record: RunRecord) -> bool:
    """Whether requests of a file bring demands of their own, which Virne's metrics take for what they pay."""
    return record.scenario.workload_path is not None and record.workload.own is not None


def asked(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """What each request asks of nodes (mean over the kinds of resources) and of links, float64 [R] each.

    A segment from or to an end that is free is none.
    """
    profiles, work = record.scenario.profiles, record.workload
    length = profiles.chain_length[work.profile]
    rates = profiles.rate[work.profile]
    segment = np.arange(rates.shape[1])
    first, last = np.where(work.ingress >= 0, 0, 1), np.where(work.egress >= 0, length, length - 1)
    there = (segment >= first[:, None]) & (segment <= last[:, None])
    return profiles.total.mean(axis=1)[work.profile], np.where(there, rates, 0.0).sum(axis=1)


def counted(record: RunRecord) -> np.ndarray:
    """The requests that count: those that arrived after the warm-up, bool [R]."""
    return record.workload.slot >= record.scenario.warmup


def accepted(record: RunRecord) -> np.ndarray:
    """Those of them that were accepted, bool [R]."""
    return record.accepted & counted(record)


def service_shares(record: RunRecord, chosen: np.ndarray) -> dict[str, float]:
    """Share of the requests ``chosen``, bool [R], among those of each service that count; NaN where there are none."""
    came = counted(record)
    return {name: _share(chosen & came & mine, came & mine) for name, mine in _services(record)}


def counted_cost(record: RunRecord) -> np.ndarray:
    """Cost of every request, float64 [R], $, NaN where it was rejected or does not count."""
    return np.where(accepted(record), record.cost, np.nan)


def per_slot_cost(record: RunRecord) -> np.ndarray:
    """Phi_t, float64 [T]: the sum of phi over the requests that run after slot t's arrivals ($)."""
    return running_total(record, np.where(record.accepted, record.cost, 0.0))


def running_total(record: RunRecord, amount: np.ndarray) -> np.ndarray:
    """Sum of ``amount`` [R] over the requests that run after each slot's arrivals, [T], of ``amount``'s dtype.

    An accepted request runs from its slot up to, not including, its departure slot or the slot that interrupts it.
    Where times are given, it does not count in a slot that has an arrival when it has left.
    """
    horizon = record.scenario.horizon
    end = np.where(record.interrupted_at >= 0, record.interrupted_at, record.workload.uncounted)
    change = np.zeros(horizon + 1, amount.dtype)
    here = record.accepted
    np.add.at(change, record.workload.slot[here], amount[here])
    np.subtract.at(change, np.minimum(end[here], horizon), amount[here])
    return np.cumsum(change[:horizon])


def paired_cost(record: RunRecord, reference: RunRecord) -> float:
    """Cost of ``record`` over that of ``reference`` for the requests that both accept, see `cost_ratio`."""
    return cost_ratio(counted_cost(record), counted_cost(reference))


def mean(values: np.ndarray) -> float:
    """The mean of ``values`` [n], NaN if there are none."""
    return float(values.mean()) if len(values) else math.nan


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    """How much of the requests ``whole``, bool [R], the requests ``part`` are; NaN of none."""
    below = int(whole.sum())
    return int(part.sum()) / below if below else math.nan


def _services(record: RunRecord) -> Iterator[tuple[str, np.ndarray]]:
    """Name of each service type and which requests are of it, bool [R]."""
    for place, service in enumerate(record.scenario.catalogue.types):
        yield service.name, record.workload.service == place


def _cut_short(record: RunRecord) -> np.ndarray:
    return accepted(record) & (record.interrupted_at >= 0)


def _vm_use(record: RunRecord) -> np.ndarray:
    """Used share of all VM capacity in every counted slot, [T - warmup]; the mean over the kinds of resources."""
    # An accepted request places its whole chain, so its load is that of its profile.
    load = to_ledger(record.scenario.profiles.amount).sum(axis=1)[record.workload.profile]
    capacity = record.scenario.substrate.capacity_by_kind
    kinds = range(load.shape[1])
    return np.mean([_used(record, load[:, kind], capacity[:, :, kind]) for kind in kinds], axis=0)


def _link_use(record: RunRecord) -> np.ndarray:
    """The same of all links."""
    substrate = record.scenario.substrate
    capacity = (
        substrate.link_capacity if not substrate.full_duplex else [substrate.link_capacity, substrate.back_capacity]
    )
    return _used(record, carried(record), np.asarray(capacity))


def carried(record: RunRecord) -> np.ndarray:
    """Ledger units that each request takes of all links together, int64 [R]: its segments' rates times their hops."""
    profiles = record.scenario.profiles
    rates = to_ledger(profiles.rate)
    used = np.arange(rates.shape[1]) <= profiles.chain_length[:, None]
    one_rate = (rates == rates[:, :1]) | ~used
    rates = rates[record.workload.profile]
    if one_rate.all():
        return rates[:, 0] * record.hops
    request = np.repeat(np.arange(len(rates)), np.diff(record.step_offsets))
    placed = np.r_[0, np.cumsum(record.step_function >= 0)]
    segment = placed[:-1] - np.repeat(placed[record.step_offsets[:-1]], np.diff(record.step_offsets))
    before = np.r_[-1, record.step_node[:-1]]
    first = record.step_offsets[:-1][np.diff(record.step_offsets) > 0]
    before[first] = record.workload.ingress[np.diff(record.step_offsets) > 0]
    hop = record.accepted[request] & (before != record.step_node) & (before >= 0)
    total = np.zeros(len(rates), np.int64)
    np.add.at(total, request[hop], rates[request[hop], segment[hop]])
    return total


def _used(record: RunRecord, amount: np.ndarray, capacity: np.ndarray) -> np.ndarray:
    return running_total(record, amount)[record.scenario.warmup :] / int(to_ledger(capacity).sum())
