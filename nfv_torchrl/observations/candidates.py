"""One row of features for each valid action, so that a network with shared weights scores any size of substrate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torchrl.data import Binary, Categorical, Composite, Unbounded

from nfv_torchrl.codec import count_actions, count_vms, decode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.observations.base import gather
from nfv_torchrl.observations.costs_to_go import DEAD_END, cost_to_go, costs_to_go
from nfv_torchrl.scenario.units import LEDGER_UNITS
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.mask import PASSES, check_step
from nfv_torchrl.simulator.slots import used_vm_share
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.steps import (
    Step,
    counts_as_switch,
    find_link,
    hop_delay,
    place_delay,
    step_cost,
)
from nfv_torchrl.simulator.tables import Rules, Tables


class CandidateFeatures(NamedTuple):
    """Columns of the candidate rows. ``RequestFeatures`` may follow, then one column per service type (one-hot)."""

    reject: int  # 1 for the row of the reject action
    place: int  # places the next function (else only forwards)
    stay: int  # uses no link
    arrives: int  # the step ends at the egress
    passes: int  # passes every step check
    step_cost: int  # phi~ over the service's reference cost
    cost_to_go: int  # least cost to finish after the step on the empty network, over the same; 10 where nothing does
    vm_use: int  # used share of the VM after the step, of several kinds of resources the largest; 1 without a VM
    vm_demand: int  # load of the function over the VM's capacity, likewise
    node_use: int  # used share of all VMs of the node after the step, likewise
    link_use: int  # used share of the link after the step
    link_demand: int  # rate over the link's capacity
    elapsed: int  # delay after the step over the tolerable delay
    delay_to_go: int  # shortest delay from there to the egress over the tolerable delay
    slack: int  # what is left then: 1 - elapsed - delay_to_go
    functions_left: int  # share of the chain not placed after the step
    load_left: int  # share of the chain's load not placed after the step, of several kinds the mean
    network_vm_use: int  # used share of all VM capacity now, of several kinds the mean
    network_link_use: int  # used share of all link capacity now


class RequestFeatures(NamedTuple):
    """Columns on the request itself, the same in all its rows, where the service type does not tell all of it: where
    lifetimes are seen, or requests bring demands of their own."""

    lifetime: int  # log of 1 + the lifetime over its mean, which is taken for it where lifetimes are hidden
    load: int  # log of the chain's load over its mean over profiles, halved; of several kinds of resources the largest
    share: int  # the chain's load over what is not used of all VMs, at most 1, likewise
    rate: int  # log of the highest rate over its mean over profiles, halved
    length: int  # functions of the chain over those of the longest


AT = columns(CandidateFeatures)
FEATURES = CandidateFeatures._fields
REQUEST = RequestFeatures(*(len(FEATURES) + number for number in range(len(RequestFeatures._fields))))


@part
def write_row(world, b, costs, action, row):
    """Features of one valid action into ``row`` [features], which holds zeros.

    Whether the columns of ``RequestFeatures`` are among them is told by the length of ``row``.
    """
    e = world.env[b]
    if action == world.seen.mask.shape[1] - 1:
        row[AT.reject] = 1.0
    else:
        _write_step(world, b, costs, action, row)
    row[AT.network_vm_use] = used_vm_share(world, b)
    row[AT.network_link_use] = e.link_used / world.tables.link_total[e.net]
    if e.done == 0:
        services = world.tables.services
        row[row.size - services + e.service] = 1.0
        if row.size > len(FEATURES) + services:
            _write_request(world, b, costs, row)


@part
def _write_request(world, b, costs, row):
    """The columns of ``RequestFeatures``."""
    tables, e = world.tables, world.env[b]
    mean = world.mean_lifetime[b]
    row[REQUEST.lifetime] = np.log(1.0 + (e.lifetime / mean if mean > 0.0 else 1.0))
    row[REQUEST.load] = costs.asked[e.profile, 0]
    row[REQUEST.rate] = costs.asked[e.profile, 1]
    row[REQUEST.length] = costs.asked[e.profile, 2]
    share = 0.0
    for kind in range(tables.load.shape[2]):
        asked = np.int64(0)
        for f in range(tables.chain_length[e.profile]):
            asked += tables.load_units[e.profile, f, kind]
        free = tables.vm_total[e.net, kind] - world.ledger.vm_used[b, kind]
        share = max(share, asked / max(free, asked, 1))
    row[REQUEST.share] = share


@part
def _write_step(world, b, costs, action, row):
    """Features of one valid action other than reject."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    vms = ledger.vm_offered.shape[2]
    net, profile = e.net, e.profile
    node, vm, place = decode_action(action, vms)
    place = place and not counts_as_switch(tables, world.rules, e)
    link = np.int64(-1) if node == e.node or e.node < 0 else find_link(tables, net, e.node, node)
    step = Step(link, node, vm, place)
    elapsed = e.elapsed
    done = e.function
    row[AT.place] = place
    row[AT.stay] = link < 0
    row[AT.passes] = check_step(world, b, step) == PASSES
    if place:
        elapsed += place_delay(tables, e, node, vm)
        done += 1
    row[AT.arrives] = node == e.egress or (e.egress < 0 and done == tables.chain_length[profile])
    if link >= 0:
        elapsed += hop_delay(tables, net, profile, e.function, link)
        capacity = tables.link_capacity[net, link]
        rate = tables.rate_units[profile, e.function]
        row[AT.link_use] = (capacity - ledger.link_offered[b, link] + rate) / capacity
        row[AT.link_demand] = rate / capacity
    _write_vm(world, b, step, row)
    reference = costs.reference[net, profile]
    row[AT.step_cost] = step_cost(tables, e, step) / reference
    to_go = cost_to_go(world, b, costs, done, node)
    row[AT.cost_to_go] = to_go / reference if to_go < np.inf else DEAD_END
    tolerable = tables.tolerable_delay[profile]
    row[AT.elapsed] = elapsed / tolerable
    if e.egress >= 0 and tolerable < np.inf:
        row[AT.delay_to_go] = tables.delay_to[net, tables.least_rate[profile], node, e.egress] / tolerable
    row[AT.slack] = 1.0 - row[AT.elapsed] - row[AT.delay_to_go]
    _write_chain(tables, profile, done, row)


