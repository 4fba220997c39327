"""What changes while the simulator runs: arrays of B networks, updated in place by the compiled kernels.

Scalars of an environment sit together in one record (``ENV_DTYPE``), so that a step touches one cache line of them;
everything else is grouped by purpose into small named tuples. Nothing here is allocated while stepping, but for the
pools of running requests, which grow by half when they run low (``grow_pools``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import count_actions, count_vms
from nfv_torchrl.columns import columns
from nfv_torchrl.simulator.compiled import records
from nfv_torchrl.simulator.references import by_reference
from nfv_torchrl.simulator.tables import Rules, Tables
from nfv_torchrl.simulator.view import AT, END, demand_size

ENV_DTYPE = np.dtype(
    [
        ("net", "i8"),  # row of the tables
        ("slot", "i8"),  # current slot t
        ("horizon", "i8"),  # T
        ("warmup", "i8"),  # first slot that counts in slot statistics
        ("services", "i8"),  # K of the paper, where these share steps; else 0
        ("cursor", "i8"),  # request being handled
        ("num_requests", "i8"),
        ("profile", "i8"),  # that request, copied here since its arrays are far away in memory
        ("service", "i8"),
        ("ingress", "i8"),  # -1: free
        ("egress", "i8"),
        ("lifetime", "f8"),
        ("service_share", "f8"),
        ("request_slot", "i8"),
        ("event_cursor", "i8"),  # next failure or repair
        ("num_events", "i8"),
        ("node", "i8"),  # the walk: current node (-1: off the network), VM, functions placed, steps, links used
        ("last_vm", "i8"),
        ("function", "i8"),
        ("steps", "i8"),
        ("most_steps", "i8"),  # steps that this walk may take
        ("hops", "i8"),
        ("elapsed", "f8"),  # ms
        ("cost", "f8"),  # $
        ("entries", "i8"),  # reservations of this walk
        ("mask_count", "i8"),  # valid actions
        ("running_cost", "f8"),  # $, sum of phi over running requests
        ("num_running", "i8"),
        ("link_used", "i8"),  # ledger units reserved over all links
        ("free_record", "i8"),  # heads of the free lists, and how many are left
        ("free_records", "i8"),
        ("free_entry", "i8"),
        ("free_entries", "i8"),
        ("log_length", "i8"),  # actions logged
        ("done", "i8"),
        ("hot_service", "i8"),  # one-hot positions now set in the flat observation, -1 for none
        ("hot_node", "i8"),
        ("hot_egress", "i8"),
        ("hot_function", "i8"),
    ]
)


@by_reference
class Ledger(NamedTuple):
    """Books of every resource in ledger units; reserved + offered = capacity unless the resource has failed."""

    vm_reserved: np.ndarray  # int64 [B, N, V, R]
    vm_offered: np.ndarray  # int64 [B, N, V, R], 0 while failed
    vm_used: np.ndarray  # int64 [B, R], reserved over all VMs
    vm_failed: np.ndarray  # bool [B, N, V]
    link_reserved: np.ndarray  # int64 [B, L]
    link_offered: np.ndarray  # int64 [B, L], 0 while failed
    link_failed: np.ndarray  # bool [B, L]


@by_reference
class Arrivals(NamedTuple):
    """Requests in arrival order and failure events in the order applied; rows beyond an env's own count are unused."""

    slot: np.ndarray  # int32 [B, R]
    profile: np.ndarray  # int32 [B, R]
    ingress: np.ndarray  # int16 [B, R]
    egress: np.ndarray  # int16 [B, R]
    departure: np.ndarray  # int32 [B, R]
    lifetime: np.ndarray  # float32 [B, R], s
    service_share: np.ndarray  # float32 [B, R], index among the K services scaled to [0, 1]
    time: np.ndarray  # float64 [B, R], s; [B, 0] while all arrive as their slots begin
    leaves: np.ndarray  # float64 [B, R], s; [B, 0] likewise
    event_slot: np.ndarray  # int32 [B, E]
    event_resource: np.ndarray  # int32 [B, E]
    event_up: np.ndarray  # bool [B, E]


REQUEST = tuple(name for name in Arrivals._fields if name != "slot" and name in (ENV_DTYPE.names or ()))
"""What an environment copies of the request in hand; its ``slot`` is the current one."""


@by_reference
class Running(NamedTuple):
    """Accepted requests that still run: one record each, chained per departure slot, with a chain of reservations."""

    head: np.ndarray  # int32 [B, T + 1], first record departing in a slot (the last: after the horizon), -1 for none
    record_next: np.ndarray  # int32 [B, records]
    record_entry: np.ndarray  # int32 [B, records]
    record_request: np.ndarray  # int32 [B, records]
    record_cost: np.ndarray  # float64 [B, records]
    entry_next: np.ndarray  # int32 [B, entries]
    entry_resource: np.ndarray  # int32 [B, entries], see ``codec``
    entry_use: np.ndarray  # int32 [B, entries], function on a VM or segment on a link, see ``use_of``


