"""Copies of a running world, to stop and to go on later to the bit."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.simulator.state import ENV_DTYPE, World

_GROUPS = ("ledger", "running", "walk")
_SEEN = ("mask", "valid", "flat")


def take_snapshot(world: World) -> dict[str, np.ndarray]:
    """Everything that stepping changes, as copies; arrivals and failures come from their seeds and are left out."""
    copies = {"env": world.env.view(np.uint8).reshape(len(world.env), -1).copy()}
    for group in _GROUPS:
        for name, array in getattr(world, group)._asdict().items():
            copies[f"{group}.{name}"] = array.copy()
    for name in _SEEN:
        copies[f"seen.{name}"] = getattr(world.seen, name).copy()
    copies["outcome"] = world.outcome.copy()
    return copies


def restore_snapshot(world: World, copies: dict[str, np.ndarray]) -> World:
    """``world`` with the arrays of a snapshot; its arrivals must be those of the snapshot already.

    Raises:
        CheckpointError: the snapshot is of another batch size, network size or version.
    """
    names = ["env", *(f"{g}.{n}" for g in _GROUPS for n in getattr(world, g)._fields), *(f"seen.{n}" for n in _SEEN)]
    names.append("outcome")
    missing = [name for name in names if name not in copies]
    if missing:
        raise CheckpointError(f"the environment's snapshot lacks {missing[0]}; it was written by another version")
    env = copies["env"]
    if env.shape != (len(world.env), ENV_DTYPE.itemsize):
        raise CheckpointError(f"the snapshot holds {env.shape[0]} environments, this run has {len(world.env)}")
    for name in ("ledger.vm_offered", "ledger.link_offered", "seen.mask", "seen.flat", "running.head", "walk.action"):
        group, field = name.split(".")
        if copies[name].shape != getattr(getattr(world, group), field).shape:
            raise CheckpointError(f"the snapshot's {name} has shape {copies[name].shape}: another scenario")
    _check_books(world, copies)
    world.env[:] = np.ascontiguousarray(env).view(ENV_DTYPE).reshape(-1)
    fresh = {
        group: getattr(world, group)._replace(
            **{name: copies[f"{group}.{name}"].copy() for name in getattr(world, group)._fields}
        )
        for group in _GROUPS
    }
    mask, valid, flat = (copies[f"seen.{name}"].copy() for name in _SEEN)
    seen = world.seen._replace(mask=mask, valid=valid, flat=flat)
    world.outcome[:] = copies["outcome"]
    return world._replace(seen=seen, **fresh)


def _check_books(world: World, copies: dict[str, np.ndarray]) -> None:
    """A network of the same size is not yet the same network: reserved and offered must make up its capacities."""
    for kind, capacity in (("vm", world.tables.vm_capacity), ("link", world.tables.link_capacity)):
        reserved, offered, failed = (copies[f"ledger.{kind}_{name}"] for name in ("reserved", "offered", "failed"))
        if np.any((reserved + offered != capacity[world.env["net"]]) & ~failed):
            raise CheckpointError(f"the snapshot's {kind} capacities are not this network's: another scenario")
