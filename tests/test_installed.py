"""The package as a stranger gets it: a wheel in a virtual environment of its own, used outside the clone."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("nfv_torchrl", "recipes", "pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE")
USER_SCRIPT = """
from nfv_torchrl import NFVEnv, Scenario, paper_scenario

scenario: Scenario = paper_scenario(nodes=10)
actions: str = NFVEnv(scenario, 4).num_actions
"""
MYPY = """
[mypy]
[mypy-torch.*,torchrl.*,tensordict.*,numpy.*,numba.*,scipy.*,networkx.*,matplotlib.*,joblib.*,hydra.*,omegaconf.*]
follow_imports = skip
"""
"""Types of other packages are not what is tried, and reading them would take most of the time."""


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder with ``env``, where the wheel is installed; dependencies are those of this interpreter."""
    folder = tmp_path_factory.mktemp("home")
    source = folder / "source"
    source.mkdir()
    for part in PARTS:  # a copy, since building writes into the tree
        place, target = ROOT / part, source / part
        if place.is_dir():
            shutil.copytree(place, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(place, target)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = [*pip, "wheel", str(source), "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run(build, check=True, timeout=300)
    venv.create(folder / "env", with_pip=False)
    packages = next((folder / "env").glob("lib/python*/site-packages"))
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    wheel = next(folder.glob("*.whl"))
    install = ["--python", str(folder / "env" / "bin" / "python"), "install", "--no-deps", "--ignore-installed"]
    subprocess.run([*pip, *install, str(wheel)], check=True, timeout=300)
    shutil.rmtree(source)
    return folder


def call(home: Path, command: str, *arguments: str) -> str:
    """What a command of the environment prints. Compiling everything anew would take most of the time."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"NUMBA_DISABLE_JIT": "1"}
    line = [str(home / "env" / "bin" / command), *arguments]
    done = subprocess.run(line, cwd=home, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_package_is_the_installed_one(home):
    assert str(home) in call(home, "python", "-c", "import nfv_torchrl; print(nfv_torchrl.__file__)")


def test_recipes_are_listed_and_run(home):
    assert "dqn " in call(home, "nfv-torchrl", "list")
    printed = call(home, "nfv-torchrl", "run", "evaluate", "scenario.horizon=5", "seeds=1", "method=[greedy]")
    assert "greedy" in printed


def test_a_copied_recipe_runs_with_the_configs_of_the_package(home):
    call(home, "nfv-torchrl", "copy", "evaluate", "mine.py")
    begin = "def main(cfg: DictConfig) -> None:\n"
    text = (home / "mine.py").read_text()
    (home / "mine.py").write_text(text.replace(begin, f"{begin}    print('mine')\n"))
    printed = call(home, "python", "mine.py", "scenario.horizon=5", "seeds=1", "method=[greedy]")
    assert "mine" in printed and "greedy" in printed


def test_types_of_the_package_reach_a_users_script(home):
    script = home / "user.py"
    script.write_text(USER_SCRIPT)
    python = str(home / "env" / "bin" / "python")
    (home / "mypy.ini").write_text(MYPY)
    options = ["--python-executable", python, "--cache-dir", str(home / "mypy"), "--config-file", "mypy.ini"]
    command = [sys.executable, "-m", "mypy", *options, str(script)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True, timeout=300)
    assert '"int"' in done.stdout and '"str"' in done.stdout and "Found 1 error" in done.stdout, done.stdout