POOLS = {"record": ("free_record", "free_records"), "entry": ("free_entry", "free_entries")}
"""Of each pool of ``Running``: the head of an environment's free list, and how many are left there."""


@by_reference
class Walk(NamedTuple):
    """Steps and reservations of the walk in progress."""

    action: np.ndarray  # int32 [B, J]
    resource: np.ndarray  # int32 [B, 2 J]
    use: np.ndarray  # int32 [B, 2 J], function on a VM or segment on a link, see ``use_of``
    spent: np.ndarray  # int32 [B, K], steps taken in this slot by each service where these share them; else unused


@by_reference
class View(NamedTuple):
    """What a controller sees, kept up to date step by step."""

    mask: np.ndarray  # bool [B, A + 1]
    valid: np.ndarray  # int32 [B, A + 1], the valid actions, first ``mask_count`` entries
    flat: np.ndarray  # float32 [B, P]
    ends: bool  # whether ``flat`` goes on with ingress and egress, as numbers
    one_hot: bool  # whether ``flat`` goes on with one-hot service type, node, egress and function index
    demand: bool  # whether ``flat`` ends with what the request asks for: where requests bring profiles of their own


@by_reference
class Log(NamedTuple):
    """Answer to every request, kept only when decisions are recorded (else the arrays have one column)."""

    enabled: bool
    reason: np.ndarray  # int8 [B, R], -1 accepted
    delay: np.ndarray  # float64 [B, R]
    cost: np.ndarray  # float64 [B, R]
    hops: np.ndarray  # int32 [B, R]
    interrupted_at: np.ndarray  # int32 [B, R], -1 if it was not
    start: np.ndarray  # int64 [B, R + 1], where a request's actions begin in ``action``
    action: np.ndarray  # int32 [B, log], of a rejected request with the one that ended it (-1: no action at all)


@by_reference
class World(NamedTuple):
    """Everything a kernel may touch."""

    tables: Tables
    rules: Rules
    env: np.ndarray  # ENV_DTYPE [B]
    mean_lifetime: np.ndarray  # float64 [B], s; 0 where lifetimes are hidden from controllers
    ledger: Ledger
    arrivals: Arrivals
    running: Running
    walk: Walk
    seen: View
    log: Log
    outcome: np.ndarray  # float64 [B, len(OUTCOME)]


class Outcome(NamedTuple):
    """Columns of ``World.outcome``: what the last step of each environment brought."""

    passed: int  # the step passed every check
    step_cost: int  # phi~ of a step that passed, $
    request_done: int
    accepted: int
    reason: int  # Reason code, -1 if accepted or not done
    request_cost: int  # phi of an accepted request, $
    request_delay: int  # ms, of an accepted request
    request_hops: int  # links used by an accepted request
    service: int  # type index of the request that was stepped
    request_slot: int  # its arrival slot
    slots_closed: int  # counted slots (after warm-up) that ended with this step
    slot_cost: int  # sum of Phi_t over them, $
    slot_vm_use: int  # sum over them of the used share of all VM capacity
    slot_link_use: int  # the same for links
    interrupted: int  # running requests lost to failures with this step
    lost_steps: int  # steps that a rejected request had passed
    lost_cost: int  # their cost, $
    done: int  # end of the horizon


OUTCOME = columns(Outcome)


def flat_size(tables: Tables, rules: Rules, one_hot: bool) -> int:
    """P_i of the paper (section VI): N V R + L + 5; what else tells requests apart: ends, one-hot features, demands."""
    _, nodes, vms, kinds = tables.vm_capacity.shape
    _, functions, _ = tables.load.shape
    size = kinds * count_vms(nodes, vms) + tables.link_capacity.shape[1] + len(AT)
    size += tables.services + 2 * nodes + functions + 1 if one_hot else 0
    size += len(END) if shows_ends(rules, one_hot) else 0
    return size + (demand_size(functions, kinds) if shows_demand(tables) else 0)


def shows_ends(rules: Rules, one_hot: bool) -> bool:
    """Whether ingress and egress are numbers of the flat observation: where nothing else in it tells them."""
    return rules.open_pairs and not one_hot


def shows_demand(tables: Tables) -> bool:
    """Whether there are profiles beside the services': then a request's type does not tell what it asks for."""
    return len(tables.service) > tables.services


