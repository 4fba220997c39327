"""Requests with demands of their own: from the file to the reference simulator, the observations and the audit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from strategies import Instance
from test_agreement import run_both

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.observations import CandidateObservation, RequestObservation
from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator

RESOURCES = {
    "cpu": {"scales_with_rate": False},
    "memory": {"scales_with_rate": False, "vm_capacity": [20.0, 40.0], "vm_unit_cost": [1.0, 2.0]},
}
DEMANDS = [
    {"amounts": {"cpu": [3, 4.5], "memory": [1, 0]}, "rates": [0, 2, 0]},
    {"amounts": {"cpu": [3, 4.5], "memory": [1, 0]}, "rates": [0, 2.5, 0]},
    {"amounts": {"cpu": [3, 4.5, 2], "memory": [1, 0, 5]}, "rates": 1, "tolerable_delay": 500},
    {"amounts": {"cpu": [3], "memory": [2]}, "rates": [1, 2], "processing_delay": [7]},
    {"amounts": {"cpu": [], "memory": []}, "rates": 3},
]


def scenario_of(folder: Path, demands: list[object], ends: str = "any,any", **settings) -> Scenario:
    """Four nodes and a file with a request for each demand, the last line without one."""
    lines = ["slot,service,ingress,egress,lifetime,demand"]
    for place, demand in enumerate(demands):
        here = "1,3" if demand == DEMANDS[-1] else ends
        text = (demand if isinstance(demand, str) else json.dumps(demand)).replace('"', '""')
        lines.append(f'{place},chain,{here},4.5,"{text}"')
    lines.append(f"{len(demands)},chain,0,2,4,")
    (folder / "requests.csv").write_text("\n".join(lines) + "\n")
    chain = {"chain": ["A", "A"], "rate": 1.0, "tolerable_delay": None}
    return Scenario.from_config(
        {
            "horizon": len(demands) + 1,
            "endpoints": "uniform",
            "resources": RESOURCES,
            "vnfs": {"A": {"cpu": 2, "memory": 3}},
            "services": {"chain": chain},
            "substrate": {"nodes": 4, "vms_max": 2, "vm_capacity": [10, 20], "link_capacity": [5, 9], "duplex": "full"},
            "workload": {"path": str(folder / "requests.csv")},
            **settings,
        }
    )


@pytest.mark.parametrize("placement", ["colocate", "distinct"])
def test_they_are_served_as_the_reference_does(tmp_path, placement):
    scenario = scenario_of(tmp_path, DEMANDS, placement=placement)
    for seed in range(3):
        run_both(Instance(scenario, scenario.file_workload, FailureTimeline.empty()), seed)


def test_the_files_of_a_run_bring_them_back(tmp_path):
    scenario = scenario_of(tmp_path, DEMANDS)
    (record,) = run_method(scenario, PlannerMethod(GreedyPlanner(), name="greedy"), [0])
    assert record.accepted.sum() >= 4
    write_run(tmp_path / "run", record, compute_metrics(record))
    assert audit_run(tmp_path / "run").problems == []
    back, here = read_run_folder(tmp_path / "run").workload, record.workload
    np.testing.assert_array_equal(back.profile, here.profile)
    for name, values in vars(here.own).items():
        np.testing.assert_array_equal(getattr(back.own, name), values)


def test_no_two_of_them_look_alike(tmp_path):
    simulator = Simulator(scenario_of(tmp_path, DEMANDS), 1)
    scenario = simulator.scenarios[0]
    simulator.start(0, scenario.file_workload)
    reject, seen = simulator.num_actions - 1, []
    while not simulator.world.env["done"][0]:
        request = RequestObservation().read(simulator)["request"]
        rows = CandidateObservation().read(simulator)["candidates"]["features"]
        assert rows.isfinite().all()
        seen.append((simulator.world.seen.flat[0].tobytes(), request["rates"].numpy().tobytes()))
        assert (request["amounts"] <= 1).all() and (request["rates"] <= 1).all()
        place = int(simulator.world.seen.valid[0, 0])
        simulator.step(np.array([place if not simulator.world.seen.mask[0, reject] else reject]))
    assert len({flat for flat, _ in seen}) == len(seen) >= len(DEMANDS)


@pytest.mark.parametrize(
    ("demand", "message"),
    [
        ("{", "line 2: demand '{' is no JSON"),
        ({"rates": 1}, "line 2: demand needs amounts and rates"),
        ({"amounts": {"cpu": [1]}, "rates": 1}, "demand.amounts: is .*give a list of numbers for each of cpu, memory"),
        ({"amounts": {"cpu": [1], "memory": [1, 2]}, "rates": 1}, "give every kind as many numbers"),
        ({"amounts": {"cpu": [1], "memory": [1]}, "rates": [1]}, "demand.rates has 1 numbers"),
        ({"amounts": {"cpu": [-1], "memory": [1]}, "rates": 1}, "demand.amounts.cpu: -1; use 0 or a number from"),
        ({"amounts": {"cpu": [1], "memory": [1]}, "rates": 1, "tolerable_delay": 0}, "demand.tolerable_delay is 0"),
        ({"amounts": {"cpu": [], "memory": []}, "rates": 1}, "line 2: has no functions and no two different end nodes"),
    ],
)
def test_refuses(tmp_path, demand, message):
    with pytest.raises(ScenarioError, match=message):
        scenario_of(tmp_path, [demand], ends="1,1")