@part
def _write_vm(world, b, step, row):
    """Use and demand of the VM that a step names, and use of its node."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    net, node, vm = e.net, step.node, step.vm
    if vm >= tables.vm_count[net, node]:
        row[AT.vm_use] = 1.0
        row[AT.node_use] = 1.0
        return
    use, demand, node_use = 0.0, 0.0, 0.0
    for kind in range(tables.load.shape[2]):
        taken = tables.load_units[e.profile, e.function, kind] if step.places else np.int64(0)
        capacity = tables.vm_capacity[net, node, vm, kind]
        use = max(use, (capacity - ledger.vm_offered[b, node, vm, kind] + taken) / capacity)
        if step.places:
            size = tables.vm_speed[net, node, vm] if kind == 0 else capacity / LEDGER_UNITS
            demand = max(demand, tables.load[e.profile, e.function, kind] / size)
        free, total = -taken, np.int64(0)
        for v in range(tables.vm_count[net, node]):
            free += ledger.vm_offered[b, node, v, kind]
            total += tables.vm_capacity[net, node, v, kind]
        node_use = max(node_use, 1.0 - free / total)
    row[AT.vm_use] = use
    row[AT.vm_demand] = demand
    row[AT.node_use] = node_use


@part
def _write_chain(tables, profile, done, row):
    """What is left of the chain once ``done`` functions are placed."""
    chain = tables.chain_length[profile]
    row[AT.functions_left] = (chain - done) / max(chain, 1)
    shares, kinds = 0.0, 0
    for kind in range(tables.load.shape[2]):
        left, whole = 0.0, 0.0
        for f in range(chain):
            whole += tables.load[profile, f, kind]
            if f >= done:
                left += tables.load[profile, f, kind]
        if whole > 0.0:
            shares += left / whole
            kinds += 1
    row[AT.load_left] = shares / max(kinds, 1)


@kernel
def write_candidates(world, costs, rows, actions, mask):
    """Fill ``rows`` float32 [B, C, features], ``actions`` int64 [B, C] and ``mask`` bool [B, C] from the world."""
    reject = world.seen.mask.shape[1] - 1
    for b in range(rows.shape[0]):
        e = world.env[b]
        for k in range(rows.shape[1]):
            actions[b, k] = reject
            mask[b, k] = False
            for column in range(rows.shape[2]):
                rows[b, k, column] = 0.0
        for k in range(e.mask_count):
            action = np.int64(world.seen.valid[b, k])
            actions[b, k] = action
            mask[b, k] = True
            write_row(world, b, costs, action, rows[b, k])


def candidate_rows(tables: Tables, rules: Rules) -> int:
    """Rows C on the networks of ``tables``."""
    _, nodes, vms, _ = tables.vm_capacity.shape
    rows = count_actions(tables.neighbour.shape[2] + 1, vms)
    anywhere = count_vms(nodes, vms) + 1 if rules.free_ends else 0  # a free ingress: any VM, or reject
    return max(rows, anywhere)


def count_features(services: int, *, request: bool) -> int:
    """Columns of a row, with those of ``RequestFeatures`` or without."""
    return len(FEATURES) + (len(REQUEST) if request else 0) + services


def describes_requests(world: World) -> bool:
    """Whether rows have the columns of ``RequestFeatures``: lifetimes are seen, or requests bring their demands."""
    return bool(world.seen.demand or world.mean_lifetime.any())


class CandidateObservation:
    """Key ``candidates``, nested: one row for each valid action, in no particular order, then padding.

    C = 2 V (D + 1) + 1 rows, D the largest degree; with free ends N V + 1 if that is more. ``features`` float32
    [B, C, F + K] (columns: the F of ``CandidateFeatures``, and of ``RequestFeatures`` where there are, then the service
    type one-hot; costs and delays are relative to the service's own, so that one network serves all), ``action`` int64
    [B, C]: the action a row stands for (``reject`` in padding), ``mask`` bool [B, C]: rows in use.

    Args:
        request: whether rows have the columns of ``RequestFeatures``; None: where lifetimes are seen or requests bring
            demands of their own.
    """

    def __init__(self, *, request: bool | None = None) -> None:
        self.request = request
        self._simulator: Simulator | None = None

    def _prepare(self, simulator: Simulator) -> None:
        if self._simulator is simulator:
            return
        self._simulator = simulator
        self._costs = costs_to_go(simulator.tables, simulator.world.rules)

    def shape(self, simulator: Simulator) -> tuple[int, int]:
        """Rows C and features."""
        request = describes_requests(simulator.world) if self.request is None else self.request
        rows = candidate_rows(simulator.tables, simulator.world.rules)
        return rows, count_features(simulator.tables.services, request=request)

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        batch = torch.Size([simulator.batch_size])
        rows, features = self.shape(simulator)
        return {
            "candidates": Composite(
                features=Unbounded((*batch, rows, features), dtype=torch.float32),
                action=Categorical(simulator.num_actions, shape=(*batch, rows), dtype=torch.int64),
                mask=Binary(rows, shape=(*batch, rows), dtype=torch.bool),
                shape=batch,
            )
        }

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        self._prepare(simulator)
        batch = simulator.batch_size
        rows, features = self.shape(simulator)
        values = torch.empty(batch, rows, features)
        actions = torch.empty(batch, rows, dtype=torch.int64)
        mask = torch.empty(batch, rows, dtype=torch.bool)
        write_candidates(simulator.world, self._costs, values.numpy(), actions.numpy(), mask.numpy())
        return {"candidates": gather({"features": values, "action": actions, "mask": mask}, batch)}
