"""What imports what, and what stands in one place only, read from the source."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "nfv_torchrl"
BASE = {"codec", "columns", "errors"}
MAY_IMPORT = {
    "codec": set(),
    "columns": set(),
    "simulator": BASE | {"scenario"},
    "search": BASE | {"scenario", "simulator"},
    "bounds": BASE | {"scenario", "simulator", "search"},
    "planners": BASE | {"scenario", "settings", "simulator", "search"},
}


def modules(room: str) -> list[Path]:
    return sorted((PACKAGE / room).rglob("*.py")) or [PACKAGE / f"{room}.py"]


def imported(path: Path) -> set[str]:
    """Rooms of this package that a module imports from."""
    nodes = ast.walk(ast.parse(path.read_text()))
    names = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[1] for name in names if name.startswith("nfv_torchrl.")}


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_from_lower_floors_only(room):
    for path in modules(room):
        assert imported(path) <= MAY_IMPORT[room] | {room}, path.name


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
