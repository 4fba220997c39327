"""Least costs to finish requests on the empty network: what costs in rows of candidates are measured by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.steps import link_cost, vm_cost
from nfv_torchrl.simulator.tables import Rules, Tables

LEAST_RATIO = 1e-9
"""Of a load or rate to the mean, for requests that take next to nothing."""


class CostsToGo(NamedTuple):
    """Least costs ($) to finish requests on the empty network, float64 [F + 1, N] by functions placed and node.

    Those of services between all nodes are worked out at once, others when they are first asked for.
    """

    of_service: np.ndarray  # float64 [S, K, N, F + 1, N], the third index is the egress
    reference: np.ndarray  # float64 [S, P], $: what the costs of a profile's requests are measured by
    asked: np.ndarray  # float64 [P, 3]: load and rate of a profile's requests, as RequestFeatures; length
    row: np.ndarray  # int32 [S, P, N + 1], row of ``other`` by egress (N: free), -1: not there
    other: np.ndarray  # float64 [C, F + 1, N]
    used: np.ndarray  # int64 [1], rows of it


DEAD_END = 10.0
"""Cost to go where a request cannot be finished at all, over its reference."""
MOST_OTHER = 2**23
"""Numbers that ``CostsToGo.other`` may have; when it is full it is filled anew."""


@kernel
def _finish_costs(tables, rules, net, profile, egress, costs):
    """Fill ``costs`` [F + 1, N] with least costs by functions placed and current node; ``egress`` -1 is free."""
    costs[:] = np.inf
    for i in range(tables.chain_length[profile], -1, -1):
        _finish_costs_from(tables, rules, (net, profile, egress), i, costs)


@part
def _finish_costs_from(tables, rules, request, i, costs):
    """One layer of ``_finish_costs`` by Bellman-Ford: all nodes with i functions placed."""
    net, profile, egress = request
    nodes = tables.num_nodes[net]
    functions = tables.chain_length[profile]
    rate = tables.rate[profile, i]
    for node in range(nodes):
        if i == functions:
            costs[i, node] = 0.0 if egress < 0 else link_cost(tables.link_cost_to[net, node, egress], rate)
        elif rules.colocation or (i == 0 if rules.distinct else node == egress):
            costs[i, node] = _cheapest_place(tables, net, node, profile, i) + costs[i + 1, node]
    changed = i < functions
    while changed:
        changed = False
        for node in range(nodes):
            if node == egress and not rules.distinct:
                continue
            best = costs[i, node]
            for k in range(tables.degree[net, node]):
                near = tables.neighbour[net, node, k]
                onward = min(costs[i, near], _cheapest_place(tables, net, near, profile, i) + costs[i + 1, near])
                hop = link_cost(tables.link_unit_cost[net, tables.neighbour_link[net, node, k]], rate)
                best = min(best, hop + onward)
            if best < costs[i, node]:
                costs[i, node] = best
                changed = True


@part
def _cheapest_place(tables, net, node, profile, function):
    """$ of a function on the cheapest VM of a node, however large."""
    cheapest = np.inf
    for vm in range(tables.vm_count[net, node]):
        cost = 0.0
        for kind in range(tables.load.shape[2]):
            cost += vm_cost(tables.vm_unit_cost[net, node, vm, kind], tables.load[profile, function, kind])
        cheapest = min(cheapest, cost)
    return cheapest


def finish_costs(tables: Tables, rules: Rules) -> np.ndarray:
    """Least cost ($) to finish a service's request on the empty network, float64 [S, K, F + 1, N, N].

    Index: substrate, service, functions placed, current node, egress. Infinite for nodes a substrate does not have.
    """
    return np.moveaxis(_service_costs(tables, rules), 2, 4)


def _service_costs(tables: Tables, rules: Rules) -> np.ndarray:
    substrates, nodes = tables.degree.shape
    costs = np.full((substrates, tables.services, nodes, tables.load.shape[1] + 1, nodes), np.inf)
    for net in range(substrates):
        for service in range(tables.services):
            for egress in range(tables.num_nodes[net]):
                _finish_costs(tables, rules, net, service, egress, costs[net, service, egress])
    return costs


def reference_costs(tables: Tables, costs: np.ndarray) -> np.ndarray:
    """Mean over all pairs of nodes of the least cost of a service's request on the empty network, $, float64 [S, K]."""
    references = np.zeros(costs.shape[:2])
    for net, nodes in enumerate(tables.num_nodes):
        apart = ~np.eye(nodes, dtype=bool)
        found = costs[net, :, 0, :nodes, :nodes][:, apart]
        references[net] = np.where(
            np.isfinite(found).all(axis=1), found.mean(axis=1), _usual_costs(tables, net)[: len(found)]
        )
    return references


