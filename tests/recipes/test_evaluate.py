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
from nfv_torchrl.networks import Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.policies import policy_content, save_policy

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
        config = OmegaConf.to_container(compose("dqn", [*TINY_SCENARIO, *overrides]), resolve=True)
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
    evaluate("method=greedy", "+method.mine._target_=nfv_torchrl.evaluation.methods.RandomMethod",
             "+method.mine.name=mine", "scenario.horizon=5", "seeds=1", "reference=mine")  # fmt: skip
    printed = capsys.readouterr().out
    assert "Against mine" in printed


def test_refusals(tmp_path, capsys):
    assert "seeds" in refused(capsys, "seeds=0")
    assert "seeds" in refused(capsys, "seeds=[1,1]")
    assert "seeds" in refused(capsys, "seeds=[-1]")
    assert "reference: 'tabu'" in refused(capsys, "reference=tabu")
    assert "no such key" in refused(capsys, "+colour=blue")
    assert "horizon" in refused(capsys, "scenario.horizon=0")
    assert "paths is 0" in refused(capsys, "method.greedy.planner.paths=0")
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
