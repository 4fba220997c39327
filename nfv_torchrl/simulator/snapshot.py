"""Copies of a running world, to stop and to go on later to the bit."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.simulator.mask import write_masks
from nfv_torchrl.simulator.snapshot_checks import check_form, check_world, refuse, require, require_range
from nfv_torchrl.simulator.state import ENV_DTYPE, Ledger, Running, Walk, World

_GROUPS = ("ledger", "running", "walk")
_SEEN = ("mask", "valid", "flat")


def take_snapshot(world: World) -> dict[str, np.ndarray]:
    """Everything that stepping changes, as copies; arrivals and failures come from their seeds and are left out."""
    return {name: array.copy() for name, array in _changing(world).items()}


def restore_snapshot(world: World, copies: dict[str, np.ndarray], started: np.ndarray | None = None) -> World:
    """A world with the arrays of a snapshot in place of those of ``world``, which stays as it is.

    Args:
        world: has the arrivals of the snapshot already.
        copies: what ``take_snapshot`` returned, or what someone says it did.
        started: bool [B], environments whose horizon has begun; the others become idle. None: all of them.

    Raises:
        CheckpointError: the snapshot is of another batch size, scenario or version, or stepping cannot have led to it.
    """
    started = np.ones(len(world.env), np.bool_) if started is None else started
    _check_forms(world, copies)
    env = np.array(copies["env"], order="C").view(ENV_DTYPE).reshape(-1)
    ledger, running, walk = (
        {name: np.array(copies[f"{group}.{name}"], order="C") for name in getattr(world, group)._fields}
        for group in _GROUPS
    )
    mask, valid, flat = (np.array(copies[f"seen.{name}"], order="C") for name in _SEEN)
    restored = world._replace(
        env=env,
        ledger=Ledger(**ledger),
        running=Running(**running),
        walk=Walk(**walk),
        seen=world.seen._replace(mask=mask, valid=valid, flat=flat),
        outcome=np.array(copies["outcome"], order="C"),
    )
    check_world(world, restored, started)
    _make_idle(world, restored, np.flatnonzero(~started))
    _check_masks(restored, started)
    return restored


def _changing(world: World) -> dict[str, np.ndarray]:
    """The arrays that a snapshot holds, by name."""
    arrays = {"env": world.env.view(np.uint8).reshape(len(world.env), -1)}
    for group in _GROUPS:
        arrays |= {f"{group}.{name}": array for name, array in getattr(world, group)._asdict().items()}
    arrays |= {f"seen.{name}": getattr(world.seen, name) for name in _SEEN}
    arrays["outcome"] = world.outcome
    return arrays


def _check_forms(world: World, copies: dict[str, np.ndarray]) -> None:
    """Names, dtypes and shapes. The pools may have grown, each kind of them alike."""
    expected = _changing(world)
    for name in expected:
        if name not in copies:
            refuse(name, "is missing")
    for name in copies:
        if name not in expected:
            refuse(str(name), "is not known")
    batch = len(world.env)
    for name, like in expected.items():
        there = copies[name]
        if isinstance(there, np.ndarray) and there.ndim and len(there) != batch:
            refuse(name, f"holds {len(there)} environments, this run has {batch}")
        shape = like.shape
        kind = name.removeprefix("running.").partition("_")[0]
        if name.removeprefix("running.") in Running._fields and kind in ("record", "entry"):
            columns = np.shape(copies[f"running.{kind}_next"])[1:2] or (0,)
            shape = (batch, max(int(columns[0]), 1))
        check_form(name, there, like, shape)


def _make_idle(now: World, world: World, rows: np.ndarray) -> None:
    """Environments before their first horizon, as in a new simulator; it begins with emptying the books."""
    running, e = world.running, world.env
    e[rows] = np.zeros((), ENV_DTYPE)
    for name in ("net", "horizon", "warmup", "num_requests", "num_events", "most_steps", "services"):
        e[name][rows] = now.env[name][rows]
    e["done"][rows] = 1
    e["free_records"][rows], e["free_entries"][rows] = running.record_next.shape[1], running.entry_next.shape[1]
    for array in (*world.ledger, *running, *world.walk, world.seen.mask, world.seen.valid, world.seen.flat):
        array[rows] = 0
    running.head[rows] = -1
    world.ledger.vm_offered[rows] = world.tables.vm_capacity[e["net"][rows]]
    world.ledger.link_offered[rows] = world.tables.link_capacity[e["net"][rows]]
    world.outcome[rows] = 0.0


def _check_masks(world: World, started: np.ndarray) -> None:
    """The possible actions are worked out again: one that is none of them would lead outside the tables."""
    seen, e = world.seen, world.env
    actions = seen.mask.shape[1]
    again = seen._replace(mask=np.zeros_like(seen.mask), valid=np.zeros_like(seen.valid))
    env = e.copy()
    env["mask_count"] = 0
    write_masks(world._replace(seen=again, env=env))
    rows = np.flatnonzero(started)
    require_range(e["mask_count"][rows], 1, actions, "env.mask_count")
    require(e["mask_count"][rows] == env["mask_count"][rows], "env.mask_count", "is not how many actions are possible")
    require(seen.mask[rows] == again.mask[rows], "seen.mask", "is not what is possible")
    listed = np.arange(actions) < e["mask_count"][rows, None]
    require((seen.valid[rows] == again.valid[rows]) | ~listed, "seen.valid", "is not what is possible")