def _usual_costs(tables: Tables, net: int) -> np.ndarray:
    """Cost of each profile at mean unit costs, its mean rate on a path of mean cost; float64 [P], $, above 0."""
    nodes, exists = tables.num_nodes[net], tables.vm_capacity[net] > 0
    unit_cost = np.where(exists, tables.vm_unit_cost[net], 0).sum(axis=(0, 1)) / np.maximum(exists.sum(axis=(0, 1)), 1)
    path = tables.link_cost_to[net, :nodes, :nodes].sum() / max(nodes * (nodes - 1), 1)
    rate = tables.rate.sum(axis=1) / (tables.chain_length + 1)
    return np.maximum(tables.load.sum(axis=1) @ unit_cost + path * rate, 1e-9)


def costs_to_go(tables: Tables, rules: Rules) -> CostsToGo:
    """Costs that the rows of candidates are measured by."""
    of_service = _service_costs(tables, rules)
    substrates, nodes = tables.degree.shape
    profiles, layers = len(tables.service), tables.load.shape[1] + 1
    reference = np.stack([_usual_costs(tables, net) for net in range(substrates)])
    reference[:, : tables.services] = reference_costs(tables, np.moveaxis(of_service, 2, 4))
    beside = profiles > tables.services or rules.free_ends
    rows = max(min(substrates * profiles * (nodes + 1), MOST_OTHER // (layers * nodes)), 1) if beside else 1
    shape = (substrates, profiles, nodes + 1) if beside else (1, 1, 1)
    return CostsToGo(
        of_service=of_service,
        reference=reference,
        asked=_asked(tables),
        row=np.full(shape, -1, np.int32),
        other=np.zeros((rows, layers, nodes)),
        used=np.zeros(1, np.int64),
    )


def _asked(tables: Tables) -> np.ndarray:
    """The columns of ``RequestFeatures`` that a profile tells alone, float64 [P, 3]: load, rate and length."""
    chain, rate = tables.load.sum(axis=1), tables.rate.max(axis=1)
    loads = (chain / np.maximum(chain.mean(axis=0), LEAST_RATIO)).max(axis=1)
    rates = rate / max(rate.mean(), LEAST_RATIO)
    logs = [0.5 * np.log(np.maximum(each, LEAST_RATIO)) for each in (loads, rates)]
    return np.stack([*logs, tables.chain_length / max(tables.chain_length.max(), 1)], axis=1)


@part
def cost_to_go(world, b, costs, functions, node):
    """Least cost ($) to finish the request in hand from ``node`` with ``functions`` placed, on the empty network."""
    tables, e = world.tables, world.env[b]
    net, profile, egress = e.net, e.profile, e.egress
    if profile < tables.services and egress >= 0:
        return costs.of_service[net, profile, egress, functions, node]
    nodes = tables.degree.shape[1]
    place = egress if egress >= 0 else np.int64(nodes)
    row = costs.row[net, profile, place]
    if row < 0:
        if costs.used[0] == costs.other.shape[0]:
            costs.row[:] = -1
            costs.used[0] = 0
        row = costs.used[0]
        costs.used[0] += 1
        costs.row[net, profile, place] = row
        _finish_costs(tables, world.rules, net, profile, egress, costs.other[row])
    return costs.other[row, functions, node]
