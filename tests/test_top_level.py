"""What ``from nfv_torchrl import ...`` offers, and the command line beside it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import nfv_torchrl
from nfv_torchrl import cli


def test_every_name_is_there_and_declared_alike_for_type_checkers():
    tree = ast.parse(Path(nfv_torchrl.__file__).read_text())
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    declared = {alias.name: node.module for node in typed.body for alias in node.names}
    assert {name: f"nfv_torchrl.{home}" for name, home in nfv_torchrl._HOMES.items()} == declared
    assert sorted(declared) == sorted(nfv_torchrl.__all__)
    for name in nfv_torchrl.__all__:
        assert getattr(nfv_torchrl, name).__name__ == name


def test_a_name_that_is_not_there():
    with pytest.raises(ImportError):
        from nfv_torchrl import Nothing  # noqa: F401


def test_importing_the_package_alone_loads_no_torch():
    code = "import sys, nfv_torchrl; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_recipes_are_found_and_described(capsys):
    cli.main(["list"])
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == cli.recipe_names()
    assert all(len(line.split()) > 3 for line in printed)


@pytest.mark.parametrize("arguments", [["run", "dqm"], ["copy", "dqm", "x.py"], ["copy", "../dqn", "x.py"]])
def test_a_recipe_that_is_not_there_is_named(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert arguments[1] in said and "dqn" in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_copy_never_replaces_a_file(tmp_path, capsys):
    mine = tmp_path / "mine.py"
    mine.write_text("x = 1\n")
    with pytest.raises(SystemExit):
        cli.main(["copy", "dqn", str(mine)])
    assert mine.read_text() == "x = 1\n" and "exists already" in capsys.readouterr().err


def test_configs_are_copied_whole(tmp_path):
    cli.main(["copy", "config", str(tmp_path / "conf")])
    there = {path.relative_to(tmp_path / "conf") for path in (tmp_path / "conf").rglob("*.yaml")}
    config = cli.recipes_folder() / "config"
    assert there == {path.relative_to(config) for path in config.rglob("*.yaml")} and there
