"""What a snapshot must satisfy before a kernel sees it: kernels check no bounds, and follow chains to their ends.

A snapshot may come from anyone. Whatever can be worked out from the scenario and the rest of the snapshot is worked out
again and compared; of the rest, every index and count is checked for its range.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from nfv_torchrl.codec import count_actions, decode_action, link_resource, vm_resource
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.simulator.reasons import NO_REASON, REASON_NAMES
from nfv_torchrl.simulator.state import OUTCOME, REQUEST, Arrivals, Ledger, Running, Walk, World
from nfv_torchrl.simulator.steps import Step
from nfv_torchrl.simulator.tables import Tables
from nfv_torchrl.simulator.view import SHARE_LEVELS

REMEDY = "use a checkpoint that this scenario's run wrote"


def refuse(name: str, what: str) -> NoReturn:
    """Raise the ``CheckpointError`` for the array ``name`` of a snapshot."""
    raise CheckpointError(f"snapshot: {name} {what}; {REMEDY}")


def require(holds: np.ndarray, name: str, what: str) -> None:
    """Refuse unless ``holds`` bool [B, ...] is true everywhere; ``what`` is said of the first environment at fault."""
    if not np.all(holds):
        refuse(f"{name} of environment {int(np.argwhere(~np.asarray(holds))[0][0])}", what)


def require_range(values: np.ndarray, low: int, high: int | np.ndarray, name: str) -> None:
    """Refuse unless every number of ``values`` [B, ...] is in low .. high, both included."""
    require((values >= low) & (values <= high), name, f"is outside {low} .. {int(np.max(high))}")


def check_form(name: str, array: object, like: np.ndarray, shape: tuple[int, ...] | None = None) -> None:
    """Refuse unless ``array`` is an array of the dtype of ``like``, and of its shape or ``shape``."""
    shape = like.shape if shape is None else shape
    if not isinstance(array, np.ndarray):
        refuse(name, f"is a {type(array).__name__}, not an array")
    if array.dtype != like.dtype:
        refuse(name, f"has dtype {array.dtype}, not {like.dtype}")
    if array.shape != shape:
        refuse(name, f"has shape {list(array.shape)}, not {list(shape)}: another scenario")
    if array.dtype == np.bool_ and array.size and np.ascontiguousarray(array).view(np.uint8).max() > 1:
        refuse(name, "has bytes that are no truth values")


def check_world(now: World, world: World, started: np.ndarray) -> None:
    """Refuse ``world``, made of a snapshot, unless stepping could have led to it.

    Args:
        now: the world it is loaded into, which has the horizons' arrivals and the scenario's numbers.
        world: arrays of the right shapes and dtypes, with anything in them.
        started: bool [B], environments whose horizon has begun; the others are not looked at.
    """
    rows = np.flatnonzero(started)
    if not len(rows):
        return
    here = _rows(world, rows)
    _check_constants(now.env[rows], here, ("net", "horizon", "warmup"))
    _check_capacities(here)
    _check_constants(now.env[rows], here, ("num_requests", "num_events"))
    _check_request(here)
    _check_outcome(here)
    _check_failures(here)
    taken = _check_walks(here) + _check_running(here)
    _check_books(here, taken)
    _check_flat(here)


def _rows(world: World, rows: np.ndarray) -> World:
    """Copies of the environments ``rows``; tables, rules and log are the same."""
    seen = world.seen._replace(mask=world.seen.mask[rows], valid=world.seen.valid[rows], flat=world.seen.flat[rows])
    return world._replace(
        env=world.env[rows],
        ledger=Ledger(*(array[rows] for array in world.ledger)),
        arrivals=Arrivals(*(array[rows] for array in world.arrivals)),
        running=Running(*(array[rows] for array in world.running)),
        walk=Walk(*(array[rows] for array in world.walk)),
        seen=seen,
        outcome=world.outcome[rows],
    )


def _check_constants(now: np.ndarray, world: World, names: tuple[str, ...]) -> None:
    """What the scenario and the horizon's arrivals determine."""
    for name in names:
        require(world.env[name] == now[name], f"env.{name}", "is not this scenario's")


