"""Small random networks, partly used, of up to 8 nodes, too big to try every walk on."""

from __future__ import annotations

import numpy as np
from exhaustive import Case

from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.services import PAPER_VNFS, ServiceCatalogue, ServiceType
from nfv_torchrl.simulator.tables import Rules, build_tables


def tight_instance(seed: int, colocation: bool) -> Case:
    """4 to 8 nodes in the paper's ranges, five functions; the delay budget is scarce.

    VMs offer room for one or two functions each and links for 0 to 3 crossings, so that a walk's own use counts.
    """
    rng = np.random.default_rng(seed)
    nodes = 4 + seed % 5
    substrate = draw_random_substrate(nodes, seed, mean_degree=float(rng.uniform(2.0, 4.0)), vms=(1, 3))
    chain = tuple(rng.choice(list(PAPER_VNFS), size=5).tolist())
    service = ServiceType("tight", chain, 4.0, float(rng.uniform(60.0, 160.0)))
    tables = build_tables([substrate], ServiceCatalogue((service,)))
    exists = tables.vm_capacity[0, :, :, 0] > 0
    vm_offered = np.where(exists, rng.integers(0, 2 * tables.load_units[0, :, 0].max(), exists.shape), 0)
    link_offered = rng.integers(0, 4, substrate.num_links) * tables.rate_units[0, 0]
    ingress, egress = rng.choice(nodes, 2, replace=False).tolist()
    return Case(tables, Rules(colocation, False, False, 100), vm_offered, link_offered, 0, ingress, egress)
