"""One row of features for each valid action, so that a network with shared weights scores any size of substrate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torchrl.data import Binary, Categorical, Composite, Unbounded

from nfv_torchrl.codec import count_actions, decode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.observations.base import gather
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.mask import PASSES, check_step
from nfv_torchrl.simulator.steps import Step, find_link, link_cost, step_cost, vm_cost, vm_delay
from nfv_torchrl.simulator.tables import Rules, Tables


class CandidateFeatures(NamedTuple):
    """Columns of the candidate rows; one column per service type (one-hot) follows."""

    reject: int  # 1 for the row of the reject action
    place: int  # places the next function (else only forwards)
    stay: int  # uses no link
    arrives: int  # the step ends at the egress
    passes: int  # passes every step check
    step_cost: int  # phi~ over the service's reference cost
    cost_to_go: int  # least cost to finish after the step on the empty network, over the same
    vm_use: int  # used share of the VM after the step
    vm_demand: int  # load of the function over the VM's capacity
    node_use: int  # used share of all VMs of the node after the step
    link_use: int  # used share of the link after the step
    link_demand: int  # rate over the link's capacity
    elapsed: int  # delay after the step over the tolerable delay
    delay_to_go: int  # shortest delay from there to the egress over the tolerable delay
    slack: int  # what is left then: 1 - elapsed - delay_to_go
    functions_left: int  # share of the chain not placed after the step
    load_left: int  # share of the chain's load not placed after the step
    network_vm_use: int  # used share of all VM capacity now
    network_link_use: int  # used share of all link capacity now


AT = columns(CandidateFeatures)
FEATURES = CandidateFeatures._fields


@kernel
def _finish_costs(tables, net, colocation, service, costs):
    """Fill ``costs`` [F + 1, N, N], infinite before: least costs by functions placed, current node, egress."""
    nodes = tables.num_nodes[net]
    functions = tables.chain_length[service]
    rate = tables.rate[service]
    for i in range(functions, -1, -1):
        for egress in range(nodes):
            _finish_costs_from(tables, net, colocation, rate, service, i, functions, egress, costs)


@part
def _finish_costs_from(tables, net, colocation, rate, service, i, functions, egress, costs):
    """One layer of ``_finish_costs`` by Bellman-Ford: all nodes with i functions placed, towards one egress."""
    nodes = tables.num_nodes[net]
    load = tables.load[service, min(i, functions - 1)] if i < functions else 0.0
    for node in range(nodes):
        if i == functions:
            costs[i, node, egress] = link_cost(tables.link_cost_to[net, node, egress], rate)
        elif node == egress or colocation:
            costs[i, node, egress] = vm_cost(_cheapest_vm(tables, net, node), load) + costs[i + 1, node, egress]
    changed = i < functions
    while changed:
        changed = False
        for node in range(nodes):
            if node == egress:
                continue
            best = costs[i, node, egress]
            for k in range(tables.degree[net, node]):
                near = tables.neighbour[net, node, k]
                onward = min(
                    costs[i, near, egress],
                    vm_cost(_cheapest_vm(tables, net, near), load) + costs[i + 1, near, egress],
                )
                hop = link_cost(tables.link_unit_cost[net, tables.neighbour_link[net, node, k]], rate)
                best = min(best, hop + onward)
            if best < costs[i, node, egress]:
                costs[i, node, egress] = best
                changed = True


@part
def _cheapest_vm(tables, net, node):
    cheapest = np.inf
    for vm in range(tables.vm_count[net, node]):
        cheapest = min(cheapest, tables.vm_unit_cost[net, node, vm])
    return cheapest


def finish_costs(tables: Tables, rules: Rules) -> np.ndarray:
    """Least cost ($) to finish a request on the empty network, float64 [S, K, F + 1, N, N].

    Index: substrate, service, functions placed, current node, egress. Infinite for nodes a substrate does not have.
    """
    substrates, nodes = tables.degree.shape
    services, functions = tables.load.shape
    costs = np.full((substrates, services, functions + 1, nodes, nodes), np.inf)
    for net in range(substrates):
        for service in range(services):
            _finish_costs(tables, net, rules.colocation, service, costs[net, service])
    return costs


def reference_costs(tables: Tables, costs: np.ndarray) -> np.ndarray:
    """Mean over all pairs of nodes of the least cost of a request on the empty network, $, float64 [S, K]."""
    references = np.zeros(costs.shape[:2])
    for net, nodes in enumerate(tables.num_nodes):
        apart = ~np.eye(nodes, dtype=bool)
        references[net] = costs[net, :, 0, :nodes, :nodes][:, apart].mean(axis=1)
    return references


@part
def write_row(world, b, costs, references, action, row):
    """Features of one valid action into ``row`` [features], which holds zeros."""
    e = world.env[b]
    if action == world.seen.mask.shape[1] - 1:
        row[AT.reject] = 1.0
    else:
        _write_step(world, b, costs, references, action, row)
    row[AT.network_vm_use] = e.vm_used / world.tables.vm_total[e.net]
    row[AT.network_link_use] = e.link_used / world.tables.link_total[e.net]
    if e.done == 0:
        row[row.size - world.tables.load.shape[0] + e.service] = 1.0


@part
def _write_step(world, b, costs, references, action, row):
    """Features of one valid action other than reject."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    vms = ledger.vm_offered.shape[2]
    net, service, egress = e.net, e.service, e.egress
    node, vm, place = decode_action(action, vms)
    link = np.int64(-1) if node == e.node else find_link(tables, net, e.node, node)
    step = Step(link, node, vm, place)
    tolerable = tables.tolerable_delay[service]
    elapsed = e.elapsed
    done = e.function
    vm_taken = np.int64(0)
    row[AT.place] = place
    row[AT.stay] = link < 0
    row[AT.arrives] = node == egress
    row[AT.passes] = check_step(world, b, step) == PASSES
    if place:
        load = tables.load[service, e.function]
        vm_taken = tables.load_units[service, e.function]
        elapsed += vm_delay(load, tables.vm_speed[net, node, vm])
        row[AT.vm_demand] = load / tables.vm_speed[net, node, vm]
        done += 1
    if link >= 0:
        elapsed += tables.hop_delay[net, service, link]
        capacity = tables.link_capacity[net, link]
        row[AT.link_use] = (capacity - ledger.link_offered[b, link] + tables.rate_units[service]) / capacity
        row[AT.link_demand] = tables.rate_units[service] / capacity
    capacity = tables.vm_capacity[net, node, vm]
    row[AT.vm_use] = (capacity - ledger.vm_offered[b, node, vm] + vm_taken) / capacity
    free, total = -vm_taken, np.int64(0)
    for v in range(tables.vm_count[net, node]):
        free += ledger.vm_offered[b, node, v]
        total += tables.vm_capacity[net, node, v]
    row[AT.node_use] = 1.0 - free / total
    row[AT.step_cost] = step_cost(tables, e, step) / references[net, service]
    row[AT.cost_to_go] = costs[net, service, done, node, egress] / references[net, service]
    row[AT.elapsed] = elapsed / tolerable
    row[AT.delay_to_go] = tables.delay_to[net, service, node, egress] / tolerable
    row[AT.slack] = 1.0 - row[AT.elapsed] - row[AT.delay_to_go]
    chain = tables.chain_length[service]
    row[AT.functions_left] = (chain - done) / chain
    left, whole = 0.0, 0.0
    for f in range(chain):
        whole += tables.load[service, f]
        if f >= done:
            left += tables.load[service, f]
    row[AT.load_left] = left / whole


