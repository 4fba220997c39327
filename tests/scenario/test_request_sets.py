"""Requests of other projects' files: what is read, drawn, named and refused; Virne's metrics worked out by hand."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.scenario import Scenario

FILES = Path(__file__).parent / "requests"
CHAIN = {"chain": ["f"], "rate": 25, "tolerable_delay": None, "ingress": "any", "egress": "any"}
BOTH_KINDS = {
    "cpu": {"scales_with_rate": False},
    "memory": {"scales_with_rate": False, "vm_capacity": [50, 50], "vm_unit_cost": [1, 1]},
}


def world(workload: Path, **changes) -> Scenario:
    """The three nodes of ``virne.gml`` (0 - 1 - 2: cpu 78, 87, 67; bw 54, 86), every unit at the cost of 1."""
    config = {
        "name": "three",
        "horizon": None,
        "endpoints": "uniform",
        "placement": "distinct",
        "mask": "feasible",
        "resources": {"cpu": {"scales_with_rate": False}},
        "vnfs": {"f": {"cpu": 10}},
        "services": {"chain": CHAIN},
        "substrate": {
            "path": str(FILES.parent / "formats" / "virne.gml"),
            "vm_unit_cost": [1, 1],
            "link_unit_cost": [1, 1],
            "link_delay": [0, 0],
        },
        "workload": {"path": str(workload)},
        **changes,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        return Scenario.from_config(config)


def decide(scenario: Scenario, folder: Path):
    """``myopic_optimal`` on the file's requests: the record and the metrics, once the audit has found nothing."""
    (record,) = run_method(scenario, PlannerMethod(MyopicPlanner(), name="myopic_optimal"), [0])
    metrics = compute_metrics(record)
    write_run(folder, record, metrics)
    assert audit_run(folder).problems == []
    return record, metrics


def copied(folder: Path, old: str = "", new: str = "", name: str = "v_net-00001.gml") -> Path:
    """A copy of ``virne_set`` in which ``old`` is ``new`` in a file."""
    shutil.copytree(FILES / "virne_set", folder / "set")
    path = folder / "set" / name if name == "events.yaml" else folder / "set" / "v_nets" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    return folder / "set"


@pytest.mark.parametrize("part", ["", "v_nets"])
def test_a_set_of_virne_and_its_metrics_by_hand(tmp_path, part):
    scenario = world(FILES / "virne_set" / part)
    assert scenario.horizon == 8
    requests = scenario.file_workload
    assert requests.slot.tolist() == [1, 2, 4, 7] and requests.time is None
    assert requests.departure.tolist() == [11, 7, 8, 9] and requests.lifetime.tolist() == [10, 4.5, 3.25, 2]
    profiles = scenario.profiles
    assert profiles.amount[1:, :, 0].tolist() == [[85, 0], [70, 60], [1, 80], [60, 0]]
    assert profiles.rate[1:].tolist() == [[0, 0, 0], [0, 20, 0], [0, 0, 0], [0, 0, 0]]
    assert np.isinf(profiles.tolerable_delay[1:]).all() and not profiles.work.any()
    # The first takes node 1 all but 2. The second stands on nodes 0 and 2, two hops apart: it earns 70 + 60 + 20 and
    # costs 20 more. No node has the 80 of the third. The fourth comes when the second has left.
    record, metrics = decide(scenario, tmp_path / "run")
    assert record.accepted.tolist() == [True, True, False, True]
    assert record.cost[record.accepted].tolist() == [85, 170, 60]
    earned, spent = 85 * 10 + 150 * 4.5 + 60 * 2, 85 * 10 + 170 * 4.5 + 60 * 2
    assert metrics["rac"] == 3 / 4
    assert metrics["lrc"] == pytest.approx(earned / spent, rel=1e-12)
    assert metrics["lar"] == pytest.approx(earned / 7, rel=1e-12)


