"""CN-UPB/NFVdeep's network and requests are drawn as theirs are; draws with profiles of their own are held together."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evolution import Redrawn
from nfv_torchrl.methods import PlannerMethod, policy_file
from nfv_torchrl.planners import FirstFitPlanner
from nfv_torchrl.scenario.nfvdeep_network import draw_nfvdeep
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.together import share_profiles
from nfv_torchrl.simulator import Simulator

LAWS = Path(__file__).parents[2] / "docs" / "benchmark" / "cnupb_550.json"


@pytest.fixture
def config(tmp_path):
    """A short setting of theirs: 20 to 40 requests in 500 slots, on a square of nodes."""
    (tmp_path / "laws.json").write_text(
        json.dumps(json.loads(LAWS.read_text()) | {"num_timeslots": [500, 500], "num_requests": [20, 40]})
    )
    links = [{"source": n, "target": (n + 1) % 4, "delay": 1.0} for n in range(4)]
    (tmp_path / "net.json").write_text(json.dumps({"nodes": [{"id": n} for n in range(4)], "links": links}))
    target = "nfv_torchrl.scenario.nfvdeep_network.draw_nfvdeep"
    chain = {"chain": ["f"], "rate": 1, "tolerable_delay": 1, "ingress": "any", "egress": "any"}
    return {
        "horizon": None, "endpoints": "uniform", "placement": "colocate", "mask": "feasible",
        "substrate": {"generator": {"_target_": target, "path": str(tmp_path / "net.json")}},
        "resources": {"cpu": {"scales_with_rate": False}, "memory": {"scales_with_rate": False}},
        "vnfs": {"f": {"cpu": 1, "memory": 1}}, "services": {"chain": chain},
        "workload": {"path": str(tmp_path / "laws.json")},
    }  # fmt: skip


def test_capacities_are_those_that_they_draw_with_seed_0(config):
    """The first two nodes of their abilene.gpickle: (433, 25.27, 890.35) and (21, 17.31, 511.76)."""
    substrate = draw_nfvdeep(7, path=substrate_path(config))
    assert substrate.vm_capacity[:2, 0].tolist() == [433, 21]
    assert substrate.extra_capacity[:2, 0, 0] == pytest.approx([25.27045430802648, 17.31175526845669])
    first = substrate.links.tolist().index([0, 1])
    assert substrate.link_capacity[first] == pytest.approx(890.3536769162939)  # from 0
    assert substrate.back_capacity[first] == pytest.approx(511.7634466472399)  # from 1
    assert draw_nfvdeep(7, path=substrate_path(config), network_seed=None).vm_capacity[0, 0] != 433
    with pytest.raises(ScenarioError, match="memory is"):
        draw_nfvdeep(0, path=substrate_path(config), memory=(0.0, 1.0))


def substrate_path(config) -> str:
    return config["substrate"]["generator"]["path"]


def test_requests_are_those_that_they_draw(config):
    """Their order of drawing, step by step: sizes, all arrivals, all stays, types of VNFs, then request by request."""
    requests = Scenario.from_config({**config, "seed": 3})
    rng = random.Random(3)
    count, slots, stay = rng.randint(20, 40), rng.randint(500, 500), rng.randint(100, 1000)
    time = slot = 0
    slots_drawn = []
    for _ in range(count):
        time += rng.expovariate(count / slots)
        slot = int(np.ceil(time))
        slots_drawn.append(slot)
    stays = [int(rng.expovariate(1 / stay)) + 1 for _ in range(count)]
    types = [(rng.randint(1, 20), rng.uniform(5.0, 10.0)) for _ in range(6)]
    delays = [rng.uniform(20, 100) for _ in range(6)]
    vnfs = [rng.randint(0, 5) for _ in range(rng.randint(1, 6))]
    found = requests.file_workload
    assert found.slot.tolist() == slots_drawn and found.lifetime.tolist() == stays
    first = requests.profiles
    assert first.amount[1, : len(vnfs)].tolist() == [list(map(float, types[vnf])) for vnf in vnfs]
    assert first.fixed_delay[1, : len(vnfs)].tolist() == [delays[vnf] for vnf in vnfs]
    rng.uniform(10000, 10000)
    assert first.rate[1, 1] == (rng.uniform(20, 100) if len(vnfs) > 1 else 0)


def test_draws_are_held_together_without_a_change(config):
    """Each of three draws does alone what it does in one simulator with the others; without sharing it is refused."""
    apart = [Scenario.from_config({**config, "seed": seed, "horizon": 900}) for seed in range(3)]
    with pytest.raises(ScenarioError, match="must share the requests' profiles"):
        Simulator(apart, 3)

    def accepted(scenarios):
        method = PlannerMethod(FirstFitPlanner(), name="first_fit")
        return [record.accepted.tolist() for record in run_method(scenarios, method, [0] * len(scenarios))]

    assert accepted(share_profiles(apart)) == [accepted([scenario])[0] for scenario in apart]


def test_a_policy_for_several_draws_is_built_on_one_of_them(config, monkeypatch):
    """They are played apart, and tables of all of them at once would take gigabytes where draws are large."""
    worlds = []

    def made(scenarios, *args, **keys):
        worlds.append(len(scenarios))
        return Simulator(scenarios, *args, **keys)

    monkeypatch.setattr(policy_file, "Simulator", made)
    draws = [Scenario.from_config({**config, "seed": seed}) for seed in range(3)]
    path = Path(__file__).parents[2] / "docs" / "results" / "policies" / "cnupb_0.pt"
    records = run_method(draws, policy_file.load_policy(path, draws), [0, 1, 2])
    assert worlds == [1] and all(record.accepted.any() for record in records)


def test_a_pool_has_the_requests_of_all_draws(config):
    (pooled,) = Redrawn({**config, "horizon": 900}, draws=4).scenarios(seed=0, count=8)
    assert len(pooled.pool) == 4 and pooled.workload(5, 1) is pooled.workload(5, 1)
    assert {id(pooled.workload(0, number)) for number in range(60)} == {id(each) for each in pooled.pool}
    tasks = Redrawn(config, draws=4).draw(0, 1, 3)
    assert len({task.scenario.seed for task in tasks} | {pooled.seed}) == 4
    assert min(task.scenario.seed for task in tasks) >= 1_000_000


def test_draws_may_have_several_files_in_turn(config, tmp_path):
    """Such as the requests of several loads; what else the scenario says of its workload stays."""
    more = json.loads(Path(config["workload"]["path"]).read_text())
    more["num_requests"] = [80, 80]
    (tmp_path / "more.json").write_text(json.dumps(more))
    files = [config["workload"]["path"], str(tmp_path / "more.json")]
    counts = [len(task.workload) for task in Redrawn(config, workloads=files).draw(0, 0, 4)]
    assert counts[1] == counts[3] == 80 and max(counts[0], counts[2]) <= 40
    (pooled,) = Redrawn({**config, "horizon": 900}, draws=2, workloads=files).scenarios(seed=0, count=8)
    assert max(map(len, pooled.pool)) == 80 and min(map(len, pooled.pool)) <= 40
    with pytest.raises(ScenarioError, match="workloads: is empty"):
        Redrawn(config, workloads=[])
