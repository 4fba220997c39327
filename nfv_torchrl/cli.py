"""The command ``nfv-torchrl``: lists, runs and copies recipes, in a clone or from a wheel; reads network files."""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import write_atomically

PACKAGE = Path(__file__).parent
NETWORK_COMMANDS = {
    "show": "what a network file holds, and a picture: nfv-torchrl show my_network.gml --output my_network.png",
    "convert": "a network file as JSON, its demands as CSV: nfv-torchrl convert my_network.gml my_network.json",
    "scan": "which of many network files can be read: nfv-torchrl scan my_folder topohub:sndlib",
}
SCORE = "score decisions of any program on a benchmark: nfv-torchrl score decisions.jsonl --manifest M.json --run NAME"


def recipes_folder() -> Path:
    """Where the recipes and their ``config`` are: inside an installed package, beside the package in a clone.

    Raises:
        ScenarioError: in neither place.
    """
    for folder in (PACKAGE / "recipes", PACKAGE.parent / "recipes"):
        if (folder / "config").is_dir():
            return folder
    raise ScenarioError(f"{PACKAGE}: the recipes are missing here; install the package again")


def find_recipe(name: str) -> Path:
    """The file of recipe ``name``, such as ``dqn``; the ending ``.py`` may be there.

    Raises:
        ScenarioError: no such recipe.
    """
    names = recipe_names()
    stem = name.removesuffix(".py")
    if stem not in names:
        raise ScenarioError(f"recipe {name!r}: there is none of that name; there are {', '.join(names)}")
    return recipes_folder() / f"{stem}.py"


def recipe_names() -> list[str]:
    """Names of all recipes."""
    return sorted(path.stem for path in recipes_folder().glob("*.py") if not path.stem.startswith("_"))


def list_recipes() -> None:
    """Print every recipe with the first line of its docstring."""
    for name in recipe_names():
        text = ast.get_docstring(ast.parse(find_recipe(name).read_text(encoding="utf-8"))) or ""
        print(f"{name:<16} {text.splitlines()[0] if text else ''}")


def run_recipe(name: str, arguments: Sequence[str]) -> None:
    """Become a Python process that runs the recipe, so that signals and exit codes are the recipe's own."""
    os.execv(sys.executable, [sys.executable, str(find_recipe(name)), *arguments])


def copy_recipe(name: str, target: Path) -> None:
    """Copy a recipe to change it, or with the name ``config`` the folder of all configs.

    The copy of a recipe goes on reading the configs that came with the package; ``--config-dir`` adds those of a user.

    Raises:
        ScenarioError: no such recipe, or ``target`` exists.
    """
    if target.exists():
        raise ScenarioError(f"{target}: exists already; choose another name or remove it first")
    if name == "config":
        shutil.copytree(recipes_folder() / "config", target, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        write_atomically(target, find_recipe(name).read_text(encoding="utf-8"))
    print(f"{target} is yours to change.")


def use_network_files(command: str, arguments: Sequence[str]) -> None:
    """Become a Python process that shows, converts or scans network files."""
    os.execv(sys.executable, [sys.executable, "-m", "nfv_torchrl.evaluation.network_files", command, *arguments])


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="nfv-torchrl", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="the recipes and what they do")
    run = commands.add_parser("run", help="run a recipe: nfv-torchrl run dqn scenario=geant", add_help=False)
    run.add_argument("recipe")
    run.add_argument("overrides", nargs=argparse.REMAINDER, help="passed on to the recipe, --help too")
    copy = commands.add_parser("copy", help="copy a recipe to change it: nfv-torchrl copy dqn my_dqn.py")
    copy.add_argument("recipe", help="name of a recipe, or config for the folder of all configs")
    copy.add_argument("target", type=Path)
    for command, help in NETWORK_COMMANDS.items():
        networks = commands.add_parser(command, help=help, add_help=False)
        networks.add_argument("arguments", nargs=argparse.REMAINDER)
    commands.add_parser("score", help=SCORE, add_help=False).add_argument("arguments", nargs=argparse.REMAINDER)
    given = parser.parse_args(arguments)
    try:
        if given.command == "score":
            os.execv(sys.executable, [sys.executable, "-m", "nfv_torchrl.evaluation.score", *given.arguments])
        if given.command in NETWORK_COMMANDS:
            use_network_files(given.command, given.arguments)
        elif given.command == "list":
            list_recipes()
        elif given.command == "run":
            run_recipe(given.recipe, given.overrides)
        else:
            copy_recipe(given.recipe, given.target)
    except (ScenarioError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
