"""Settings of recipes: what each key takes, how a refusal reads, and what happens to any value at all."""

from __future__ import annotations

import copy
import io
import math
import subprocess
import sys

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tiny import ROOT, with_preset

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import parse_config
from nfv_torchrl.settings import kinds
from nfv_torchrl.settings.recipes import RECIPES, check_recipe, read_settings
from nfv_torchrl.settings.values import MOST_SEEDS, list_of_seeds
from nfv_torchrl.training.cli import expected, plain_output
from nfv_torchrl.training.overrides import explain

RECIPE_FILES = ROOT / "recipes"
WRITTEN = {"milp_gap": {"seeds": 10, "requests": 30}}
BAD = [-1, 0, 10**30, "text", [], {"a": 1}, None, math.nan, True]


def config_of(name: str) -> dict:
    if name in WRITTEN:
        return WRITTEN[name]
    with initialize_config_dir(str(RECIPE_FILES / "config"), version_base=None):
        return OmegaConf.to_container(compose(name), resolve=True)


def keys_of(config: dict, above: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every key at every depth."""
    found = []
    for key, value in config.items():
        found.append((*above, key))
        if isinstance(value, dict):
            found += keys_of(value, (*above, key))
    return found


def changed(config: dict, key: tuple[str, ...], value: object) -> dict:
    copied = copy.deepcopy(config)
    place = copied
    for part in key[:-1]:
        place = place[part]
    place[key[-1]] = value
    return copied


NO_ARGUMENTS = [f"~loss.{key}" for key in ("gamma", "double", "loss_function", "stop_at")]
"""Takes what `double_dqn` sets away from `loss`."""


def _once(scenario: object, known: dict[str, object]) -> None:
    """``parse_config`` of a scenario that has not been checked before: most changes leave it as it is."""
    written = repr(scenario)
    if written not in known:
        known[written] = parse_config(scenario)


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_any_value_of_any_key_is_taken_or_refused_in_one_line(name, monkeypatch):
    known: dict[str, object] = {}
    monkeypatch.setattr(kinds, "parse_config", lambda scenario: _once(scenario, known))
    config = config_of(name)
    read_settings(config, RECIPES[name])
    for key in [key for key in keys_of(config) if key[0] != "scenario"]:  # its own tests have those
        refused = 0
        for value in BAD:
            try:
                read_settings(changed(config, key, value), RECIPES[name])
            except ScenarioError as error:
                refused += 1
                assert "\n" not in str(error) and ": " in str(error), (key, value)
        assert refused, f"{'.'.join(key)} takes everything"


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("dqn", ["seed=-1"], "seed: -1 where an integer from 0 to 4,294,967,295 was expected"),
        ("dqn", ["seed=4294967296"], "seed: 4294967296 where"),
        ("dqn", ["logger.interval=0"], "logger.interval: 0 where an integer from 1"),
        ("dqn", ["collector.num_envs=4.0"], "collector.num_envs: 4.0 where an integer"),
        ("dqn", ["collector.total_frames=10k"], "collector.total_frames: '10k' where an integer"),
        ("dqn", ["learner.lr=-1"], "learner.lr: -1 where a finite number above 0"),
        ("dqn", ["loss.gamma=5"], "loss.gamma: 5 where a finite number from 0 to 1"),
        ("dqn", ["network.hidden=64"], "network.hidden: 64 where a list"),
        ("dqn", ["network.hidden=[-1]"], r"network.hidden\[0\]: -1 where"),
        ("dqn", ["exploration.over=0"], "exploration.over: 0 where"),
        ("dqn", ["eval.seeds=[a]"], r"eval.seeds: \['a'\] where a number of seeds"),
        ("dqn", ["+buffer.samplr=x"], "buffer.samplr: unknown key; did you mean 'sampler'"),
        ("dqn", ["+loss.gama=1"], "loss.gama: unknown key; did you mean 'gamma'"),
        ("dqn", ["loss._target_=nfv_torchrl.losses.Nope"], "loss._target_: 'nfv_torchrl.losses.Nope' cannot be import"),
        ("dqn", ["loss._target_=os.sep"], "loss._target_: 'os.sep' is no class or function"),
        ("dqn", ["target.value_network_update_interval=0"], "target.value_network_update_interval: 0 where"),
        ("dqn", ["buffer.batch_size=9", "buffer.size=8"], "buffer.batch_size: 9 is more"),
        ("dqn", ["buffer.batch_size=8", "buffer.size=63"], "buffer.size: 63 where each batch brings at least 64 rows"),
        ("dqn", ["loss._target_=torch.nn.Flatten", *NO_ARGUMENTS], "'torch.nn.Flatten' has no method 'prepare'"),
        ("dqn", ["stagger=false"], "segment: 20 slots need staggered environments"),
        ("dqn", ["preset=recurrent", "loss.burn_in=32"], "loss.burn_in: 32 steps"),
        ("evolution", ["strategy.population=1"], "strategy.population: 1 where"),
        ("evaluate", ["method.greedy.planner.paths=0"], "method.greedy.planner.paths: 0 where an integer from 1"),
        ("evaluate", ["method=checkpoint"], "checkpoint: is null; method=checkpoint needs a file"),
        ("evaluate", ["method=nfvdeep"], "method.nfvdeep.path: is missing; set it"),
        ("evaluate", ["output=${nowhere}"], "output: Interpolation key 'nowhere' not found"),
        ("milp_gap", ["seeds=0"], "seeds: 0 where"),
    ],
)
def test_refusals(name, overrides, message):
    given = with_preset(overrides) if name == "dqn" else overrides
    with pytest.raises(ScenarioError, match=message):
        check_recipe(name, given, RECIPE_FILES)


def test_every_preset_passes():
    for preset in (RECIPE_FILES / "config" / "preset").glob("*.yaml"):
        check_recipe("dqn", [f"preset={preset.stem}"], RECIPE_FILES)
    check_recipe("dqn", ["preset=mlp", "networks=random", "network=candidate", "eval.seeds=2"], RECIPE_FILES)


def test_seeds_are_a_number_or_a_list():
    assert list_of_seeds("seeds", 3) == [0, 1, 2] and list_of_seeds("seeds", [5, 1]) == [5, 1]
    for wrong in (0, -1, True, MOST_SEEDS + 1, [], [1, 1], [-1], "2", None, 2.0):
        with pytest.raises(ScenarioError, match="seeds: "):
            list_of_seeds("seeds", wrong)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["learner.lrr=1"], "learner.lrr: unknown key; did you mean 'lr'?"),
        (["network=candidate", "network.hiden=1"], "network.hiden: unknown key; did you mean 'hidden'?"),
        (["netwrok=mlp"], "netwrok: unknown key; did you mean 'network'?"),
        (["checkpoint.keep=1"], "checkpoint: was renamed to saving; use that"),
        (["network=candidat"], "network: there is no 'candidat'; did you mean 'candidate'?"),
        (["network=null"], "network: null where the name of a config was expected"),
        (["run_dir=~"], "run_dir: ~ cannot be read; "),
        (["seed"], "Error parsing override 'seed'"),
    ],
)
def test_hydra_names_the_nearest_key(arguments, message):
    with initialize_config_dir(str(RECIPE_FILES / "config"), version_base=None), pytest.raises(Exception) as raised:
        compose("dqn", ["preset=mlp", *arguments])
    line = explain(raised.value, RECIPE_FILES, "dqn", arguments)
    assert line.startswith(message) and "\n" not in line


def test_what_the_machine_does_not_grant_is_one_line_and_a_bug_is_not():
    full = OSError(28, "No space left on device", "/runs/best.pt")
    assert expected(full) == "/runs/best.pt: No space left on device; make room there; what was written before is whole"
    assert "memory" in expected(MemoryError("Unable to allocate 7 GiB"))
    assert expected(ZeroDivisionError()) is None and expected(OSError("something else")) is None


def test_letters_a_terminal_does_not_have_are_replaced(monkeypatch):
    bytes_out = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(bytes_out, encoding="ascii"))
    plain_output()
    print("0.5 ± 0.1, λ – 漢")
    sys.stdout.flush()
    assert bytes_out.getvalue() == b"0.5 +- 0.1, lambda - ?\n"


def test_a_recipe_prints_one_line_and_exits_with_2():
    command = [sys.executable, str(RECIPE_FILES / "tune_priced.py"), "sedes=3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: sedes: unknown key; did you mean 'seeds'?")
    assert len(done.stderr.splitlines()) == 1