def _check_request(world: World) -> None:
    """Slot, cursors, the request in hand and the counters of its walk."""
    places = world.log.action.shape[1] - world.rules.max_steps if world.log.enabled else 0
    require_range(world.env["log_length"], 0, max(places, 0), "env.log_length")
    e, tables, arrivals = world.env, world.tables, world.arrivals
    nodes = tables.num_nodes[e["net"]] - 1
    require_range(e["slot"], 0, e["horizon"], "env.slot")
    require(e["done"] == (e["slot"] == e["horizon"]), "env.done", "does not go with the slot")
    live = e["done"] == 0
    require_range(e["cursor"], 0, e["num_requests"] - live, "env.cursor")
    require_range(e["service"], 0, len(tables.rate) - 1, "env.service")
    for name in ("ingress", "egress", "node"):
        require_range(e[name], 0, nodes, f"env.{name}")
    require_range(e["last_vm"], 0, np.maximum(tables.vm_count[e["net"], e["node"]] - 1, 0), "env.last_vm")
    require_range(e["function"], 0, tables.chain_length[e["service"]], "env.function")
    require_range(e["steps"], 0, world.rules.max_steps, "env.steps")
    require_range(e["hops"], 0, e["steps"], "env.hops")
    require_range(e["request_slot"], 0, e["slot"], "env.request_slot")
    for name in ("lifetime", "service_share", "elapsed", "cost"):
        require(np.isfinite(e[name]) & (e[name] >= 0), f"env.{name}", "is negative or no finite number")
    require(np.isfinite(e["running_cost"]), "env.running_cost", "is no finite number")
    row = np.flatnonzero(live)
    request = e["cursor"][row]
    for name in REQUEST:
        expected = e[name].copy()
        expected[row] = getattr(arrivals, name)[row, request]
        require(e[name] == expected, f"env.{name}", "is not that of the request at the cursor")
    expected = e["slot"].copy()
    expected[row] = arrivals.slot[row, request]
    require(e["slot"] == expected, "env.slot", "is not that of the request at the cursor")
    require((e["request_slot"] == e["slot"]) | ~live, "env.request_slot", "is not that of the request at the cursor")


def _check_outcome(world: World) -> None:
    """Flags, codes and counts of the last step; they index the sums of a log line."""
    out, e = world.outcome, world.env
    ranges: dict[int, tuple[int, int | np.ndarray]] = {
        OUTCOME.passed: (0, 1),
        OUTCOME.request_done: (0, 1),
        OUTCOME.accepted: (0, 1),
        OUTCOME.done: (0, e["done"]),
        OUTCOME.reason: (NO_REASON, len(REASON_NAMES) - 1),
        OUTCOME.service: (0, len(world.tables.rate) - 1),
        OUTCOME.request_slot: (0, e["horizon"] - 1),
        OUTCOME.request_hops: (0, world.rules.max_steps),
        OUTCOME.slots_closed: (0, e["horizon"]),
        OUTCOME.interrupted: (0, e["num_requests"]),
    }
    for name, column in OUTCOME._asdict().items():
        require(np.isfinite(out[:, column]), f"outcome.{name}", "is no finite number")
        if column in ranges:
            require_range(out[:, column], *ranges[column], f"outcome.{name}")
            require(out[:, column] == np.floor(out[:, column]), f"outcome.{name}", "is no integer")
        elif column != OUTCOME.slot_cost:  # a difference of sums
            require(out[:, column] >= 0, f"outcome.{name}", "is negative")


