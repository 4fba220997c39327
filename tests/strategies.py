"""Hypothesis strategies: small random scenarios in which every check of a step fails now and then."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from nfv_torchrl.scenario.failures import FailureModel, FailureTimeline
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload

VNFS = ("A", "B", "C")


class Instance(NamedTuple):
    """Everything that decides a run but the actions."""

    scenario: Scenario
    workload: Workload
    timeline: FailureTimeline


def tenths(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers with one decimal: amounts made of them are whole in the ledger, whichever way they are multiplied."""
    return st.integers(round(10 * low), round(10 * high)).map(lambda value: value / 10)


@st.composite
def substrates(draw, min_nodes: int = 2, max_nodes: int = 7, max_vms: int = 3) -> Substrate:
    """A random tree plus some more links, 1 to V VMs a node; V may exceed what any node has."""
    nodes = draw(st.integers(min_nodes, max_nodes))
    tree = {(draw(st.integers(0, node - 1)), node) for node in range(1, nodes)}
    spare = sorted({(u, v) for u in range(nodes) for v in range(u + 1, nodes)} - tree)
    extra = draw(st.sets(st.sampled_from(spare), max_size=nodes)) if spare else set()
    links = sorted(tree | extra)
    vms = draw(st.integers(1, max_vms))
    count = draw(_list_of(st.integers(1, vms), nodes))
    exists = np.arange(vms) < np.array(count)[:, None]
    capacity = np.array(draw(_list_of(tenths(2, 80), nodes * vms))).reshape(nodes, vms)
    unit_cost = np.array(draw(_list_of(tenths(0.1, 9), nodes * vms))).reshape(nodes, vms)
    return Substrate(
        name="random",
        labels=tuple(f"node {node}" for node in range(nodes)),
        vm_count=np.array(count),
        vm_capacity=np.where(exists, capacity, 0.0),
        vm_unit_cost=np.where(exists, unit_cost, 0.0),
        links=np.array(links).reshape(-1, 2),
        link_capacity=np.array(draw(_list_of(tenths(1, 10), len(links)))),
        link_delay=np.array(draw(_list_of(tenths(0, 50), len(links)))),
        link_unit_cost=np.array(draw(_list_of(tenths(0.1, 9), len(links)))),
    )


def _list_of(elements: st.SearchStrategy, size: int) -> st.SearchStrategy[list]:
    return st.lists(elements, min_size=size, max_size=size)


@st.composite
def catalogues(draw, max_types: int = 3) -> ServiceCatalogue:
    """One to three types with chains of one to four functions; a VNF may repeat within a chain."""
    types = tuple(
        ServiceType(
            name=f"service {kind}",
            chain=tuple(draw(st.lists(st.sampled_from(VNFS), min_size=1, max_size=4))),
            rate=draw(tenths(0.1, 2)),
            tolerable_delay=draw(st.sampled_from([400.0, 1500.0, 5000.0, 30000.0])),
        )
        for kind in range(draw(st.integers(1, max_types)))
    )
    return ServiceCatalogue(types=types, vnfs={name: draw(tenths(0.5, 15)) for name in VNFS})


def general_substrates(draw, kinds: int) -> Substrate:
    """A network of the general model: nodes that only forward, several kinds of resources, full duplex."""
    plain = draw(substrates())
    count = np.array([draw(st.sampled_from([0, here, here])) for here in plain.vm_count.tolist()])
    count = count if count.any() else plain.vm_count
    exists = np.arange(plain.max_vms) < count[:, None]
    more = np.array(draw(_list_of(tenths(2, 60), exists.size * (kinds - 1)))).reshape(*exists.shape, kinds - 1)
    back = draw(_list_of(tenths(1, 10), plain.num_links)) if draw(st.booleans()) else None
    return replace(
        plain,
        vm_count=count,
        vm_capacity=np.where(exists, plain.vm_capacity, 0.0),
        vm_unit_cost=np.where(exists, plain.vm_unit_cost, 0.0),
        resources=("cpu", "memory")[:kinds],
        extra_capacity=more * exists[..., None] if kinds > 1 else None,
        extra_unit_cost=np.where(exists[..., None], 0.5, 0.0) * np.ones(kinds - 1) if kinds > 1 else None,
        back_capacity=None if back is None else np.array(back),
    )


def general_catalogues(draw, kinds: int) -> ServiceCatalogue:
    """Services with rates of their own for each segment, free ends, no delay limit, no chain, a fixed delay."""
    resources = (Resource("cpu", draw(st.booleans())), Resource("memory", False))[:kinds]
    vnfs = {}
    for name in VNFS:
        vnfs[name] = {"cpu": draw(tenths(0.5, 15)), **({"memory": draw(tenths(1, 20))} if kinds > 1 else {})}
        if draw(st.booleans()):
            vnfs[name]["delay"] = draw(tenths(0, 200))
    types = []
    for kind in range(draw(st.integers(1, 3))):
        chain = tuple(draw(st.lists(st.sampled_from(VNFS), max_size=4)))
        ends = [draw(st.sampled_from([None, "any"])) if chain else None for _ in range(2)]
        rates = draw(_list_of(tenths(0.1, 2), len(chain) + 1)) if draw(st.booleans()) else None
        limit = draw(st.sampled_from([None, 400.0, 1500.0, 5000.0, 30000.0]))
        types.append(ServiceType(f"service {kind}", chain, draw(tenths(0.1, 2)), limit, 1.0, rates, *ends))
    return ServiceCatalogue(tuple(types), vnfs, resources)