def new_world(
    tables: Tables, rules: Rules, net: np.ndarray, horizon: int, warmup: int, one_hot: bool, record: bool
) -> World:
    """An idle world of ``len(net)`` environments; environment b lives on row ``net[b]`` of ``tables``."""
    batch = len(net)
    _, nodes, vms, kinds = tables.vm_capacity.shape
    links = tables.link_capacity.shape[1]
    actions = count_actions(nodes, vms)
    env = records(batch, ENV_DTYPE)
    env["net"], env["horizon"], env["warmup"], env["most_steps"] = net, horizon, warmup, rules.max_steps
    return World(
        tables=tables,
        rules=rules,
        env=env,
        mean_lifetime=np.zeros(batch),
        ledger=Ledger(
            vm_reserved=np.zeros((batch, nodes, vms, kinds), np.int64),
            vm_offered=tables.vm_capacity[net].copy(),
            vm_used=np.zeros((batch, kinds), np.int64),
            vm_failed=np.zeros((batch, nodes, vms), np.bool_),
            link_reserved=np.zeros((batch, links), np.int64),
            link_offered=tables.link_capacity[net].copy(),
            link_failed=np.zeros((batch, links), np.bool_),
        ),
        arrivals=new_arrivals(batch, 1, 1),
        running=_new_running(batch, horizon, 256, 2048),
        walk=Walk(
            action=np.zeros((batch, rules.max_steps), np.int32),
            resource=np.zeros((batch, 2 * rules.max_steps), np.int32),
            use=np.zeros((batch, 2 * rules.max_steps), np.int32),
            spent=np.zeros((batch, 1), np.int32),
        ),
        seen=View(
            mask=np.zeros((batch, actions), np.bool_),
            valid=np.zeros((batch, actions), np.int32),
            flat=np.zeros((batch, flat_size(tables, rules, one_hot)), np.float32),
            ends=shows_ends(rules, one_hot),
            one_hot=one_hot,
            demand=shows_demand(tables),
        ),
        log=new_log(batch, 1, record),
        outcome=np.zeros((batch, len(OUTCOME))),
    )


def new_arrivals(batch: int, requests: int, events: int) -> Arrivals:
    """Empty arrays for ``requests`` requests and ``events`` failure events per environment."""
    return Arrivals(
        slot=np.zeros((batch, requests), np.int32),
        profile=np.zeros((batch, requests), np.int32),
        ingress=np.zeros((batch, requests), np.int16),
        egress=np.zeros((batch, requests), np.int16),
        departure=np.zeros((batch, requests), np.int32),
        lifetime=np.zeros((batch, requests), np.float32),
        service_share=np.zeros((batch, requests), np.float32),
        time=np.zeros((batch, 0)),
        leaves=np.zeros((batch, 0)),
        event_slot=np.zeros((batch, events), np.int32),
        event_resource=np.zeros((batch, events), np.int32),
        event_up=np.zeros((batch, events), np.bool_),
    )


def new_log(batch: int, requests: int, enabled: bool) -> Log:
    """An empty decision log."""
    rows = requests if enabled else 1
    return Log(
        enabled=enabled,
        reason=np.full((batch, rows), -1, np.int8),
        delay=np.full((batch, rows), np.nan),
        cost=np.full((batch, rows), np.nan),
        hops=np.zeros((batch, rows), np.int32),
        interrupted_at=np.full((batch, rows), -1, np.int32),
        start=np.zeros((batch, rows + 1), np.int64),
        action=np.zeros((batch, 8 * rows + 256 if enabled else 1), np.int32),
    )


def clear_log(log: Log, b: int) -> None:
    """Forget the answers of environment b."""
    log.reason[b] = -1
    log.delay[b] = np.nan
    log.cost[b] = np.nan
    log.hops[b] = 0
    log.interrupted_at[b] = -1


def _new_running(batch: int, horizon: int, records: int, entries: int) -> Running:
    return Running(
        head=np.full((batch, horizon + 1), -1, np.int32),
        record_next=np.zeros((batch, records), np.int32),
        record_entry=np.zeros((batch, records), np.int32),
        record_request=np.zeros((batch, records), np.int32),
        record_cost=np.zeros((batch, records)),
        entry_next=np.zeros((batch, entries), np.int32),
        entry_resource=np.zeros((batch, entries), np.int32),
        entry_use=np.zeros((batch, entries), np.int32),
    )


def widen(array: np.ndarray, columns: int, fill: int | float | bool = 0) -> np.ndarray:
    """A copy of ``array`` [B, c] with at least ``columns`` columns, new ones filled with ``fill``."""
    if array.shape[1] >= columns:
        return array
    wide = np.full((array.shape[0], columns), fill, array.dtype)
    wide[:, : array.shape[1]] = array
    return wide


def grow_pools(world: World, kinds: Iterable[str] = ("record", "entry")) -> World:
    """The same world with room for half as many more running requests (``record``) and reservations (``entry``).

    At least for those of one walk. New places are chained in front of each environment's free lists.
    """
    running, env = world.running, world.env
    for kind in kinds:
        free, count = POOLS[kind]
        have = getattr(running, f"{kind}_next").shape[1]
        room = have + max(have // 2, 2 * world.rules.max_steps)
        running = running._replace(
            **{name: widen(array, room) for name, array in running._asdict().items() if name.startswith(kind)}
        )
        _chain(getattr(running, f"{kind}_next"), have, env[free])
        env[free] = have
        env[count] += room - have
    return world._replace(running=running)


def _chain(following: np.ndarray, first: int, tail: np.ndarray) -> None:
    """Link places first, first + 1, ... of each row, the last one to ``tail`` [B]."""
    last = following.shape[1] - 1
    following[:, first:last] = np.arange(first + 1, last + 1)
    following[:, last] = tail