def _check_failures(world: World) -> None:
    """The event cursor, and which resources have failed, as the timeline has it up to the current slot."""
    e, arrivals, ledger = world.env, world.arrivals, world.ledger
    failed = np.zeros((len(e), _capacity(world).shape[1]), np.bool_)
    for b, (slot, horizon, events) in enumerate(zip(e["slot"], e["horizon"], e["num_events"], strict=True)):
        waiting = np.flatnonzero(arrivals.event_slot[b, :events] > min(slot, horizon - 1))
        past = int(waiting[0]) if len(waiting) else int(events)
        if e["event_cursor"][b] != past:
            refuse(f"env.event_cursor of environment {b}", f"is {e['event_cursor'][b]}, not {past}")
        failed[b, arrivals.event_resource[b, :past]] = ~arrivals.event_up[b, :past]  # the last of several counts
    vms = ledger.vm_failed[0].size
    for name, expected in (("vm_failed", failed[:, :vms]), ("link_failed", failed[:, vms:])):
        flags = getattr(ledger, name)
        require(flags == expected.reshape(flags.shape), f"ledger.{name}", "is not what the failures led to")


def retrace(tables: Tables, net: int, service: int, ingress: int, actions: np.ndarray) -> list[Step] | None:
    """The steps of ``actions`` int [steps] from ``ingress``; None where a walk cannot go like that."""
    _, nodes, vms = tables.vm_capacity.shape
    at, functions, steps = ingress, 0, []
    for action in actions.tolist():
        node, vm, place = decode_action(action, vms)
        if not 0 <= action < count_actions(nodes, vms) - 1 or node >= tables.num_nodes[net]:
            return None
        link = -1
        if node != at:
            around = np.flatnonzero(tables.neighbour[net, at, : tables.degree[net, at]] == node)
            if not len(around):
                return None
            link = int(tables.neighbour_link[net, at, around[0]])
        functions += place
        if functions > tables.chain_length[service] or (place and vm >= tables.vm_count[net, node]):
            return None
        steps.append(Step(link, node, vm, place))
        at = node
    return steps


def _check_walks(world: World) -> np.ndarray:
    """Walks in progress, step by step from the ingress. Returns what they reserve, int64 [B, N V + L]."""
    e, walk, tables = world.env, world.walk, world.tables
    taken = np.zeros(_capacity(world).shape, np.int64)
    _, nodes, vms = tables.vm_capacity.shape
    for b in range(len(e)):
        if e["done"][b]:
            if e["entries"][b]:
                refuse(f"env.entries of environment {b}", "is not 0 after the end of the horizon")
            continue
        net, service, ingress = (int(e[name][b]) for name in ("net", "service", "ingress"))
        steps = retrace(tables, net, service, ingress, walk.action[b, : e["steps"][b]])
        if steps is None:
            refuse(f"walk.action of environment {b}", "is no walk in this network")
        entries, function = [], 0
        for step in steps:
            if step.link >= 0:
                entries.append((link_resource(step.link, nodes, vms), tables.rate_units[service]))
            if step.places:
                entries.append((vm_resource(step.node, step.vm, vms), tables.load_units[service, function]))
                function += 1
        last = steps[-1] if steps else Step(-1, ingress, 0, False)
        hops = sum(step.link >= 0 for step in steps)
        expected = {"node": last.node, "last_vm": last.vm, "function": function, "hops": hops, "entries": len(entries)}
        for name, value in expected.items():
            if e[name][b] != value:
                refuse(f"env.{name} of environment {b}", f"is {e[name][b]}, but its walk leads to {value}")
        for k, (resource, amount) in enumerate(entries):
            if walk.resource[b, k] != resource or walk.amount[b, k] != amount:
                refuse(f"walk.resource of environment {b}", "and walk.amount are not what its walk reserves")
            taken[b, resource] += amount
    return taken


