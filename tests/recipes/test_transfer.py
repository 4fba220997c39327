"""One policy on networks of other sizes: numbers from made-up cells by hand, and once for real at tiny size."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
from inprocess import call, recipe
from tiny import TINY_SCENARIO

from nfv_torchrl.experiments import rows
from nfv_torchrl.losses import DQN
from nfv_torchrl.methods import policy_content, save_policy
from nfv_torchrl.networks import CandidateNetwork, Sizes
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

AAR = {"greedy": [0.80, 0.80, 0.80], "checkpoint": [0.82, 0.83, 0.84]}
COSTS = {"greedy": [4.0, math.nan, 6.0], "checkpoint": [6.0, 9.0, 9.0]}  # both accept the first and the third


@pytest.fixture
def policy(tmp_path):
    """An untrained candidate network of five nodes, as a policy file."""
    scenario = paper_scenario(nodes=5, seed=0, mask="feasible")
    sizes = Sizes.of(Simulator(scenario, 1))
    config = {
        "network": {"_target_": "nfv_torchrl.networks.CandidateNetwork", "_partial_": True, "hidden": [8]},
        "loss": {"_target_": "nfv_torchrl.losses.DQN"},
        "one_hot": True,
    }
    loss = DQN(lambda sizes, outputs=1: CandidateNetwork(sizes, outputs, hidden=[8]), sizes)
    save_policy(tmp_path / "best.pt", policy_content(loss, sizes, config, scenario, {}))
    return tmp_path / "best.pt"


def rows_of(folder):
    with (folder / "transfer.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {(row["network"], row["metric"], row["reference"] or row["method"]): row for row in rows}


def metrics_of(aar):
    """What is read of an evaluation: services accepted alike, of which a hundredth was turned away."""
    services = ("web", "voip", "video")
    return {
        "aar": aar,
        **{f"aar/{name}": aar for name in services},
        **{f"turned_away/{name}": 0.01 for name in services},
    }


def pretending(aar):
    """In place of the work: cells with the AAR of each method on each seed."""

    def compute(cells, store, workers):
        for cell in cells:
            mine = aar[cell.label.removeprefix("paper-")]
            store.write(cell, {"rho": 1.0, "metrics": {str(seed): metrics_of(one) for seed, one in enumerate(mine)}})
        return {}

    return compute


def test_the_table_pairs_workload_seeds(tmp_path, policy, monkeypatch, capsys):
    def costs(cell, store):
        return {"0": np.array(COSTS[cell.label.removeprefix("paper-")])}

    monkeypatch.setattr(recipe("transfer"), "compute_shown", pretending(AAR))
    monkeypatch.setattr(rows, "read_costs", costs)
    call(
        "transfer",
        f"checkpoint={policy}",
        "only=[paper]",
        "method=[greedy,checkpoint]",
        "seeds=3",
        f"output={tmp_path / 'out'}",
    )
    found = rows_of(tmp_path / "out")
    # Differences 0.02, 0.03, 0.04: mean 0.03, standard deviation 0.01, t quantile for two degrees 4.3027.
    paired = found["paper", "aar_difference", "greedy"]
    assert float(paired["mean"]) == pytest.approx(0.03)
    assert float(paired["ci_high"]) == pytest.approx(0.03 + 4.302653 * 0.01 / math.sqrt(3))
    assert float(found["paper", "paired_cost", "greedy"]["mean"]) == pytest.approx(1.5)
    text = (tmp_path / "out" / "transfer.md").read_text()
    assert "| paper | 10 | 0.85 | 0.8000 ± 0.0000 | 0.8300 ± 0.0248 | +0.0300 ± 0.0248 | 1.500 |" in text


def test_policies_of_several_training_seeds_are_one_method(tmp_path, policy, monkeypatch):
    """Their mean on each network seed; the interval is over network seeds, and the lowest training seed is told."""
    aar = {"greedy": [0.80, 0.80], "checkpoint_0": [0.82, 0.86], "checkpoint_1": [0.80, 0.84]}

    cost = {"greedy": 4.0, "checkpoint_0": 6.0, "checkpoint_1": 4.0}
    monkeypatch.setattr(recipe("transfer"), "compute_shown", pretending(aar))
    read = lambda cell, store: {str(s): np.array([cost[cell.label.removeprefix("paper-")]]) for s in (0, 1)}  # noqa: E731
    monkeypatch.setattr(rows, "read_costs", read)
    second = tmp_path / "second.pt"
    second.write_bytes(policy.read_bytes())
    call(
        "transfer",
        f"checkpoints=[{policy},{second}]",
        "only=[paper]",
        "method=[greedy,checkpoint]",
        "seeds=2",
        f"output={tmp_path / 'out'}",
    )
    found = rows_of(tmp_path / "out")
    # Means over training seeds 0.81 and 0.85: differences 0.01 and 0.05. Training seeds by themselves: 0.04 and 0.02.
    paired = found["paper", "aar_difference", "greedy"]
    assert float(paired["mean"]) == pytest.approx(0.03)
    assert float(paired["ci_high"]) == pytest.approx(0.03 + 12.7062 * 0.02)
    assert float(found["paper", "aar_difference_lowest", "greedy"]["mean"]) == pytest.approx(0.02)
    assert float(found["paper", "paired_cost", "greedy"]["mean"]) == pytest.approx(1.25)
    assert float(found["paper", "turned_away/voip", "checkpoint"]["mean"]) == pytest.approx(0.01)
    assert "2 training seeds, 2 workload seeds" in (tmp_path / "out" / "transfer.md").read_text()


def test_for_real_on_other_sizes_and_not_twice(tmp_path, policy):
    tiny = [text for text in TINY_SCENARIO if "nodes" not in text]
    networks = []
    for name, network in (("six", "scenario.substrate.nodes=6"), ("real", "scenario.substrate.path=abilene")):
        overrides = ",".join(f"'{text}'" for text in (*tiny, network))
        networks.append(f"+networks.{name}=[{overrides}]")
    arguments = [
        f"checkpoint={policy}",
        *networks,
        "only=[six,real]",
        "seeds=2",
        "parallel.jobs=1",
        f"output={tmp_path / 'out'}",
    ]
    call("transfer", *arguments, "bounds=true")
    found = rows_of(tmp_path / "out")
    assert {network: found[network, "aar", "checkpoint"]["nodes"] for network in ("six", "real")} == {
        "six": "6",
        "real": "11",
    }
    for network in ("six", "real"):
        for method in ("greedy", "myopic_optimal", "checkpoint"):
            bound = float(found[network, "aar_bound", "hindsight"]["mean"])
            assert 0 < float(found[network, "aar", method]["mean"]) <= bound
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "cells").iterdir()}
    call("transfer", *arguments, "bounds=true")
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "cells").iterdir()}


def test_loads_and_draws_of_a_network(tmp_path, policy):
    tiny = ",".join(f"'{text}'" for text in TINY_SCENARIO)
    call(
        "transfer",
        f"checkpoint={policy}",
        f"+networks.five=[{tiny}]",
        "only=[five]",
        "method=[greedy,checkpoint]",
        "rho=[0.5,20]",
        "draws=true",
        "overrides=['scenario.colocation=true']",
        "seeds=2",
        "parallel.jobs=1",
        f"output={tmp_path / 'out'}",
    )
    found = rows_of(tmp_path / "out")
    light, heavy = (found[f"five rho {rho}", "aar", "greedy"] for rho in ("0.5", "20"))
    assert (light["rho"], heavy["rho"]) == ("0.5", "20.0") and float(heavy["mean"]) < float(light["mean"])
    text = (tmp_path / "out" / "transfer.md").read_text()
    assert "2 scenario seeds with a workload seed each" in text and "colocation on" in text
    cells = [json.loads(path.read_text()) for path in (tmp_path / "out" / "cells").glob("*.json")]
    assert all(cell["spec"]["scenario_seeds"] == [0, 1] for cell in cells) and len(cells) == 4
    networks = [paper_scenario(nodes=5, seed=seed).substrate for seed in (0, 1)]
    assert not np.array_equal(networks[0].vm_unit_cost, networks[1].vm_unit_cost)


def test_what_is_missing_is_named(tmp_path, policy, capsys):
    for given, named in (([], "checkpoint"), ([f"checkpoint={policy}", "only=[atlantis]"], "atlantis")):
        with pytest.raises(SystemExit):
            call("transfer", *given, f"output={tmp_path / 'out'}")
        assert named in capsys.readouterr().err
