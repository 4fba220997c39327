"""The metrics of a replayed run, computed anew and compared with what metrics.json states.

Names come from the table of all quantities; the arithmetic is the audit's own, one function a metric.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from nfv_torchrl.evaluation.audit.files import FREE, RunFiles, Service, is_number
from nfv_torchrl.evaluation.audit.rejections import REASONS
from nfv_torchrl.evaluation.audit.replay import Answer, Replayed
from nfv_torchrl.vocabulary import TABLE, find, in_place

TOLERANCE = 1e-7
"""Relative difference that a stated metric may have from the recomputed one."""
SECONDS, SPEED = "decision_seconds", "decisions_per_second"
"""Wall times: the files cannot tell whether these are true, only whether they fit each other."""
UNPROVED = "unproved"
"""What the search knew, which decisions do not tell: only that there are as many."""


class Decided(NamedTuple):
    """A replayed run, and of its answers those that count: after the warm-up; of these, the accepted ones."""

    files: RunFiles
    run: Replayed
    arrived: list[Answer]
    accepted: list[Answer]


Value = float | None | Mapping[str, float | None]
"""A number, None where it does not exist; or one for each part, by its name."""
OWN: dict[str, Callable[[Decided], Value]] = {}
"""The audit's arithmetic by name of the row."""


def recomputes(name: str) -> Callable[[Callable[[Decided], Value]], Callable[[Decided], Value]]:
    """Make a function the audit's own arithmetic for the row ``name`` of the table."""

    def register(function: Callable[[Decided], Value]) -> Callable[[Decided], Value]:
        OWN[TABLE[name].name] = function
        return function

    return register


def is_measured(key: str) -> bool:
    """Whether a metric, such as a wall time, is known to the run alone, and taken as it states it."""
    found = find(key)
    return found is not None and found[0].measured


def recompute_metrics(files: RunFiles, run: Replayed) -> dict[str, float | None]:
    """All metrics that follow from the decisions; None where one does not exist. Reports a metric it cannot compute."""
    warmup = files.scenario["warmup"]
    arrived = [answer for answer in run.answers if answer.request.slot >= warmup]
    decided = Decided(files, run, arrived, [answer for answer in arrived if answer.accepted])
    metrics: dict[str, float | None] = {}
    for row in in_place("files"):
        if row.name in OWN:
            value = OWN[row.name](decided)
            parts = value if isinstance(value, Mapping) else {"": value}
            metrics |= {row.key(part): number for part, number in parts.items()}
        elif not row.measured:
            files.problems.add(
                f"metrics.json: {row.name} cannot be checked, the audit has no arithmetic of its own for it"
            )
    return metrics


@recomputes("rho")
def _rho(decided: Decided) -> float:
    return offered_load(decided.files)


@recomputes("arrived")
def _arrived(decided: Decided) -> int:
    return len(decided.arrived)


@recomputes("accepted")
def _accepted(decided: Decided) -> int:
    return len(decided.accepted)


@recomputes("aar")
def _aar(decided: Decided) -> Value:
    return _accepted_share(decided)


@recomputes("aar/SERVICE")
def _aar_by_service(decided: Decided) -> dict[str, float | None]:
    shares = {}
    for service in decided.files.services:
        mine = sum(answer.request.service == service for answer in decided.accepted)
        shares[service] = _share(mine, sum(answer.request.service == service for answer in decided.arrived))
    return shares


@recomputes("anuc")
def _anuc(decided: Decided) -> float:
    """Each request costs its phi in every slot that it runs; summed by request, not slot by slot."""
    first, horizon = decided.files.scenario["warmup"], decided.files.scenario["horizon"]
    spent = (
        answer.walk.cost * max(0, min(answer.end, horizon) - max(answer.request.slot, first))
        for answer in decided.run.answers
        if answer.accepted
    )
    return math.fsum(spent) / (horizon - first)


@recomputes("cost_per_accepted")
def _cost(decided: Decided) -> float | None:
    return _mean([answer.walk.cost for answer in decided.accepted])


