"""The help page of every recipe."""

import re
import sys
from pathlib import Path

import pytest

from nfv_torchrl.cli import recipe_names, recipes_folder
from nfv_torchrl.training.cli import recipe, recipe_configs
from nfv_torchrl.training.help import WIDTH, help_text

CONFIG = recipes_folder() / "config"
LINES_OF_A_SCREEN = 50
WITH_CONFIG = [name for name in recipe_names() if (CONFIG / f"{name}.yaml").is_file()]


@pytest.fixture(scope="module")
def pages():
    with recipe_configs(recipes_folder()):
        return {name: help_text(name, CONFIG) for name in WITH_CONFIG}


@pytest.mark.parametrize("name", WITH_CONFIG)
def test_it_fits_on_one_screen_and_names_every_key_of_its_own(pages, name):
    lines = pages[name].splitlines()
    assert len(lines) <= LINES_OF_A_SCREEN
    assert max(map(len, lines)) <= WIDTH
    own = set(re.findall(r"(?m)^(\w+):", (CONFIG / f"{name}.yaml").read_text())) - {
        "defaults",
        "hydra",
        "scenario",
        "method",
    }
    assert own <= {line.split()[0] for line in lines if line.startswith("  ")}


def test_groups_have_all_options_and_mark_the_default(pages):
    (line,) = (line for line in pages["dqn"].splitlines() if line.startswith("  buffer  ") and "uniform" in line)
    assert line.split() == ["buffer", "prioritized", "recent", "uniform*"]


def test_the_preset_chooses_in_place_of_the_recipe(pages):
    (line,) = (line for line in pages["dqn"].splitlines() if line.startswith("  network ") and "mlp" in line)
    assert "lookahead*" in line and "mlp*" not in line


def test_values_are_those_that_would_be_used(pages):
    assert "num_envs=64 steps=16 total_frames=200000" in pages["dqn"]  # of the default preset


def test_a_recipe_prints_it(monkeypatch, capsys):
    sys.path.insert(0, str(recipes_folder()))
    monkeypatch.setattr(sys, "argv", ["tune_priced.py", "--help"])
    try:
        import tune_priced
    finally:
        sys.path.remove(str(recipes_folder()))
    tune_priced.main()
    assert capsys.readouterr().out.splitlines()[0] == Path(CONFIG / "tune_priced.yaml").read_text().splitlines()[0][2:]


def test_a_bad_command_line_gets_its_line_after_a_good_one_in_the_same_process(monkeypatch, capsys):
    calls = []
    main = recipe("tune_priced")(lambda cfg: calls.append(cfg))
    monkeypatch.setattr(sys, "argv", ["tune_priced.py"])
    main()
    assert len(calls) == 1
    monkeypatch.setattr(sys, "argv", ["tune_priced.py", "nonsense=1"])
    with pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == 2 and len(calls) == 1
    assert capsys.readouterr().err.startswith("error: nonsense: unknown key")
