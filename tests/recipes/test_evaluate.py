"""The evaluation recipe, run for real on tiny scenarios."""

from __future__ import annotations

import csv
import importlib.util
import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tiny import ROOT, TINY_SCENARIO, run

from nfv_torchrl.evaluation.records import RUN_FILES
from nfv_torchrl.methods import policy_content, save_policy
from nfv_torchrl.networks import Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator

ALL = "method=[random,random_feasible,greedy,tabu,myopic_optimal,priced,priced_admit]"
LOADED = ["scenario.substrate.vm_capacity=[60,200]", "scenario.horizon=40", "scenario.warmup=3"]
FAILING = ["scenario.failures.p_fail_vm=0.01", "scenario.failures.p_fail_link=0.01", "scenario.failures.p_repair=0.3"]


def recipe():
    """recipes/evaluate.py as a module: recipes are no package."""
    spec = importlib.util.spec_from_file_location("evaluate_recipe", ROOT / "recipes" / "evaluate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MAIN = recipe().main


def evaluate(*overrides: str) -> None:
    """The recipe in this process: starting one takes longer than a tiny evaluation."""
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        MAIN(compose("evaluate", [*TINY_SCENARIO, *overrides]))


def refused(capsys, *overrides: str) -> str:
    """The one line that a refusal leaves."""
    with pytest.raises(SystemExit) as leaving:
        evaluate(*overrides)
    assert leaving.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ")
    return error


@pytest.mark.parametrize("colocation", ["false", "true"])
def test_every_method_passes_the_audit_under_load_and_failures(colocation, tmp_path, capsys):
    evaluate(*LOADED, *FAILING, f"scenario.colocation={colocation}", ALL, "seeds=2", f"output={tmp_path / 'out'}",
             "bounds=true")  # fmt: skip
    printed = capsys.readouterr().out
    assert "Audit, runs: 14," in printed and "nothing found" in printed
    assert printed.startswith("rho = ") and "bound: hindsight" in printed and "bound: blind" in printed
    assert "Against greedy" in printed
    methods = {"random", "random_feasible", "greedy", "tabu", "myopic_optimal", "priced", "priced_admit"}
    assert {path.name for path in (tmp_path / "out").iterdir() if path.is_dir()} == methods
    for method in methods:
        for seed in (0, 1):
            folder = tmp_path / "out" / method / f"seed_{seed}"
            assert {path.name for path in folder.iterdir()} == set(RUN_FILES)
    scenario = json.loads((tmp_path / "out" / "greedy" / "seed_1" / "scenario.json").read_text())
    assert scenario["admission_control"] and scenario["seeds"] == {"scenario": 0, "workload": 1}
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows if row["metric"] == "aar"} == methods
    assert {row["reference"] for row in rows if row["metric"] == "paired_cost"} == {"greedy"}


def test_the_integer_programme_is_a_method_too(capsys):
    evaluate("method=[milp,myopic_optimal]", "scenario.horizon=3", "scenario.substrate.nodes=4", "seeds=[7]")
    printed = capsys.readouterr().out
    assert "Audit, runs: 2," in printed and "Against milp" in printed


def tiny_policy(path: Path, *overrides: str) -> None:
    """The file of a policy that has learnt nothing."""
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = OmegaConf.to_container(compose("dqn", ["preset=mlp", *TINY_SCENARIO, *overrides]), resolve=True)
    scenario = Scenario.from_config(config["scenario"])
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=config["one_hot"]))
    loss = instantiate(config["loss"], network=instantiate(config["network"]), sizes=sizes)
    save_policy(path, policy_content(loss, sizes, config, scenario, {}))


def test_a_checkpoint_beside_a_planner(tmp_path, capsys):
    tiny_policy(tmp_path / "best.pt")
    few = ["scenario.horizon=5", "seeds=2", f"checkpoint={tmp_path / 'best.pt'}"]
    evaluate("method=[greedy,checkpoint]", *few)
    assert "Audit, runs: 4," in capsys.readouterr().out
    assert "trained on" in refused(capsys, "method=checkpoint", *few, "scenario.substrate.nodes=6")
    assert "would not be read" in refused(capsys, "method=greedy", *few)
    assert "checkpoint: is null" in refused(capsys, "method=checkpoint")
    assert "nowhere.pt" in refused(capsys, "method=checkpoint", "checkpoint=nowhere.pt")


def test_each_scenario_seed_meets_a_workload_seed_of_its_own(tmp_path, capsys):
    """Networks differ from run to run but not from method to method; a run is the one its two seeds define."""
    few = ["method=[greedy,myopic_optimal]", "scenario.horizon=20"]
    evaluate(*few, "scenario_seeds=[3,5]", "seeds=[7,8]", "bounds=true", f"output={tmp_path / 'many'}")
    printed = capsys.readouterr().out
    loads = [Scenario.from_config(world(seed)).offered_load() for seed in (3, 5)]
    assert printed.startswith(f"rho = {sum(loads) / 2:.2f} ({min(loads):.2f} to {max(loads):.2f})")
    assert "2 scenario seeds with a workload seed each" in printed and "over scenario seeds (networks)" in printed
    assert "bound: hindsight" in printed and "Audit, runs: 4," in printed
    for method in ("greedy", "myopic_optimal"):
        for scenario_seed, seed in ((3, 7), (5, 8)):
            about = json.loads((tmp_path / "many" / method / f"seed_{seed}" / "scenario.json").read_text())
            assert about["seeds"] == {"scenario": scenario_seed, "workload": seed}
    evaluate(*few, "scenario.seed=5", "seeds=[8]", f"output={tmp_path / 'one'}")
    decisions = Path("myopic_optimal") / "seed_8" / "decisions.jsonl"
    assert (tmp_path / "one" / decisions).read_text() == (tmp_path / "many" / decisions).read_text()
    with (tmp_path / "many" / "per_seed.csv").open() as file:
        assert {(row["seed"], row["scenario_seed"]) for row in csv.DictReader(file)} == {("7", "3"), ("8", "5")}


