"""The metrics of a replayed run, computed anew and compared with what metrics.json states."""

from __future__ import annotations

import math
from typing import Any

from nfv_torchrl.evaluation.audit.files import RunFiles, is_number
from nfv_torchrl.evaluation.audit.rejections import REASONS
from nfv_torchrl.evaluation.audit.replay import Answer, Replayed

TOLERANCE = 1e-7
"""Relative difference that a stated metric may have from the recomputed one."""
MEASURED = ("decision_seconds", "decisions_per_second")
"""Wall times: the files cannot tell whether these are true, only whether they fit each other."""


def recompute_metrics(files: RunFiles, run: Replayed) -> dict[str, float | None]:
    """All metrics that follow from the decisions; None where one does not exist."""
    warmup = files.scenario["warmup"]
    arrived = [answer for answer in run.answers if answer.request.slot >= warmup]
    accepted = [answer for answer in arrived if answer.accepted]
    metrics: dict[str, float | None] = {
        "rho": offered_load(files),
        "arrived": len(arrived),
        "accepted": len(accepted),
        "aar": _share(len(accepted), len(arrived)),
        "anuc": _mean_cost_per_slot(files, run),
        "cost_per_accepted": _mean([answer.walk.cost for answer in accepted]),
        "mean_hops": _mean([answer.walk.hops for answer in accepted]),
        "mean_delay_ms": _mean([answer.walk.delay for answer in accepted]),
    }
    for service in files.services:
        mine = [answer for answer in accepted if answer.request.service == service]
        asked = sum(answer.request.service == service for answer in arrived)
        metrics[f"aar/{service}"] = _share(len(mine), asked)
        metrics[f"cost_per_accepted/{service}"] = _mean([answer.walk.cost for answer in mine])
    for reason in REASONS:
        metrics[f"rejected/{reason}"] = _share(sum(answer.reason == reason for answer in arrived), len(arrived))
    metrics |= _utilisation(files, run) | _interruptions(accepted)
    return metrics


def offered_load(files: RunFiles) -> float:
    """Load of the requests that would run at the end of the horizon if all were accepted, over the VMs' capacity.

    Rate, mean lifetime and mean load are those of the scenario, or of the requests where these came from a file.
    """
    scenario, services = files.scenario, files.services.values()
    rate, life = scenario["arrival_rate"], scenario["mean_lifetime"]
    load = sum(each.weight * sum(each.load) for each in services) / sum(each.weight for each in services)
    if scenario["workload_path"] is not None:
        count = len(files.workload)
        rate, life = count / scenario["horizon"], math.fsum(request.lifetime for request in files.workload) / count
        load = math.fsum(sum(files.services[request.service].load) for request in files.workload) / count
    present = rate * life * -math.expm1(-scenario["horizon"] / life)
    return present * load / math.fsum(vm.capacity for here in files.vms for vm in here)


def compare(files: RunFiles, recomputed: dict[str, float | None]) -> None:
    """Report every metric of metrics.json that is missing, unknown, or not what the decisions give."""
    stated, problems = files.metrics, files.problems
    for key in sorted(stated.keys() - recomputed.keys() - set(MEASURED)):
        problems.add(f"metrics.json: unknown metric {key}")
    for key, value in recomputed.items():
        if key not in stated:
            problems.add(f"metrics.json: {key} is missing")
        elif not _agree(stated[key], value):
            problems.add(f"metrics.json: {key} is {stated[key]}, the decisions give {value}")
    _check_speed(files)


def _check_speed(files: RunFiles) -> None:
    seconds: Any = files.metrics.get(MEASURED[0])
    speed: Any = files.metrics.get(MEASURED[1])
    if not is_number(seconds) or seconds < 0:
        files.problems.add(f"metrics.json: {MEASURED[0]} is {seconds}, not a time")
    elif not _agree(speed, len(files.decisions) / seconds if seconds else None):
        files.problems.add(f"metrics.json: {MEASURED[1]} is {speed}, which does not fit {MEASURED[0]}")


def _agree(stated: Any, value: float | None) -> bool:
    if stated is None or value is None:
        return stated is value
    return is_number(stated) and math.isclose(stated, value, rel_tol=TOLERANCE, abs_tol=1e-12)


def _mean_cost_per_slot(files: RunFiles, run: Replayed) -> float:
    """Each request costs its phi in every slot that it runs; summed by request, not slot by slot."""
    first, horizon = files.scenario["warmup"], files.scenario["horizon"]
    spent = (
        answer.walk.cost * max(0, min(answer.end, horizon) - max(answer.request.slot, first))
        for answer in run.answers
        if answer.accepted
    )
    return math.fsum(spent) / (horizon - first)


def _utilisation(files: RunFiles, run: Replayed) -> dict[str, float | None]:
    vms = sum(vm.units for here in files.vms for vm in here)
    links = sum(link.units for link in files.links.values())
    result: dict[str, float | None] = {}
    for name, used, total in (("vm", run.vm_used, vms), ("link", run.link_used, links)):
        counted = used[files.scenario["warmup"] :]
        result[f"{name}_utilisation"] = sum(counted) / total / len(counted)
        result[f"{name}_utilisation_peak"] = max(counted) / total
    return result


def _interruptions(accepted: list[Answer]) -> dict[str, float | None]:
    lost = [answer.request.departure - answer.end for answer in accepted if answer.interrupted_at is not None]
    return {"interrupted": _share(len(lost), len(accepted)), "lost_service_time": sum(lost)}


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _mean(values: list[Any]) -> float | None:
    return math.fsum(values) / len(values) if values else None
