"""Which steps a walk may take, whatever is left of the capacities: the sets A_p of the model, written a second time."""

from __future__ import annotations

from typing import Any, NamedTuple

from nfv_torchrl.evaluation.audit.files import FREE, Request, RunFiles

STATED_DELAY_TOLERANCE = 1e-6
"""ms."""

Resource = tuple[str, int, int]
"""("vm", node, index) or ("link", smaller end, larger end); with full duplex ("link", tail, head)."""


class Progress(NamedTuple):
    """Where a walk is: its node (``FREE``: off the network), functions placed, and the nodes that they stand on."""

    node: int
    placed: int
    stands_on: frozenset[int] = frozenset()


def rule_broken(files: RunFiles, request: Request, at: Progress, step: list[Any]) -> str | None:
    """What is wrong with going on from ``at`` by ``step``; None if nothing."""
    to, _, function = step
    node, placed = at.node, at.placed
    chain = len(files.asked(request).load)
    if placed == chain and (node == request.egress or (request.egress == FREE and node != FREE)):
        return "comes after the walk has ended at the egress"
    if node == FREE:
        if function is None:
            return "is the first step of a request with a free ingress and places nothing"
    elif to == node and function is None:
        return f"stays on node {node} and places nothing"
    elif to == node and node != request.egress and not (files.scenario["colocation"] or files.distinct):
        return f"places again on node {node}, but colocation is off"
    elif to != node and node == request.egress and not files.distinct:
        return f"leaves the egress {node}, where the walk has to end"
    elif to != node and files.link_between(node, to) is None:
        return f"there is no link between {node} and {to}"
    if function is not None and files.distinct and to in at.stands_on:
        return f"places a second function of the request on node {to}, and functions may not share a node"
    if function is not None and (function != placed or placed == chain):
        expected = f"function {placed} is next" if placed < chain else "all functions are placed"
        return f"places function {function}, but {expected}"
    return None


def may_name(files: RunFiles, step: list[Any]) -> bool:
    """Whether a step names a VM that is there; one that forwards to a node without VMs names VM 0."""
    node, vm, function = step
    if not 0 <= node < len(files.vms):
        return False
    here = len(files.vms[node])
    return 0 <= vm < (max(here, 1) if function is None else here)
