"""What a snapshot must satisfy before a kernel sees it: kernels check no bounds, and follow chains to their ends.

A snapshot may come from anyone. Whatever can be worked out from the scenario and the rest of the snapshot is worked out
again and compared; of the rest, every index and count is checked for its range.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from nfv_torchrl.codec import count_actions, count_vms, decode_action, link_resource, split_use, use_of, vm_resource
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.simulator.reasons import NO_REASON, REASON_NAMES
from nfv_torchrl.simulator.state import OUTCOME, REQUEST, Arrivals, Ledger, Running, Walk, World
from nfv_torchrl.simulator.steps import Step
from nfv_torchrl.simulator.tables import Tables
from nfv_torchrl.simulator.view import AT, SHARE_LEVELS, demand_size

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
    _check_constants(now.env[rows], here, ("net", "horizon", "warmup", "services"))
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
    require_range(e["profile"], 0, len(tables.rate) - 1, "env.profile")
    require(e["service"] == tables.service[e["profile"]], "env.service", "is not that of its profile")
    free = -1 if world.rules.free_ends else 0
    for name in ("ingress", "egress", "node"):
        require_range(e[name], free, nodes, f"env.{name}")
    require_range(e["last_vm"], 0, np.maximum(tables.vm_count[e["net"], e["node"]] - 1, 0), "env.last_vm")
    require_range(e["function"], 0, tables.chain_length[e["profile"]], "env.function")
    _check_most_steps(world)
    require_range(e["steps"], 0, e["most_steps"], "env.steps")
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


def _check_most_steps(world: World) -> None:
    """Steps left for the request in hand: J, less what its service has taken in this slot where services share J."""
    e, spent, rules = world.env, world.walk.spent, world.rules
    require_range(spent, 0, rules.max_steps if rules.shared_steps else 0, "walk.spent")
    left = np.full(len(e), rules.max_steps)
    if rules.shared_steps:
        service = np.rint(e["service_share"] * (e["services"] - 1)).astype(np.int64)
        require_range(service, 0, e["services"] - 1, "env.service_share")
        left -= spent[np.arange(len(e)), service]
    expected = np.where(e["done"] == 0, left, e["most_steps"])
    require(e["most_steps"] == expected, "env.most_steps", "is not what the slot has left for the request")
    require_range(e["most_steps"], 0, rules.max_steps, "env.most_steps")


def _check_outcome(world: World) -> None:
    """Flags, codes and counts of the last step; they index the sums of a log line."""
    out, e = world.outcome, world.env
    ranges: dict[int, tuple[int, int | np.ndarray]] = {
        OUTCOME.passed: (0, 1),
        OUTCOME.request_done: (0, 1),
        OUTCOME.accepted: (0, 1),
        OUTCOME.done: (0, e["done"]),
        OUTCOME.reason: (NO_REASON, len(REASON_NAMES) - 1),
        OUTCOME.service: (0, world.tables.services - 1),
        OUTCOME.request_slot: (0, e["horizon"] - 1),
        OUTCOME.request_hops: (0, world.rules.max_steps),
        OUTCOME.slots_closed: (0, e["horizon"]),
        OUTCOME.interrupted: (0, e["num_requests"]),
        OUTCOME.lost_steps: (0, world.rules.max_steps),
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
    vms = ledger.vm_failed[0].size
    failed = np.zeros((len(e), vms + ledger.link_failed.shape[1]), np.bool_)
    for b, (slot, horizon, events) in enumerate(zip(e["slot"], e["horizon"], e["num_events"], strict=True)):
        waiting = np.flatnonzero(arrivals.event_slot[b, :events] > min(slot, horizon - 1))
        past = int(waiting[0]) if len(waiting) else int(events)
        if e["event_cursor"][b] != past:
            refuse(f"env.event_cursor of environment {b}", f"is {e['event_cursor'][b]}, not {past}")
        failed[b, arrivals.event_resource[b, :past]] = ~arrivals.event_up[b, :past]  # the last of several counts
    for name, expected in (("vm_failed", failed[:, :vms]), ("link_failed", failed[:, vms:])):
        flags = getattr(ledger, name)
        require(flags == expected.reshape(flags.shape), f"ledger.{name}", "is not what the failures led to")


def retrace(
    tables: Tables, net: int, profile: int, ingress: int, actions: np.ndarray, switches: bool = False
) -> list[Step] | None:
    """The steps of ``actions`` int [steps] from ``ingress`` (-1: free); None where a walk cannot go like that.

    ``switches``: as of ``Rules``.
    """
    _, nodes, vms, _ = tables.vm_capacity.shape
    at, functions, steps = ingress, 0, []
    for action in actions.tolist():
        node, vm, place = decode_action(action, vms)
        place = place and not (switches and functions == tables.chain_length[profile])
        if not 0 <= action < count_actions(nodes, vms) - 1 or node >= tables.num_nodes[net]:
            return None
        link = -1
        if at < 0 and not place:
            return None
        if node != at and at >= 0:
            around = np.flatnonzero(tables.neighbour[net, at, : tables.degree[net, at]] == node)
            if not len(around):
                return None
            link = int(tables.neighbour_link[net, at, around[0]])
        functions += place
        if functions > tables.chain_length[profile] or (place and vm >= tables.vm_count[net, node]):
            return None
        steps.append(Step(link, node, vm, place))
        at = node
    return steps


def _check_walks(world: World) -> np.ndarray:
    """Walks in progress, step by step from the ingress. Returns what they reserve, int64 [B, N V R + L]."""
    e, walk, tables = world.env, world.walk, world.tables
    taken = np.zeros(_capacity(world).shape, np.int64)
    _, nodes, vms, _ = tables.vm_capacity.shape
    for b in range(len(e)):
        if e["done"][b]:
            if e["entries"][b]:
                refuse(f"env.entries of environment {b}", "is not 0 after the end of the horizon")
            continue
        net, profile, ingress = (int(e[name][b]) for name in ("net", "profile", "ingress"))
        steps = retrace(tables, net, profile, ingress, walk.action[b, : e["steps"][b]], world.rules.switches)
        if steps is None:
            refuse(f"walk.action of environment {b}", "is no walk in this network")
        entries, function = [], 0
        for step in steps:
            if step.link >= 0:
                entries.append((link_resource(step.link, nodes, vms), function))
            if step.places:
                entries.append((vm_resource(step.node, step.vm, vms), function))
                function += 1
        last = steps[-1] if steps else Step(-1, ingress, 0, False)
        hops = sum(step.link >= 0 for step in steps)
        expected = {"node": last.node, "last_vm": last.vm, "function": function, "hops": hops, "entries": len(entries)}
        for name, value in expected.items():
            if e[name][b] != value:
                refuse(f"env.{name} of environment {b}", f"is {e[name][b]}, but its walk leads to {value}")
        for k, (resource, part) in enumerate(entries):
            if walk.resource[b, k] != resource or walk.use[b, k] != use_of(profile, part, tables.load.shape[1]):
                refuse(f"walk.resource of environment {b}", "and walk.use are not what its walk reserves")
        resources, parts = np.array(entries, np.int64).reshape(-1, 2).T
        rows = np.full(len(entries), b)
        _add_uses(tables, taken, rows, resources, np.full(len(entries), profile), parts)
    return taken


def _add_uses(
    tables: Tables, taken: np.ndarray, row: np.ndarray, resource: np.ndarray, profile: np.ndarray, part: np.ndarray
) -> None:
    """Add to ``taken`` int64 [B, N V R + L] what the parts of requests take of resources, int64 [n] each."""
    _, nodes, vms, kinds = tables.vm_capacity.shape
    first_link = count_vms(nodes, vms)
    on_link = resource >= first_link
    amount = tables.rate_units[profile[on_link], part[on_link]]
    np.add.at(taken, (row[on_link], kinds * first_link + resource[on_link] - first_link), amount)
    on_vm = ~on_link
    for kind in range(kinds):
        amount = tables.load_units[profile[on_vm], part[on_vm], kind]
        np.add.at(taken, (row[on_vm], kinds * resource[on_vm] + kind), amount)


def _check_running(world: World) -> np.ndarray:
    """The pools: every place in one chain or free. Returns what running requests reserve, int64 [B, N V R + L]."""
    e, running, arrivals = world.env, world.running, world.arrivals
    records = running.record_next.shape[1]
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
    if arrivals.time.shape[1]:
        row = np.minimum(e["cursor"], arrivals.time.shape[1] - 1)[:, None]
        now = np.where(e["done"] == 0, np.take_along_axis(arrivals.time, row, 1)[:, 0], -np.inf)
        left = np.take_along_axis(arrivals.leaves, request, 1) <= now[:, None]
        require(~left | ~in_use, "running.head", "holds what has left within the slot")
    listed = np.sort(np.where(in_use, request, -1 - np.arange(records)), 1)
    require(np.diff(listed, axis=1) > 0, "running.record_request", "has a request twice")
    require(
        (np.isfinite(running.record_cost) & (running.record_cost >= 0)) | ~in_use,
        "running.record_cost",
        "is negative or no finite number",
    )
    heads = np.concatenate([e["free_entry"][:, None], np.where(in_use, running.record_entry, -1)], 1)
    chain = _trace(running.entry_next, heads, "running.entry_next", "running.record_entry")
    _check_counts(e, "free_entries", None, chain > 0, 2 * world.rules.max_steps)
    return _check_entries(world, request, chain)


def _check_entries(world: World, request: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """What running requests hold is theirs to hold. Returns it, int64 [B, N V R + L].

    ``request`` int [B, records]: the request of each record; ``chain`` int [B, entries]: 0 where a place is free, else
    its record's number plus one.
    """
    reserved = chain > 0
    e, running, tables = world.env, world.running, world.tables
    batch, records = request.shape
    _, nodes, vms, _ = tables.vm_capacity.shape
    first_link = count_vms(nodes, vms)
    resources = first_link + tables.link_capacity.shape[1]
    require(
        ((running.entry_resource >= 0) & (running.entry_resource < resources)) | ~reserved,
        "running.entry_resource",
        "is no resource",
    )
    record = np.clip(chain - 1, 0, records - 1)
    profile = world.arrivals.profile[np.arange(batch)[:, None], np.take_along_axis(request, record, 1)].astype(np.int64)
    resource = np.where(reserved, running.entry_resource, 0)
    own, part = split_use(np.where(reserved, running.entry_use, 0).astype(np.int64), tables.load.shape[1])
    fits = (own == profile) & (part <= tables.chain_length[profile] - (resource < first_link))
    require(fits | ~reserved, "running.entry_use", "is no function or segment of its request")
    capacity = np.concatenate(
        [tables.vm_capacity[e["net"]][..., 0].reshape(batch, -1), tables.link_capacity[e["net"]]], 1
    )
    require(
        (np.take_along_axis(capacity, resource, 1) > 0) | ~reserved, "running.entry_resource", "is not in this network"
    )
    taken = np.zeros(_capacity(world).shape, np.int64)
    row = np.broadcast_to(np.arange(batch)[:, None], reserved.shape)[reserved]
    _add_uses(tables, taken, row, resource[reserved].astype(np.int64), profile[reserved], part[reserved])
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
    """Capacities of VMs and links, int64 [B, N V R + L] in ledger units; 0 where there is none."""
    tables, net = world.tables, world.env["net"]
    return np.concatenate([tables.vm_capacity[net].reshape(len(net), -1), tables.link_capacity[net]], 1)


def _check_capacities(world: World) -> None:
    """A network of the same size is not yet the same network: reserved and offered must make up its capacities."""
    ledger, tables, net = world.ledger, world.tables, world.env["net"]
    for kind, capacity in (("vm", tables.vm_capacity), ("link", tables.link_capacity)):
        reserved, offered, failed = (getattr(ledger, f"{kind}_{name}") for name in ("reserved", "offered", "failed"))
        require((reserved >= 0) & (offered >= 0), f"ledger.{kind}_reserved", f"or {kind}_offered is negative")
        failed = failed if kind == "link" else failed[..., None]
        made_up = np.where(failed, offered == 0, reserved + offered == capacity[net])
        require(made_up, f"ledger.{kind}_offered", "and what is reserved do not make up this network's capacities")


def _check_books(world: World, taken: np.ndarray) -> None:
    """The ledger holds what walks and running requests have ``taken`` int64 [B, N V R + L], no more and no less."""
    e, ledger = world.env, world.ledger
    vms, kinds = ledger.vm_reserved[0].size, ledger.vm_used.shape[1]
    for kind, amounts in (("vm", taken[:, :vms]), ("link", taken[:, vms:])):
        reserved = getattr(ledger, f"{kind}_reserved").reshape(len(e), -1)
        require(reserved == amounts, f"ledger.{kind}_reserved", "is not what walks and running requests hold")
    by_kind = taken[:, :vms].reshape(len(e), -1, kinds).sum(1)
    require(ledger.vm_used == by_kind, "ledger.vm_used", "is not the sum of what is reserved")
    require(e["link_used"] == taken[:, vms:].sum(1), "env.link_used", "is not the sum of what is reserved")


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
    _, nodes, vms, kinds = tables.vm_capacity.shape
    services, functions = tables.services, tables.load.shape[1]
    numbers = (
        e["service_share"],
        e["node"] / max(nodes - 1, 1),
        e["last_vm"] / max(vms - 1, 1),
        e["function"] / functions,
        e["elapsed"] / tables.tolerable_delay[e["profile"]],
    )
    live = e["done"] == 0
    for place, values in enumerate(numbers, start=base):
        # After the horizon's end the last request's are shown, of a step that was not its last.
        there = flat[:, place]
        shown = np.where(live, there == values.astype(np.float32), (there >= -1) & (there < 2))
        require(shown, "seen.flat", "is not what the walk says")
    first = base + len(AT)
    if world.seen.ends:
        for name in ("ingress", "egress"):
            shown = flat[:, first] == (e[name] / max(nodes - 1, 1)).astype(np.float32)
            require(shown | ~live, "seen.flat", "is not what the request says")
            require((flat[:, first] >= -1) & (flat[:, first] <= 1), "seen.flat", "has an end that is no node")
            first += 1
    start = first
    end = flat.shape[1] - (demand_size(functions, kinds) if world.seen.demand else 0)
    ones = np.zeros((batch, end - first), np.float32)
    blocks = {"service": services, "node": nodes, "egress": nodes, "function": functions + 1}
    for name, size in blocks.items():
        hot, at = e[f"hot_{name}"], e[name]
        if world.seen.one_hot:
            inside = (hot >= first) & (hot < first + size)
            expected = np.where(at < 0, -1, first + at)  # what is free, or off the network, is nowhere
            require(np.where(live, hot == expected, inside | (hot == -1)), f"env.hot_{name}", "is not its place")
            rows = np.flatnonzero(inside)
            ones[rows, hot[rows] - start] = 1.0
            first += size
        else:
            require(hot == -1, f"env.hot_{name}", "is set without one-hot features")
    require(flat[:, start:end] == ones, "seen.flat", "has ones elsewhere than at the request's places")
    require((flat[:, end:] >= 0) & (flat[:, end:] <= 1), "seen.flat", "has a demand that is no share")
