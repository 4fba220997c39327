"""Which steps a walk may take, whatever is left of the capacities: the sets A_p of the model, written a second time."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.evaluation.audit.files import Request, RunFiles

STATED_DELAY_TOLERANCE = 1e-6
"""ms."""

Resource = tuple[str, int, int]
"""("vm", node, index) or ("link", smaller end, larger end)."""


def rule_broken(files: RunFiles, request: Request, node: int, placed: int, step: list[Any]) -> str | None:
    """What is wrong with going from ``node`` to ``step`` when ``placed`` functions are placed; None if nothing."""
    to, _, function = step
    chain = len(files.services[request.service].load)
    if node == request.egress and placed == chain:
        return "comes after the walk has ended at the egress"
    if to == node and function is None:
        return f"stays on node {node} and places nothing"
    if to == node and node != request.egress and not files.scenario["colocation"]:
        return f"places again on node {node}, but colocation is off"
    if to != node and node == request.egress:
        return f"leaves the egress {node}, where the walk has to end"
    if to != node and (min(node, to), max(node, to)) not in files.links:
        return f"there is no link between {node} and {to}"
    if function is not None and (function != placed or placed == chain):
        expected = f"function {placed} is next" if placed < chain else "all functions are placed"
        return f"places function {function}, but {expected}"
    return None