@kernel
def write_candidates(world, costs, references, rows, actions, mask):
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
            write_row(world, b, costs, references, action, rows[b, k])


def candidate_shape(tables: Tables) -> tuple[int, int]:
    """Rows C and features on the networks of ``tables``."""
    vms, degrees = tables.vm_capacity.shape[2], tables.neighbour.shape[2]
    return count_actions(degrees + 1, vms), len(FEATURES) + tables.load.shape[0]


class CandidateObservation:
    """Key ``candidates``, nested: one row for each valid action, in no particular order, then padding.

    C = 2 V (D + 1) + 1 rows, D the largest degree. ``features`` float32 [B, C, F + K] (columns: the F of
    ``CandidateFeatures``, then the service type one-hot; costs and delays are relative to the service's own, so that
    one network serves all), ``action`` int64 [B, C]: the action a row stands for (``reject`` in padding), ``mask`` bool
    [B, C]: rows in use.
    """

    def __init__(self) -> None:
        self._simulator: Simulator | None = None

    def _prepare(self, simulator: Simulator) -> None:
        if self._simulator is simulator:
            return
        self._simulator = simulator
        tables = simulator.tables
        self._costs = finish_costs(tables, simulator.world.rules)
        self._references = reference_costs(tables, self._costs)

    @staticmethod
    def shape(simulator: Simulator) -> tuple[int, int]:
        """Rows C and features."""
        return candidate_shape(simulator.tables)

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
        write_candidates(simulator.world, self._costs, self._references, values.numpy(), actions.numpy(), mask.numpy())
        return {"candidates": gather({"features": values, "action": actions, "mask": mask}, batch)}