@pytest.mark.parametrize(("time", "accepted"), [("6.4", False), ("6.5", True), ("6.75", True)])
def test_times_within_a_slot_are_exact(tmp_path, time, accepted):
    """The second request holds node 0 up to 6.5; whoever wants it in that slot gets it from then on."""
    folder = copied(tmp_path, "arrival_time 7.0", f"arrival_time {time}", "v_net-00003.gml")
    text = (folder / "v_nets" / "v_net-00003.gml").read_text().replace("cpu 60", "cpu 70")
    (folder / "v_nets" / "v_net-00003.gml").write_text(text)
    (folder / "events.yaml").unlink()
    scenario = world(folder)
    requests = scenario.file_workload
    assert requests.time.tolist() == [1, 2, 4, float(time)] and requests.slot.tolist() == [1, 2, 4, 6]
    record, metrics = decide(scenario, tmp_path / "run")
    assert record.accepted.tolist() == [True, True, False, accepted]
    # Phi_t after the last arrival of each slot: the second is there in slot 6 only if it leaves after that arrival.
    last = 85 + (70 if accepted else 170)
    assert metrics["anuc"] == pytest.approx((0 + 85 + 4 * 255 + last) / 7, rel=1e-12)
    again = read_run_folder(tmp_path / "run")
    assert again.workload.time.tolist() == requests.time.tolist()
    assert again.scenario.file_workload.leaves.tolist() == requests.leaves.tolist()


def test_a_list_of_nfvdeep(tmp_path):
    with pytest.warns(ScenarioWarning, match="not used: arrival_rate"):
        scenario = Scenario.from_config(
            {
                "horizon": None,
                "endpoints": "uniform",
                "resources": BOTH_KINDS,
                "vnfs": {"f": {"cpu": 1, "memory": 1}},
                "services": {"chain": CHAIN},
                "workload": {"path": str(FILES / "nfvdeep_requests.json")},
            }
        )
    requests, profiles = scenario.file_workload, scenario.profiles
    assert requests.slot.tolist() == [1, 3]  # in order of arrival
    assert requests.departure.tolist() == [2, 9]  # still there in slot arrival + ttl
    assert profiles.amount[1:].tolist() == [[[7, 2], [0, 0]], [[10, 20.5], [4, 1]]]
    assert profiles.rate[1:].tolist() == [[0, 0, 0], [0, 1.5, 0]]
    assert profiles.tolerable_delay[1:].tolist() == [10, 40]
    assert profiles.fixed_delay[1:].tolist() == [[0, 0], [20.5, 0]] and not profiles.work[1:].any()
    decide(scenario, tmp_path / "run")


def test_laws_of_nfvdeep_are_drawn_from_with_the_scenario_seed():
    def drawn(seed: int) -> Scenario:
        return world(FILES / "nfvdeep_laws.json", seed=seed, substrate={}, resources=BOTH_KINDS, placement=None,
                     vnfs={"f": {"cpu": 1, "memory": 1}})  # fmt: skip

    scenario, again, other = drawn(1), drawn(1), drawn(2)
    requests, profiles = scenario.file_workload, scenario.profiles
    assert np.array_equal(requests.lifetime, again.file_workload.lifetime)
    assert not np.array_equal(requests.lifetime[:50], other.file_workload.lifetime[:50])
    assert len(requests) == 400 and requests.time is None
    # 400 arrivals in 3,000 slots: 20 gaps of 7.5 on average are one standard error; lifetimes of 50 likewise.
    assert abs(requests.slot[-1] - 3000) < 4 * 150 and abs(requests.lifetime.mean() - 50) < 4 * 2.5
    own, length = profiles.amount[1:], profiles.chain_length[1:]
    assert set(length) == set(range(1, 7)) and abs(length.mean() - 3.5) < 4 * 0.09
    used = own[np.arange(own.shape[1]) < length[:, None]]
    assert len(np.unique(used, axis=0)) == 6  # types of VNFs
    assert used[:, 0].min() >= 1 and used[:, 0].max() <= 20 and used[:, 1].min() >= 5 and used[:, 1].max() <= 10
    assert profiles.tolerable_delay[1:].min() >= 1000 and profiles.tolerable_delay[1:].max() <= 2000


