"""Small random networks, partly used, on which the cheapest walk is not the obvious one."""

from __future__ import annotations

import heapq
import itertools

import numpy as np

from nfv_torchrl.planners.layered_graph import Request
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE, Rules, Tables, build_tables

VNFS = {"NAT": 0.092, "FW": 0.09, "TM": 1.33, "VOC": 0.54, "IDPS": 1.07}


def tight_instance(seed: int, nodes: int, max_vms: int = 3, chain: int = 5):
    """Tables, int64 [N, V] and int64 [L] on offer, and a request whose delay and resources are scarce.

    VMs offer room for one or two functions each and links for one or two crossings, so that a walk's own use counts.
    """
    rng = np.random.default_rng(seed)
    substrate = draw_random_substrate(nodes, seed, mean_degree=float(rng.uniform(2.0, 4.0)), vms=(1, max_vms))
    names = rng.choice(list(VNFS), size=chain)
    slack = float(rng.uniform(0.5, 1.6))
    service = ServiceType("tight", tuple(str(name) for name in names), 4.0, 100.0 * slack)
    tables = build_tables([substrate], ServiceCatalogue((service,), VNFS))
    loads = tables.load_units[0]
    vm_offered = np.where(tables.vm_capacity[0] > 0, rng.integers(0, 2 * loads.max(), tables.vm_capacity[0].shape), 0)
    link_offered = rng.integers(0, 4, tables.num_links[0]) * tables.rate_units[0]
    ends = rng.choice(nodes, 2, replace=False)
    return tables, vm_offered, link_offered, Request(0, int(ends[0]), int(ends[1]))


def cheapest_walk(tables: Tables, rules: Rules, vm_offered, link_offered, request: Request) -> float | None:
    """Cost of the cheapest feasible walk, or None: best-first search over whole walks, exponential, for tiny cases."""
    service, ingress, egress = request
    chain = int(tables.chain_length[service])
    rate, load = tables.rate[service], tables.load[service]
    exists = [(n, v) for n in range(tables.num_nodes[0]) for v in range(tables.vm_count[0, n])]
    to_go = [0.0] * (chain + 1)  # at least this much for the functions left
    for i in range(chain - 1, -1, -1):
        to_go[i] = to_go[i + 1] + load[i] * min(tables.vm_unit_cost[0, n, v] for n, v in exists)
    number = itertools.count()
    queue = [(0.0, next(number), 0.0, ingress, 0, 0.0, (), ())]
    while queue:
        _, _, cost, node, placed, delay, vms_used, links_used = heapq.heappop(queue)
        if node == egress and placed == chain:
            return cost
        moves = [(node, -1)] if node == egress or rules.colocation else []
        if node != egress:
            degree = tables.degree[0, node]
            moves += list(zip(tables.neighbour[0, node, :degree], tables.neighbour_link[0, node, :degree], strict=True))
        for there, link in moves:
            hop_cost, hop_delay, links = cost, delay, links_used
            if link >= 0:
                hop_cost += tables.link_unit_cost[0, link] * rate
                hop_delay += tables.hop_delay[0, service, link]
                links = (*links_used, int(link))
                if links.count(int(link)) * tables.rate_units[service] > link_offered[link]:
                    continue
            choices = [-1] if link >= 0 else []
            choices += list(range(tables.vm_count[0, there])) if placed < chain else []
            for vm in choices:
                new_cost, new_delay, vms, new_placed = hop_cost, hop_delay, vms_used, placed
                if vm >= 0:
                    vms = (*vms_used, (int(there), vm, placed))
                    new_placed += 1
                    used = sum(tables.load_units[service, f] for n, v, f in vms if (n, v) == (there, vm))
                    if used > vm_offered[there, vm]:
                        continue
                    new_cost += tables.vm_unit_cost[0, there, vm] * load[placed]
                    new_delay += 1000.0 * load[placed] / tables.vm_speed[0, there, vm]
                if new_delay + tables.delay_to[0, service, there, egress] > (
                    tables.tolerable_delay[service] + DELAY_TOLERANCE
                ):
                    continue
                bound = new_cost + to_go[new_placed] + tables.link_cost_to[0, there, egress] * rate
                heapq.heappush(
                    queue, (bound, next(number), new_cost, int(there), new_placed, new_delay, vms, links)
                )
    return None