@recomputes("cost_per_accepted/SERVICE")
def _cost_by_service(decided: Decided) -> dict[str, float | None]:
    return {
        service: _mean([answer.walk.cost for answer in decided.accepted if answer.request.service == service])
        for service in decided.files.services
    }


@recomputes("rejected/REASON")
def _rejected(decided: Decided) -> dict[str, float | None]:
    reasons = [answer.reason for answer in decided.arrived]
    return {reason: _share(reasons.count(reason), len(reasons)) for reason in REASONS}


@recomputes("refused/SERVICE")
def _refused(decided: Decided) -> dict[str, float | None]:
    shares = {}
    for service in decided.files.services:
        reasons = [answer.reason for answer in decided.arrived if answer.request.service == service]
        shares[service] = _share(reasons.count("rejected_by_policy"), len(reasons))
    return shares


@recomputes("mean_hops")
def _hops(decided: Decided) -> float | None:
    return _mean([answer.walk.hops for answer in decided.accepted])


@recomputes("mean_delay_ms")
def _delay(decided: Decided) -> float | None:
    return _mean([answer.walk.delay for answer in decided.accepted])


@recomputes("vm_utilisation")
def _vm_use(decided: Decided) -> float:
    shares = _vms(decided)
    return math.fsum(shares) / len(shares)


@recomputes("vm_utilisation_peak")
def _vm_peak(decided: Decided) -> float:
    return max(_vms(decided))


@recomputes("link_utilisation")
def _link_use(decided: Decided) -> float:
    used, total = _links(decided)
    return sum(used) / total / len(used)


@recomputes("link_utilisation_peak")
def _link_peak(decided: Decided) -> float:
    used, total = _links(decided)
    return max(used) / total


@recomputes("interrupted")
def _interrupted(decided: Decided) -> float | None:
    return _share(sum(answer.interrupted_at is not None for answer in decided.accepted), len(decided.accepted))


@recomputes("lost_service_time")
def _lost(decided: Decided) -> int:
    cut = [answer for answer in decided.accepted if answer.interrupted_at is not None]
    return sum(answer.request.departure - answer.end for answer in cut)


@recomputes("rac")
def _rac(decided: Decided) -> dict[str, float | None]:
    return {"": _accepted_share(decided)} if _has_revenue(decided) else {}


@recomputes("lrc")
def _lrc(decided: Decided) -> dict[str, float | None]:
    if not _has_revenue(decided):
        return {}
    spent = math.fsum(_node_demand(decided, answer) * answer.request.lifetime for answer in decided.accepted)
    spent += math.fsum(
        amount / 1e6 * answer.request.lifetime
        for answer in decided.accepted
        for ((kind, *_), _), amount in answer.walk.uses
        if kind == "link"
    )
    return {"": _earned(decided) / spent if spent else None}


@recomputes("lar")
def _lar(decided: Decided) -> dict[str, float | None]:
    if not _has_revenue(decided):
        return {}
    last = decided.files.workload[-1].arrives - decided.files.scenario["warmup"]
    return {"": _earned(decided) / last if last > 0 else None}


def _has_revenue(decided: Decided) -> bool:
    """Whether the requests are those of a file and bring demands."""
    return bool(decided.files.demands) and decided.files.scenario["workload_path"] is not None


def _accepted_share(decided: Decided) -> float | None:
    return _share(len(decided.accepted), len(decided.arrived))


def _earned(decided: Decided) -> float:
    """Amounts and rates that the accepted requests ask for, times their lifetimes."""
    return math.fsum(
        (_node_demand(decided, answer) + _link_demand(decided, answer)) * answer.request.lifetime
        for answer in decided.accepted
    )


def _node_demand(decided: Decided, answer: Answer) -> float:
    load = decided.files.asked(answer.request).load
    return math.fsum(math.fsum(amounts) / len(amounts) for amounts in load)


def _link_demand(decided: Decided, answer: Answer) -> float:
    """Rates of the segments, without those to or from an end that is free."""
    rates = decided.files.asked(answer.request).rate
    first, last = answer.request.ingress == FREE, answer.request.egress == FREE
    return math.fsum(rates[int(first) : len(rates) - int(last)])


