"""Whether requests ask for what their services may draw: a rate and a tolerable delay from the intervals of each."""

from __future__ import annotations

import math
from typing import Any

from nfv_torchrl.evaluation.audit.files import PAPER_KINDS, RunFiles, Service

CLOSE = 1e-6
"""Values are rounded to so much."""


def check_drawn(files: RunFiles) -> None:
    """Report requests of services with an interval that ask for something outside it, or for nothing of their own."""
    if files.scenario["workload_path"] is not None:  # a file may ask for anything
        return
    entries = {entry["name"]: entry for entry in files.scenario["services"]}
    for line, request in enumerate(files.workload, start=2):
        entry = entries[request.service]
        if not (isinstance(entry["rate"], list) or isinstance(entry["tolerable_delay"], list)):
            continue
        where = f"workload.csv line {line}: {request.service} draws what its requests ask for, and this one"
        if not request.demand:
            files.problems.add(f"{where} says nothing")
        elif not _may_be_drawn(files, entry, files.asked(request)):
            files.problems.add(f"{where} asks for something else")


def _may_be_drawn(files: RunFiles, entry: dict[str, Any], asked: Service) -> bool:
    chain = [files.scenario["vnfs"][vnf] for vnf in entry["chain"]]
    rates = entry.get("rates") or [asked.rate[0]] * (len(chain) + 1)
    kinds = files.scenario.get("resources") or PAPER_KINDS
    if len(asked.load) != len(chain) or list(asked.rate) != rates:
        return False
    tolerable = entry["tolerable_delay"]
    if not _within(asked.rate[0], entry["rate"] if not entry.get("rates") else rates[0]):
        return False
    if not _within(asked.tolerable_delay, math.inf if tolerable is None else tolerable):
        return False
    return all(
        math.isclose(amount, _needs(vnf, kind, kinds) * (rate if kind["scales_with_rate"] else 1.0), abs_tol=CLOSE)
        for vnf, rate, amounts in zip(chain, rates, asked.load, strict=False)
        for kind, amount in zip(kinds, amounts, strict=True)
    )


def _needs(vnf: Any, kind: dict[str, Any], kinds: list[dict[str, Any]]) -> float:
    if isinstance(vnf, dict):
        return vnf.get(kind["name"], 0.0)
    return vnf if kind is kinds[0] else 0.0


def _within(value: float, stated: Any) -> bool:
    low, high = stated if isinstance(stated, list) else (stated, stated)
    return low - CLOSE <= value <= high + CLOSE