@st.composite
def general_instances(draw, **fixed) -> Instance:
    """What ``instances`` draws, with every option of the general model."""
    kinds = draw(st.integers(1, 2))
    substrate, catalogue = general_substrates(draw, kinds), general_catalogues(draw, kinds)
    if draw(st.booleans()):
        fixed |= {"colocation": False, "placement": "distinct"}
    return draw(instances(substrate=substrate, catalogue=catalogue, general=True, **fixed))


@st.composite
def scenarios(draw, failures: bool = True, **fixed) -> Scenario:
    """Any combination of the options; ``fixed`` are attributes of the scenario that shall not vary."""
    substrate = fixed.pop("substrate", None) or draw(substrates())
    catalogue = fixed.pop("catalogue", None) or draw(catalogues())
    pairs = draw(_endpoint_pairs(substrate.num_nodes, len(catalogue.types))) if draw(st.booleans()) else None
    model = FailureModel()
    if failures and draw(st.booleans()):
        model = FailureModel(p_fail_vm=0.1, p_fail_link=0.1, p_repair=0.4)
    settings = {
        "name": "random",
        "seed": draw(st.integers(0, 1000)),
        "horizon": draw(st.integers(1, 8)),
        "arrival_rate": draw(st.sampled_from([0.5, 1.0, 2.0])),
        "mean_lifetime": draw(st.sampled_from([0.5, 2.0, 6.0])),
        "endpoints": "uniform" if pairs is None else "catalogue",
        "endpoint_pairs": pairs,
        "colocation": draw(st.booleans()),
        "mask": draw(st.sampled_from(["adjacency", "feasible"])),
        "admission_control": draw(st.booleans()),
        "observe_lifetime": draw(st.booleans()),
        "max_steps": draw(st.sampled_from([3, 6, 12, 100])),
        "step_budget": draw(st.sampled_from(["request", "slot"])),
        "placing_after_chain": draw(st.sampled_from(["masked", "forwards"])),
        "failures": model,
    }
    return Scenario(substrate=substrate, catalogue=catalogue, **(settings | fixed))


@st.composite
def _endpoint_pairs(draw, nodes: int, types: int) -> np.ndarray:
    everything = [(a, b) for a in range(nodes) for b in range(nodes) if a != b]
    each = draw(st.integers(1, min(3, len(everything))))
    distinct = st.lists(st.sampled_from(everything), min_size=each, max_size=each, unique=True)
    return np.array([draw(distinct) for _ in range(types)])


@st.composite
def workloads(
    draw, scenario: Scenario, min_requests: int = 1, max_requests: int = 12, general: bool = False
) -> Workload:
    """Requests the scenario could see, in order of slots, some slots without any."""
    requests = draw(
        st.lists(_requests(scenario, general), min_size=min_requests, max_size=max_requests).map(
            lambda several: sorted(several, key=lambda request: request[0])
        )
    )
    slot, service, ingress, egress = np.array([row[:4] for row in requests], np.int64).reshape(-1, 4).T
    time = None
    if general and draw(st.booleans()):
        within = draw(_list_of(st.sampled_from([0.0, 0.25, 0.5, 0.99]), len(slot)))
        time = np.sort(slot + np.array(within))
    lifetime = np.array([row[4] for row in requests], np.float64)
    return Workload(slot, service, ingress, egress, lifetime, time=time)


@st.composite
def _requests(draw, scenario: Scenario, general: bool) -> tuple[int, int, int, int, float]:
    slot = draw(st.integers(0, scenario.horizon - 1))
    service = draw(st.integers(0, len(scenario.catalogue.types) - 1))
    kind = scenario.catalogue.types[service]
    if scenario.endpoint_pairs is not None:
        ingress, egress = draw(st.sampled_from(scenario.endpoint_pairs[service].tolist()))
    else:
        ingress = draw(st.integers(0, scenario.substrate.num_nodes - 1))
        # The egress is any node but the ingress, unless the whole walk may stay on one node.
        least = 0 if general and kind.chain else 1
        egress = (ingress + draw(st.integers(least, scenario.substrate.num_nodes - 1))) % scenario.substrate.num_nodes
    ingress, egress = (FREE if end else node for end, node in ((kind.ingress, ingress), (kind.egress, egress)))
    # Whole lifetimes and those just beside them try the rounding of the departure slot.
    lifetime = draw(st.sampled_from([0.01, 0.5, 0.99, 1.0, 1.01, 2.0, 4.5, 50.0]))
    return slot, service, ingress, egress, lifetime


@st.composite
def instances(
    draw, failures: bool = True, min_requests: int = 1, max_requests: int = 12, general: bool = False, **fixed
) -> Instance:
    """A scenario, a workload for it and its failure timeline."""
    scenario = draw(scenarios(failures=failures, **fixed))
    workload = draw(workloads(scenario, min_requests, max_requests, general))
    return Instance(scenario, workload, scenario.failure_timeline(draw(st.integers(0, 1000))))


def random_action(mask: list[bool], rng: random.Random, invalid: float = 0.03) -> int:
    """A valid action other than ``reject`` if there is one; now and then ``reject``, and rarely any index at all.

    Rejecting is kept rare so that walks get far.
    """
    chance = rng.random()
    if chance < invalid:
        return rng.randrange(len(mask))
    valid = [action for action, allowed in enumerate(mask) if allowed]
    others = [action for action in valid if action != len(mask) - 1]
    if others and (chance > 2 * invalid or not mask[-1]):
        # Placing is preferred to wandering: half of the time only such actions are drawn from, where there are any.
        placing = [action for action in others if action % 2]
        return rng.choice(placing if placing and rng.random() < 0.5 else others)
    return valid[-1]
