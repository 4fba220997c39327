"""Sizes are refused before memory is touched, and the estimate is near to what is really taken."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import toy

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario import limits
from nfv_torchrl.scenario.limits import Sizes, check_memory, environment_parts, table_parts, workload_parts
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.scenario import Scenario, draw_endpoint_pairs, paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.tables import build_tables

MODEST = 50e6
"""Bytes that a refusal may touch at most."""


def peak_bytes(make: Callable[[], Any]) -> float:
    tracemalloc.start()
    try:
        make()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def refused(message: str, make: Callable[[], Any]) -> None:
    def attempt() -> None:
        with pytest.raises(ScenarioError, match=message):
            make()

    assert peak_bytes(attempt) < MODEST


# ---------------------------------------------------------------- refusals

GB = r": about [0-9.e+]+ GB of memory would be needed.*; the limit is [0-9.e+-]+ GB, half of what is free here"


@pytest.fixture
def four_gigabytes(monkeypatch):
    monkeypatch.setattr(limits, "free_bytes", lambda: 8 * 10**9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"substrate": {"nodes": 30_000}}, "substrate.nodes=30000" + GB),
        ({"substrate": {"nodes": 10**9}}, "nodes: 1000000000; use an integer of at most 32767 .*about 2e[+]10 GB"),
        ({"substrate": {"nodes": 9_000, "mean_degree": 9_000}}, "substrate.mean_degree" + GB),
        ({"substrate": {"vms_max": 10**9}}, r"vms_min, vms_max: \[1, 1000000000\]; use at most 1000 VMs"),
        ({"substrate": {"path": "abilene", "vms_max": 10**9}}, "use at most 1000 VMs"),
        (
            {"horizon": 2 * 10**9},
            r"arrival_rate \* horizon: 2e\+10 requests; use at most 1000000000; .*about 4e[+]03 GB",
        ),
        ({"horizon": 10**12}, "horizon: 1000000000000; use an integer from 1 to .*about 4e[+]03 GB"),
        ({"horizon": 10**8, "arrival_rate": 0.5}, r"arrival_rate \* horizon \(5e\+07 requests\)" + GB),
        ({"arrival_rate": 1e5}, r"arrival_rate \* horizon \(1e\+08 requests\)" + GB),
        ({"arrival_rate": 1e290}, r"arrival_rate: 1e\+290; .* at most 1000000000"),
        ({"max_steps": 10**8}, "max_steps=100000000" + GB),
        ({"max_steps": 10**9}, "max_steps: 1000000000; use an integer from 1 to .*about 116 GB"),
        ({"pairs_per_service": 10**9}, "pairs_per_service: 1000000000; a network of 10 nodes has 90"),
        (
            {"horizon": 10**6, "arrival_rate": 0.5, "failures": {"p_fail_vm": 1, "p_repair": 1}},
            "failures .* events.*" + GB,
        ),
    ],
)
@pytest.mark.usefixtures("four_gigabytes")
def test_refuses_a_scenario(changes, message):
    refused(message, lambda: paper_scenario(**{"nodes": 10} | changes))


@pytest.mark.usefixtures("four_gigabytes")
def test_refuses_a_batch():
    scenario = toy.toy_scenario()
    refused("for 1000000 environments" + GB, lambda: Simulator(scenario, 10**6))


def test_a_thousand_services_are_the_most():
    services = {f"s{k}": {"chain": ["NAT"], "rate": 1, "tolerable_delay": 9} for k in range(1001)}
    refused("services: there are 1001; define 1 to 1000", lambda: paper_scenario(services=services))


@pytest.mark.usefixtures("four_gigabytes")
def test_what_is_common_passes():
    for nodes in (10, 100):
        Simulator(paper_scenario(nodes), 64)
    assert len(paper_scenario(horizon=10_000, arrival_rate=100).workload(0)) > 900_000


def test_the_limit_is_half_of_what_is_free(monkeypatch):
    monkeypatch.setattr(limits, "free_bytes", lambda: 2 * 10**9)
    check_memory({"a": 4e8}, {"a": 4e8, "b": 2e8})
    with pytest.raises(ScenarioError, match=r"^a: about 1.2 GB .* limit is 1 GB"):
        check_memory({"a": 4e8}, {"a": 4e8, "b": 4e8})


def test_a_container_has_less(monkeypatch, tmp_path):
    (tmp_path / "max").write_text("3000\n")
    (tmp_path / "now").write_text("1000\n")
    monkeypatch.setattr(limits, "V2", (str(tmp_path / "max"), str(tmp_path / "now")))
    assert limits.free_bytes() == 2000
    (tmp_path / "max").write_text("max\n")
    assert limits.free_bytes() > 10**6


# ---------------------------------------------------------------- estimates


def total(*groups: dict[str, float]) -> float:
    return sum(sum(parts.values()) for parts in groups)


@pytest.mark.parametrize(("nodes", "degree", "vms"), [(600, 4, 6), (150, 140, 6), (50, 4, 1000)])
def test_a_random_graph_takes_what_is_estimated(nodes, degree, vms):
    links = nodes * degree // 2
    peak = peak_bytes(lambda: draw_random_substrate(nodes, 0, mean_degree=degree, vms=(1, vms)))
    estimate = total(limits.random_graph_parts(nodes, links, vms))
    assert peak < 1.5 * estimate and estimate < 4 * peak


def test_tables_and_pairs_take_what_is_estimated():
    scenario = paper_scenario(150)
    peak = peak_bytes(lambda: build_tables([scenario.substrate], scenario.catalogue))
    assert peak < 1.5 * total(table_parts(scenario.sizes)) < 4 * peak
    peak = peak_bytes(lambda: draw_endpoint_pairs(20, 5, scenario.substrate, 0))
    assert peak < 3 * 8 * 150 * 149


@pytest.mark.parametrize(
    "changes",
    [
        {"horizon": 200_000, "arrival_rate": 0.5},
        {"arrival_rate": 100, "mean_lifetime": 10},
        {"max_steps": 50_000},
        {"failures": {"p_fail_vm": 0.5, "p_fail_link": 0.5, "p_repair": 0.5}},
    ],
)
@pytest.mark.parametrize("record", [False, True])
def test_an_environment_takes_what_is_estimated(changes, record):
    scenario: Scenario = paper_scenario(**changes)
    start = scenario.workload(0), scenario.failure_timeline(0)
    Simulator(toy.toy_scenario(), 1, record=record).start(0, toy.toy_workload())  # compiles the kernels

    def run() -> None:
        simulator = Simulator(scenario, 2, record=record)
        for b in range(2):
            simulator.start(b, *start)

    peak = peak_bytes(run)
    estimate = 2 * total(environment_parts(scenario.sizes, record=record)) + total(table_parts(scenario.sizes))
    assert peak < 2 * estimate and estimate < 6 * peak


def test_a_workload_takes_no_more_than_is_estimated():
    scenario = paper_scenario(arrival_rate=100, failures={"p_fail_vm": 0.3, "p_repair": 0.3})
    peak = peak_bytes(lambda: (scenario.workload(0), scenario.failure_timeline(0)))
    assert peak < total(workload_parts(scenario.sizes)) < 8 * peak
    events = len(scenario.failure_timeline(0))
    assert scenario.sizes.events == pytest.approx(events, rel=0.1)


def test_sizes_by_hand():
    """Four nodes of two VMs, five links; one request a slot for six slots, of 2 s each."""
    sizes = toy.toy_scenario().sizes
    assert sizes == Sizes(4, 2, 5, 2, 2, horizon=6, requests=6, running=2, max_steps=100, events=0, rates=2)
    assert np.isfinite(total(environment_parts(sizes)))
