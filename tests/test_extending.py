"""The examples of docs/extending.md, run as they are printed: their files, then their commands at tiny size."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from inprocess import recipe
from tiny import ROOT, TINY_SCENARIO, TINY_TRAINING

PAGE = (ROOT / "docs" / "extending.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
COMMANDS = [text.strip() for kind, text in BLOCKS if kind == "bash"]
# What makes a command quick; the last of two overrides of the same key counts.
TINY = {
    "dqn": [*TINY_SCENARIO, *TINY_TRAINING, "collector.total_frames=96", "eval.interval=3"],
    "evaluate": [*TINY_SCENARIO, "seeds=1", "output=null"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files of the page, importable; the working folder while its tests run."""
    here = tmp_path_factory.mktemp("extending")
    for kind, text in BLOCKS:
        if kind in ("python", "yaml"):
            path = here / text.splitlines()[0].removeprefix("# ")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    (here / "my_pkg" / "__init__.py").write_text("")
    before = Path.cwd()
    os.chdir(here)
    sys.path.insert(0, str(here))
    yield here
    os.chdir(before)
    sys.path.remove(str(here))
    for name in [name for name in sys.modules if name.split(".")[0] == "my_pkg"]:
        del sys.modules[name]


def test_the_page_has_all_its_examples(folder):
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert {f"my_pkg/{name}.py" for name in ("losses", "networks", "rewards", "planners", "topologies")} <= files
    assert len(COMMANDS) == 7


def test_the_checks_that_are_printed_pass(folder):
    checks = [
        check
        for path in sorted((folder / "tests").glob("test_*.py"))
        for name, check in runpy.run_path(str(path)).items()
        if name.startswith("test_")
    ]
    assert len(checks) >= 3
    for check in checks:
        check()


@pytest.mark.parametrize("command", COMMANDS)
def test_command(folder, command, capsys):
    """In this process, which saves the imports; the test below is a process of its own."""
    _, script, *arguments = shlex.split(command)
    name = Path(script).stem
    if "--config-dir" in arguments:
        place = arguments.index("--config-dir")
        arguments[place : place + 2] = [f"hydra.searchpath=[file://{folder / arguments[place + 1]}]"]
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = compose(name, overrides=[*arguments, *(text for text in TINY[name] if fits(text, arguments))])
    recipe(name).main(config)
    printed = capsys.readouterr().out
    if name == "dqn":
        assert (Path(config.run_dir) / "best.pt").exists() and "best.pt" in printed
    else:
        assert "Audit" in printed and "nothing found" in printed


def fits(override: str, arguments: list[str]) -> bool:
    """The ring brings its own number of nodes."""
    return not ("scenario=ring" in arguments and override.startswith("scenario.substrate.nodes"))


def test_a_loss_of_another_package_trains_in_a_process_of_its_own(folder):
    script, *arguments = shlex.split(COMMANDS[0])[1:]
    command = [sys.executable, str(ROOT / script), *arguments, *TINY["dqn"], "run_dir=runs/apart"]
    # The package under test comes first, whatever is installed.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), "."])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (folder / "runs" / "apart" / "best.pt").exists()


def test_the_soft_maximum_is_over_valid_actions(folder):
    """Two valid actions of values 0.6 and 0.2 at temperature 0.5: 0.5 log(e^1.2 + e^0.4)."""
    sys.path.insert(0, str(ROOT / "tests" / "losses"))
    from my_pkg.losses import SoftDQN
    from two_states import SIZES, table_network, transition

    table = [[0.5, 0.25, 7.0, 9.0], [0.6, 50.0, 0.2, 90.0]]
    loss = SoftDQN(table_network(table), SIZES, temperature=0.5)
    values = loss(transition(action=1, mask=[1, 1, 0, 0], reward=0.5, next_mask=[1, 0, 1, 0], done=False))
    soft = 0.5 * torch.tensor([1.2, 0.4]).exp().sum().log()
    assert values["target"].item() == pytest.approx(0.5 + soft.item())
    assert values["loss"].item() == pytest.approx((0.5 + soft.item() - 0.25) ** 2)