def offered_load(files: RunFiles) -> float:
    """Load of the requests that would run at the end of the horizon if all were accepted, over the VMs' capacity.

    Rate, mean lifetime and mean load are those of the scenario, or of the requests where these came from a file.
    """
    scenario, services = files.scenario, files.services.values()
    kinds = range(max(len(vm.capacity) for here in files.vms for vm in here))
    if scenario["workload_path"] is None:
        weights = sum(each.weight for each in services)
        present = [each.weight / weights * _stay(each.mean_lifetime, scenario["horizon"]) for each in services]
        loads = [
            scenario["arrival_rate"]
            * sum(here * _chain(each, kind) for here, each in zip(present, services, strict=True))
            for kind in kinds
        ]
    else:
        requests, count = files.workload, len(files.workload)
        stay = _stay(math.fsum(request.lifetime for request in requests) / count, scenario["horizon"])
        loads = [
            stay * math.fsum(_chain(files.asked(request), kind) for request in requests) / scenario["horizon"]
            for kind in kinds
        ]
    installed = [math.fsum(vm.capacity[kind] for here in files.vms for vm in here) for kind in kinds]
    return max(load / there for load, there in zip(loads, installed, strict=True))


def _stay(mean: float, horizon: int) -> float:
    """Requests that are there at the end of the horizon for each that comes a slot; their mean lifetime is ``mean``."""
    return mean * -math.expm1(-horizon / mean)


def _chain(asked: Service, kind: int) -> float:
    """What a whole chain takes of a kind."""
    return sum(amounts[kind] for amounts in asked.load)


def compare(files: RunFiles, recomputed: dict[str, float | None]) -> None:
    """Report every metric of metrics.json that is missing, unknown, or not what the decisions give."""
    stated, problems = files.metrics, files.problems
    for key in sorted(key for key in stated.keys() - recomputed.keys() if not is_measured(key)):
        problems.add(f"metrics.json: unknown metric {key}")
    for key, value in recomputed.items():
        if key not in stated:
            problems.add(f"metrics.json: {key} is missing")
        elif not _agree(stated[key], value):
            problems.add(f"metrics.json: {key} is {stated[key]}, the decisions give {value}")
    _check_speed(files)
    unproved: Any = stated.get(UNPROVED, 0)
    if not is_number(unproved) or unproved != int(unproved) or not 0 <= unproved <= len(files.decisions):
        problems.add(f"metrics.json: {UNPROVED} is {unproved}, not a number of the {len(files.decisions)} requests")


def _check_speed(files: RunFiles) -> None:
    seconds: Any = files.metrics.get(SECONDS)
    speed: Any = files.metrics.get(SPEED)
    if not is_number(seconds) or seconds < 0:
        files.problems.add(f"metrics.json: {SECONDS} is {seconds}, not a time")
    elif not _agree(speed, len(files.decisions) / seconds if seconds else None):
        files.problems.add(f"metrics.json: {SPEED} is {speed}, which does not fit {SECONDS}")


def _agree(stated: Any, value: float | None) -> bool:
    if stated is None or value is None:
        return stated is value
    return is_number(stated) and math.isclose(stated, value, rel_tol=TOLERANCE, abs_tol=1e-12)


def _vms(decided: Decided) -> list[float]:
    """Share of what VMs could carry that they carry in every counted slot, the mean over the kinds of resources."""
    kinds = range(len(decided.run.vm_used[0]))
    total = [sum(vm.units[kind] for here in decided.files.vms for vm in here) for kind in kinds]
    counted = decided.run.vm_used[decided.files.scenario["warmup"] :]
    return [sum(used[kind] / total[kind] for kind in kinds) / len(kinds) for used in counted]


def _links(decided: Decided) -> tuple[list[int], int]:
    """The same of links."""
    total = sum(link.units for link in decided.files.links.values())
    return decided.run.link_used[decided.files.scenario["warmup"] :], total


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _mean(values: list[Any]) -> float | None:
    return math.fsum(values) / len(values) if values else None