def _check_running(world: World) -> np.ndarray:
    """The pools: every place in one chain or free. Returns what running requests reserve, int64 [B, N V + L]."""
    e, running, arrivals = world.env, world.running, world.arrivals
    batch, records = running.record_next.shape
    require_range(e["free_record"], 0, records - 1, "env.free_record")
    require_range(e["free_entry"], 0, running.entry_next.shape[1] - 1, "env.free_entry")
    free = np.stack([e["free_record"], *running.head.T.astype(np.int64)], 1)
    slot = _trace(running.record_next, free, "running.record_next", "running.head") - 1  # -1: free
    in_use = slot >= 0
    _check_counts(e, "free_records", "num_running", in_use, 1)
    require((slot > np.minimum(e["slot"], e["horizon"] - 1)[:, None]) | ~in_use, "running.head", "holds what has left")
    request = running.record_request
    require(
        ((request >= 0) & (request < e["cursor"][:, None])) | ~in_use, "running.record_request", "is of no past request"
    )
    request = np.where(in_use, request, 0)
    leaves = np.minimum(np.take_along_axis(arrivals.departure, request, 1), e["horizon"][:, None])
    require((leaves == slot) | ~in_use, "running.head", "has a request in another slot than that of its departure")
    listed = np.sort(np.where(in_use, request, -1 - np.arange(records)), 1)
    require(np.diff(listed, axis=1) > 0, "running.record_request", "has a request twice")
    require(
        (np.isfinite(running.record_cost) & (running.record_cost >= 0)) | ~in_use,
        "running.record_cost",
        "is negative or no finite number",
    )
    heads = np.concatenate([e["free_entry"][:, None], np.where(in_use, running.record_entry, -1)], 1)
    reserved = _trace(running.entry_next, heads, "running.entry_next", "running.record_entry") > 0
    _check_counts(e, "free_entries", None, reserved, 2 * world.rules.max_steps)
    capacity = _capacity(world)
    require(
        ((running.entry_resource >= 0) & (running.entry_resource < capacity.shape[1])) | ~reserved,
        "running.entry_resource",
        "is no resource",
    )
    resource = np.where(reserved, running.entry_resource, 0)
    room = np.take_along_axis(capacity, resource, 1)
    require(
        ((running.entry_amount >= 0) & (running.entry_amount <= room) & (room > 0)) | ~reserved,
        "running.entry_amount",
        "is more than the resource has",
    )
    taken = np.zeros(capacity.shape, np.int64)
    np.add.at(taken, (np.arange(batch)[:, None], resource), np.where(reserved, running.entry_amount, 0))
    return taken


def _check_counts(e: np.ndarray, free: str, used: str | None, in_use: np.ndarray, least: int) -> None:
    """Free and used places as counted; ``least`` must be free, for the next step to fill."""
    require(e[free] == (~in_use).sum(1), f"env.{free}", "is not how many are chained as free")
    require(e[free] >= least, f"env.{free}", f"is below {least}")
    if used is not None:
        require(e[used] == in_use.sum(1), f"env.{used}", "is not how many are chained")


def _trace(following: np.ndarray, heads: np.ndarray, name: str, starts: str) -> np.ndarray:
    """Follow chains from ``heads`` int [B, H] through ``following`` int [B, size] to their ends (-1).

    Returns which chain each place is in, int [B, size]. Every place must be in one, and in one only.
    """
    size = following.shape[1]
    owner = np.full(following.shape, -1, np.int64)
    require_range(heads, -1, size - 1, starts)
    rows, chains = np.nonzero(heads >= 0)
    places = heads[rows, chains]
    while len(places):
        again = owner[rows, places] >= 0
        owner[rows, places] = chains
        again |= owner[rows, places] != chains  # two chains come to a place at the same time
        if again.any():
            refuse(f"{name} of environment {rows[again][0]}", "has a cycle, or two chains that meet")
        places = following[rows, places].astype(np.int64)
        if len(places) and not (places.min() >= -1 and places.max() < size):
            refuse(f"{name} of environment {rows[0]}", f"is outside -1 .. {size - 1}")
        rows, chains, places = (array[places >= 0] for array in (rows, chains, places))
    require(owner >= 0, name, "leaves places out")
    return owner