def world(seed: int) -> dict:
    """The tiny scenario of a scenario seed as its yaml, with the horizon of the test above."""
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = compose("evaluate", [*TINY_SCENARIO, "scenario.horizon=20", f"scenario.seed={seed}"])
    return OmegaConf.to_container(config, resolve=True)["scenario"]


def test_scenario_seeds_of_a_real_topology(capsys):
    """The topology stays; what is drawn on it changes."""
    evaluate("scenario.substrate.path=abilene", "scenario.substrate.target_rho=1.5", "scenario.horizon=10",
             "method=[greedy,priced_admit]", "scenario_seeds=3", "seeds=3")  # fmt: skip
    printed = capsys.readouterr().out
    assert printed.startswith("rho = 1.50 (1.50 to 1.50)") and "N = 11" in printed and "Audit, runs: 6," in printed


def test_scenario_seeds_ask_for_a_policy_that_fits_every_network(tmp_path, capsys):
    tiny_policy(tmp_path / "flat.pt")
    tiny_policy(tmp_path / "candidate.pt", "network=candidate")
    few = ["method=[greedy,checkpoint]", "scenario.horizon=5", "scenario_seeds=2", "seeds=2"]
    larger = ["scenario.substrate.nodes=7", f"checkpoint={tmp_path / 'candidate.pt'}"]
    evaluate(*few, *larger)
    assert "Audit, runs: 4," in capsys.readouterr().out
    error = refused(capsys, *few, f"checkpoint={tmp_path / 'flat.pt'}", "scenario.substrate.nodes=7")
    assert "network=candidate, which fits any size" in error


def test_a_given_network_and_workload_are_run_once(tmp_path, capsys):
    evaluate("method=greedy", "seeds=[3]", f"output={tmp_path / 'first'}")
    run_folder = tmp_path / "first" / "greedy" / "seed_3"
    given = [f"scenario.substrate.path={run_folder / 'substrate.json'}", "scenario.endpoints=uniform",
             f"scenario.workload.path={run_folder / 'workload.csv'}"]  # fmt: skip
    evaluate("method=greedy", *given, "bounds=true", f"output={tmp_path / 'second'}")
    printed = capsys.readouterr().out
    assert "One workload" in printed and "bound: hindsight" in printed and "bound: blind" not in printed
    again = tmp_path / "second" / "greedy" / "seed_0" / "decisions.jsonl"
    assert again.read_text() == (run_folder / "decisions.jsonl").read_text()


def test_a_method_of_ones_own_needs_no_edit(capsys):
    evaluate("method=greedy", "+method.mine._target_=nfv_torchrl.methods.RandomMethod",
             "+method.mine.name=mine", "scenario.horizon=5", "seeds=1", "reference=mine")  # fmt: skip
    printed = capsys.readouterr().out
    assert "Against mine" in printed


def test_refusals(tmp_path, capsys):
    assert "seeds" in refused(capsys, "seeds=0")
    assert "seeds" in refused(capsys, "seeds=[1,1]")
    assert "seeds" in refused(capsys, "seeds=[-1]")
    assert "such as seeds=3" in refused(capsys, "scenario_seeds=3", "seeds=2")
    assert "scenario_seeds: [1, 1]" in refused(capsys, "scenario_seeds=[1,1]", "seeds=2")
    assert "leave one of them null" in refused(capsys, "scenario_seeds=2", "seeds=2", "scenario.workload.path=a.csv")
    assert "reference: 'tabu'" in refused(capsys, "reference=tabu")
    assert "unknown key" in refused(capsys, "+colour=blue")
    assert "horizon" in refused(capsys, "scenario.horizon=0")
    assert "planner.paths: 0" in refused(capsys, "method.greedy.planner.paths=0")
    (tmp_path / "file").write_text("")
    assert "is a file" in refused(capsys, f"output={tmp_path / 'file'}")


def test_two_evaluations_are_not_mixed(tmp_path, capsys):
    few = ["scenario.horizon=5", f"output={tmp_path}"]
    evaluate("method=[greedy,random]", "seeds=2", *few)
    evaluate("method=[greedy,random]", "seeds=2", "scenario.seed=1", *few)  # takes the place of the first
    assert "another evaluation" in refused(capsys, "method=greedy", "seeds=2", *few)


def test_tampering_between_run_and_audit_is_loud(monkeypatch, capsys):
    module = recipe()
    write = module.write_run

    def tampering(folder, record, metrics):
        return write(folder, record, metrics | {"aar": 1.0})

    monkeypatch.setattr(module, "write_run", tampering)
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = compose("evaluate", [*TINY_SCENARIO, "method=random", "seeds=1"])
    with pytest.raises(SystemExit) as leaving:
        module.main(config)
    assert leaving.value.code == 2
    assert "metrics.json: aar is 1.0" in capsys.readouterr().err


def test_the_command_line_leaves_no_litter(tmp_path):
    done = run("evaluate.py", *TINY_SCENARIO, "scenario.horizon=5", "method=greedy", "seeds=1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Audit, runs: 1," in done.stdout
    done = run("evaluate.py", "scenario.horizon=none", cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
