"""One request of the general model on a small, partly used network: any kinds, ends, rates, placement rule, duplex.

``python tests/planners/general_cases.py 300`` holds the exact search against the integer programme on 300 of them.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np

from nfv_torchrl.planners.base import Planner
from nfv_torchrl.planners.milp import embed_request
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator

VNFS = ("S", "M", "L")


def general_case(seed: int) -> Simulator:
    """A simulator at its only request. VMs have room for one or two functions, links for few crossings."""
    rng = np.random.default_rng(seed)
    kinds = int(rng.integers(1, 4))
    nodes = int(rng.integers(4, 8))
    resources = (Resource("cpu", bool(rng.integers(2))), Resource("memory", False), Resource("disk"))[:kinds]
    vnfs = {name: _vnf(rng, resources) for name in VNFS}
    chain = tuple(rng.choice(VNFS, size=rng.integers(0 if rng.random() < 0.1 else 1, 6)).tolist())
    service = ServiceType(
        "tight",
        chain,
        rate=4.0,
        tolerable_delay=None if rng.random() < 0.4 else float(rng.choice([40.0, 80.0, 150.0])),
        rates=tuple(rng.integers(0, 6, len(chain) + 1).astype(float)) if rng.random() < 0.5 else None,
        ingress="any" if chain and rng.random() < 0.4 else None,
        egress="any" if chain and rng.random() < 0.4 else None,
    )
    scenario = Scenario(
        name="general",
        seed=0,
        substrate=_substrate(rng, seed, nodes, resources),
        catalogue=ServiceCatalogue((service,), vnfs, resources),
        horizon=1,
        endpoints="uniform",
        placement=("walk", "colocate", "distinct")[rng.integers(3)],
        max_steps=int(rng.choice([5, 8, 100])),
    )
    ends = rng.integers(nodes, size=2)
    if not chain:
        ends = rng.choice(nodes, 2, replace=False)
    ingress, egress = (FREE if end else node for node, end in zip(ends, (service.ingress, service.egress), strict=True))
    simulator = Simulator(scenario, 1)
    one = np.ones(1, np.int64)
    simulator.start(0, Workload(0 * one, 0 * one, ingress * one, egress * one, np.ones(1)))
    _take_away(rng, simulator)
    return simulator


def _vnf(rng: np.random.Generator, resources: tuple[Resource, ...]) -> dict[str, float]:
    needs = {kind.name: round(float(rng.uniform(0.5, 3)), 1) for kind in resources}
    return needs | ({"delay": float(rng.integers(0, 20))} if rng.random() < 0.3 else {})


def _substrate(rng: np.random.Generator, seed: int, nodes: int, resources: tuple[Resource, ...]) -> Substrate:
    plain = draw_random_substrate(
        nodes, seed, mean_degree=float(rng.uniform(2, 3.5)), vms=(1, 2), vm_capacity=(20, 60), link_capacity=(10, 20),
        link_delay=(0, 20), vm_unit_cost=(1, 9), link_unit_cost=(1, 9),
    )  # fmt: skip
    count = plain.vm_count * (rng.random(nodes) < 0.8)
    count[0] = max(count[0], 1)
    exists = np.arange(plain.max_vms) < count[:, None]
    extra = rng.uniform(20, 60, (*exists.shape, len(resources) - 1)).round(1) * exists[..., None]
    return replace(
        plain,
        vm_count=count,
        vm_capacity=plain.vm_capacity.round(1) * exists,
        vm_unit_cost=plain.vm_unit_cost * exists,
        resources=tuple(kind.name for kind in resources),
        extra_capacity=extra if len(resources) > 1 else None,
        extra_unit_cost=np.where(extra > 0, rng.uniform(1, 9, extra.shape), 0) if len(resources) > 1 else None,
        back_capacity=rng.uniform(10, 20, plain.num_links).round(1) if rng.random() < 0.5 else None,
    )


def _take_away(rng: np.random.Generator, simulator: Simulator) -> None:
    """Leave of every VM about as much as one or two functions take, of every link as much as few crossings."""
    tables, ledger = simulator.tables, simulator.world.ledger
    largest = tables.load_units.max(axis=(0, 1))
    room = (rng.uniform(0.5, 3.5, ledger.vm_offered[0].shape) * largest).astype(np.int64)
    ledger.vm_offered[0] = np.minimum(ledger.vm_offered[0], room)
    crossings = rng.choice([0, 1, 2, 2, 3], ledger.link_offered[0].shape)
    ledger.link_offered[0] = np.minimum(ledger.link_offered[0], crossings * tables.rate_units.max())


def plan_and_play(planner: Planner, simulator: Simulator) -> float:
    """Cost of the planner's answer once the simulator has carried it out, inf if it has none."""
    plans, lengths = np.zeros((1, simulator.world.rules.max_steps), np.int64), np.zeros(1, np.int64)
    planner.prepare(simulator.world)
    planner.plan_rows(simulator.world, np.zeros(1, np.int64), plans, lengths)
    if lengths[0] == 0:
        return math.inf
    for action in plans[0, : lengths[0]]:
        assert not simulator.outcome["accepted"][0], "steps after the end"
        simulator.step(np.array([action]))
        assert simulator.outcome["passed"][0], (action, simulator.outcome["reason"][0])
    assert simulator.outcome["accepted"][0], "the plan ends too early"
    return float(simulator.outcome["request_cost"][0])


def compare(seed: int) -> bool:
    """Assert that the exact search costs what the integer programme does; whether the request can be embedded."""
    simulator = general_case(seed)
    embedding = embed_request(simulator.world, 0)
    found = plan_and_play(MyopicPlanner(), simulator)
    best = math.inf if embedding is None else embedding.cost
    assert found == best or abs(found - best) <= 1e-6, f"seed {seed}: search {found}, programme {best}"
    return math.isfinite(found)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    embedded = sum(compare(seed) for seed in range(count))
    print(f"{count} requests, {embedded} can be embedded: search and programme agree to 1e-6 on all")