def _capacity(world: World) -> np.ndarray:
    """Capacities of VMs and links, int64 [B, N V + L] in ledger units; 0 where there is none."""
    tables, net = world.tables, world.env["net"]
    return np.concatenate([tables.vm_capacity[net].reshape(len(net), -1), tables.link_capacity[net]], 1)


def _check_capacities(world: World) -> None:
    """A network of the same size is not yet the same network: reserved and offered must make up its capacities."""
    ledger, tables, net = world.ledger, world.tables, world.env["net"]
    for kind, capacity in (("vm", tables.vm_capacity), ("link", tables.link_capacity)):
        reserved, offered, failed = (getattr(ledger, f"{kind}_{name}") for name in ("reserved", "offered", "failed"))
        require((reserved >= 0) & (offered >= 0), f"ledger.{kind}_reserved", f"or {kind}_offered is negative")
        made_up = np.where(failed, offered == 0, reserved + offered == capacity[net])
        require(made_up, f"ledger.{kind}_offered", "and what is reserved do not make up this network's capacities")


def _check_books(world: World, taken: np.ndarray) -> None:
    """The ledger holds what walks and running requests have ``taken`` int64 [B, N V + L], no more and no less."""
    e, ledger = world.env, world.ledger
    vms = ledger.vm_reserved[0].size
    for kind, amounts in (("vm", taken[:, :vms]), ("link", taken[:, vms:])):
        reserved = getattr(ledger, f"{kind}_reserved").reshape(len(e), -1)
        require(reserved == amounts, f"ledger.{kind}_reserved", "is not what walks and running requests hold")
        require(e[f"{kind}_used"] == amounts.sum(1), f"env.{kind}_used", "is not the sum of what is reserved")


def _check_flat(world: World) -> None:
    """The observation: shares from the books, the request's numbers, and where its ones are."""
    e, tables, flat = world.env, world.tables, world.seen.flat
    batch = len(e)
    capacity = _capacity(world)
    offered = np.concatenate([world.ledger.vm_offered.reshape(batch, -1), world.ledger.link_offered], 1)
    exists = capacity > 0
    shares = (capacity - offered) * SHARE_LEVELS // np.where(exists, capacity, 1) / SHARE_LEVELS
    base = capacity.shape[1]
    require(flat[:, :base] == np.where(exists, shares, 0).astype(np.float32), "seen.flat", "is not what the books say")
    _, nodes, vms = tables.vm_capacity.shape
    services, functions = tables.load.shape
    numbers = (
        e["service_share"],
        e["node"] / max(nodes - 1, 1),
        e["last_vm"] / max(vms - 1, 1),
        e["function"] / functions,
        e["elapsed"] / tables.tolerable_delay[e["service"]],
    )
    live = e["done"] == 0
    for place, values in enumerate(numbers, start=base):
        # After the horizon's end the last request's are shown, of a step that was not its last.
        there = flat[:, place]
        shown = np.where(live, there == values.astype(np.float32), (there >= 0) & (there < 2))
        require(shown, "seen.flat", "is not what the walk says")
    first = base + 5
    ones = np.zeros((batch, flat.shape[1] - first), np.float32)
    blocks = {"service": services, "node": nodes, "egress": nodes, "function": functions + 1}
    for name, size in blocks.items():
        hot, at = e[f"hot_{name}"], e[name]
        if world.seen.one_hot:
            inside = (hot >= first) & (hot < first + size)
            require(np.where(live, hot == first + at, inside | (hot == -1)), f"env.hot_{name}", "is not its place")
            rows = np.flatnonzero(inside)
            ones[rows, hot[rows] - base - 5] = 1.0
            first += size
        else:
            require(hot == -1, f"env.hot_{name}", "is set without one-hot features")
    require(flat[:, base + 5 :] == ones, "seen.flat", "has ones elsewhere than at the request's places")
