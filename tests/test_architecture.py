"""What imports what, and what stands in one place only, read from the source and compared with docs/design.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "nfv_torchrl"
PAGE = (ROOT / "docs" / "design.md").read_text()
ROOMS = re.findall(r"^\| `([\w/.]+)` \|", PAGE, re.MULTILINE)
"""The rooms of the table, those that may be imported from first."""


def modules(room: str) -> list[Path]:
    """The modules of a room, without those that have a row of their own."""
    paths = sorted((PACKAGE / room).rglob("*.py")) if room.endswith("/") else [PACKAGE / room]
    return [path for path in paths if room_of(path) == room]


def room_of(path: Path) -> str:
    """A file's own row, if it has one, else that of its folder."""
    name = str(path.relative_to(PACKAGE))
    return name if name in ROOMS else f"{name.split('/')[0]}/"


def file_of(module: str) -> Path:
    """The file of a module by its dotted name."""
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def imported(path: Path) -> set[str]:
    """Dotted names of the modules of this package that a module imports, at its top or in a function."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            submodules = {name for name in inside if name.startswith("nfv_torchrl.") and file_of(name).exists()}
            found |= submodules or {node.module or ""}
    return {name for name in found if name.startswith("nfv_torchrl.")}


def test_every_module_has_a_row_and_every_row_a_module():
    there = {room_of(path) for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"}
    assert there == set(ROOMS) and len(ROOMS) == len(set(ROOMS))


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_from_rooms_above_it(room):
    allowed = ROOMS[: ROOMS.index(room) + 1]
    for path in modules(room):
        wrong = {name for name in imported(path) if room_of(file_of(name)) not in allowed}
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_training_knows_of_evaluation_what_the_page_says():
    (sentence,) = re.findall(r"^Of `evaluation/`, `training/` uses (.*)\. It uses nothing of `evolution/`", PAGE, re.M)
    named = {f"nfv_torchrl.evaluation.{name}" for name in re.findall(r"`(\w+)`", sentence)}
    used = {name for path in modules("training/") for name in imported(path)}
    assert {name for name in used if name.startswith("nfv_torchrl.evaluation")} == named


def test_nothing_is_hidden_from_modules_by_their_dict():
    """A loss has ``act_by`` and ``adopt`` for that."""
    assert not [path for path in PACKAGE.rglob("*.py") if "__dict__[" in path.read_text()]


@pytest.mark.parametrize("room", ["search", "planners"])
def test_no_function_takes_more_than_six_arguments(room):
    for path in modules(room):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                arguments = [each.arg for each in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                assert len([name for name in arguments if name != "self"]) <= 6, f"{path.name}: {node.name}"


@pytest.mark.parametrize(
    ("pattern", "home"),
    [
        (r"action % 2|// 2 %|2 \* \(node", "codec.py"),  # the code of an action
        (r"(?<![*] )nodes \* vms\b|\bnode \* vms\b|// vms\b", "codec.py"),  # the number of a resource
        (r"1000\.0 ", "steps.py"),  # delays
        (r"(unit_cost|_price)\[[^\]]*\] \* (?!np)", "steps.py"),  # costs
    ],
)
def test_arithmetic_of_the_model_stands_once(pattern, home):
    """The audit keeps its own on purpose."""
    there = [path for path in PACKAGE.rglob("*.py") if re.search(pattern, path.read_text())]
    assert {path.name for path in there if "audit" not in path.parts} <= {home}