def test_a_node_without_cpu_only_forwards(tmp_path):
    (tmp_path / "net.gml").write_text((FILES.parent / "formats" / "virne.gml").read_text().replace("cpu 87", "cpu 0"))
    path = {"path": str(tmp_path / "net.gml"), "vm_unit_cost": [1, 1], "link_unit_cost": [1, 1], "link_delay": [0, 0]}
    scenario = world(FILES / "virne_set", substrate=path)
    assert scenario.substrate.vm_count.tolist() == [1, 0, 1]
    record, _ = decide(scenario, tmp_path / "run")
    assert record.accepted.tolist() == [False, True, False, True]
    assert record.cost[1] == 170  # it passes node 1


TRIANGLE = 'node [ id 2 label "2" cpu 1 ]\n  edge [ source 1 target 2 bw 1 ]\n  edge [ source 2 target 0 bw 1 ]\n  edge'
REFUSED = [
    ("v_net-00001.gml", "edge", TRIANGLE, "v_net-00001.gml: is no chain, it has no end"),
    ("v_net-00001.gml", "edge", 'node [ id 2 cpu 1 ]\n  edge', "is no chain, it has 3 nodes in several parts"),
    ("v_net-00001.gml", "cpu 70", "gpu 70", "v_net-00001.gml: node 0 has cpu None"),
    ("v_net-00001.gml", "cpu 70", "cpu -70", "node 0 has cpu -70; use a finite number of at least 0"),
    ("v_net-00001.gml", "bw 20", "bw 1.0e-9", "v_net-00001.gml: a bandwidth is 1e-09; use 0 or a number"),
    ("v_net-00001.gml", "lifetime 4.5", "lifetime 0", "its lifetime is 0"),
    ("v_net-00001.gml", "id 1\n", 'id "x"\n', "the graph's id is 'x'"),
    ("events.yaml", "time: 6.5", "time: 6.6", "virtual network 1 leaves at 6.6, by .*v_net-00001.gml at 6.5"),
    ("events.yaml", "v_net_id: 3", "v_net_id: 9", "virtual network 3 arrives at None"),
    ("events.yaml", "- id: 0", "- id: [", "events.yaml: is not valid YAML"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "message"), REFUSED)
def test_what_cannot_be_used_is_refused_by_name(tmp_path, name, old, new, message):
    with pytest.raises(ScenarioError, match=message):
        world(copied(tmp_path, old, new, name))


def test_other_refusals(tmp_path):
    with pytest.raises(ScenarioError, match=r"list one service .there are 3 services."):
        world(FILES / "virne_set", services=None, vnfs={"NAT": 1, "FW": 1, "TM": 1, "VOC": 1, "IDPS": 1})
    with pytest.raises(ScenarioError, match=r"v_net-00003.gml: arrives at 7 s, beyond the horizon of 7"):
        world(FILES / "virne_set", horizon=7)
    with pytest.raises(ScenarioError, match="horizon: is null"):
        Scenario.from_config({"horizon": None})
    with pytest.raises(ScenarioError, match="holds no requests; give a folder of Virne's"):
        world(tmp_path)
    (tmp_path / "requests.json").write_text('{"type": "poisson_arrival_uniform_load", "cpus": [1]}')
    with pytest.raises(ScenarioError, match="is no list of requests, nor the object of type"):
        world(tmp_path / "requests.json")
    with pytest.warns(ScenarioWarning, match="memory .a kind of resource that scenario.resources lacks."):
        config = world(FILES / "virne_set")
        warned = {"horizon": None, "services": {"chain": CHAIN}, "vnfs": {"f": 1}, "endpoints": "uniform"}
        Scenario.from_config({**warned, "workload": {"path": str(FILES / "nfvdeep_requests.json")}})
    assert config.replace(mask="adjacency").file_workload is config.file_workload  # read once
