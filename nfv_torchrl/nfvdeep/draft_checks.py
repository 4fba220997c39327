"""Plans under construction from a checkpoint: checked before a kernel follows their routes and undoes their steps."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.nfvdeep.drafts import OPEN, Drafts, Options, revise_env
from nfv_torchrl.simulator.snapshot_checks import check_form, refuse, require, require_range, retrace
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.steps import Step


def restore_drafts(
    world: World, options: Options, drafts: Drafts, copies: dict[str, np.ndarray], started: np.ndarray
) -> Drafts:
    """Drafts with the arrays ``copies``, which go with ``world``; ``drafts`` stay as they are.

    Args:
        started: bool [B], environments whose horizon has begun; the others' drafts begin with it.

    Raises:
        CheckpointError: planning cannot have led to them.
    """
    for name, like in drafts._asdict().items():
        if name not in copies:
            refuse(f"drafts.{name}", "is missing")
        check_form(f"drafts.{name}", copies[name], like)
    for name in copies:
        if name not in drafts._fields:
            refuse(f"drafts.{name}", "is not known")
    restored = Drafts(**{name: np.array(copies[name], order="C") for name in drafts._fields})
    for array in restored:
        array[~started] = 0
    _check_ranges(world, options, restored)
    again = Drafts(*(array.copy() for array in restored))
    for b in np.flatnonzero(started).tolist():
        if not world.env["done"][b]:
            _check_plan(world, restored, b)
        revise_env(world, options, again, b)
    for name, here, there in zip(drafts._fields, restored, again, strict=True):
        same = np.array_equal(here[started], there[started])
        require(np.array([same]), f"drafts.{name}", "is not what planning leads to")
    return restored


def _check_ranges(world: World, options: Options, drafts: Drafts) -> None:
    _, nodes, vms, _ = world.tables.vm_capacity.shape
    limits = {
        "state": (OPEN, OPEN),
        "placed": (0, drafts.choice.shape[1]),
        "node": (0, nodes - 1),
        "steps": (0, world.rules.max_steps),
        "backtracks": (0, options.backtracks),
        "choice": (0, nodes - 1),
        "before_steps": (0, world.rules.max_steps),
        "before_node": (0, nodes - 1),
        "hops": (0, nodes),
        "via_node": (0, nodes - 1),
        "via_link": (0, world.tables.link_capacity.shape[1] - 1),
        "vm": (-1, vms - 1),
    }
    for name, (low, high) in limits.items():
        require_range(getattr(drafts, name), low, high, f"drafts.{name}")
    for name in ("elapsed", "before_elapsed"):
        values = getattr(drafts, name)
        require(np.isfinite(values) & (values >= 0), f"drafts.{name}", "is negative or no finite number")


def _check_plan(world: World, drafts: Drafts, b: int) -> None:
    """The steps written so far lead from the ingress through the nodes chosen, and use what the draft's books say."""
    e, tables, placed = world.env[b], world.tables, int(drafts.placed[b])
    where = f"of environment {b}"
    if placed >= tables.chain_length[e["profile"]]:
        refuse(f"drafts.placed {where}", "leaves no function to place")
    actions = drafts.action[b, : drafts.steps[b]]
    steps = retrace(tables, int(e["net"]), int(e["profile"]), int(e["ingress"]), actions)
    if steps is None:
        refuse(f"drafts.action {where}", "is no walk in this network")
    ends = [k + 1 for k, step in enumerate(steps) if step.places]
    if len(ends) != placed or len(steps) != (ends[-1] if ends else 0):
        refuse(f"drafts.placed {where}", "is not how many functions its steps place")
    begins = [0, *ends]
    nodes = [int(e["ingress"]), *(steps[end - 1].node for end in ends)]
    expected = {"choice": nodes[1:], "before_steps": begins[:-1], "before_node": nodes[:-1]}
    for name, values in expected.items():
        if getattr(drafts, name)[b, :placed].tolist() != values:
            refuse(f"drafts.{name} {where}", "is not what its steps say")
    if drafts.node[b] != nodes[-1]:
        refuse(f"drafts.node {where}", "is not where its steps lead")
    if drafts.link[b, : len(steps)].tolist() != [step.link for step in steps]:
        refuse(f"drafts.link {where}", "is not what its steps use")
    _check_use(world, drafts, b, steps)


def _check_use(world: World, drafts: Drafts, b: int, steps: list[Step]) -> None:
    tables, profile = world.tables, world.env["profile"][b]
    vm_used, link_used = np.zeros_like(drafts.vm_used[b]), np.zeros_like(drafts.link_used[b])
    function = 0
    for step in steps:
        if step.link >= 0:
            link_used[step.link] += tables.rate_units[profile, function]
        if step.places:
            vm_used[step.node, step.vm] += tables.load_units[profile, function]
            function += 1
    for name, used in (("vm_used", vm_used), ("link_used", link_used)):
        if not np.array_equal(getattr(drafts, name)[b], used):
            refuse(f"drafts.{name} of environment {b}", "is not what its steps use")
