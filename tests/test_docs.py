"""The documentation builds without a warning, leaves out no part of the package, and prints what works."""

from __future__ import annotations

import os
import pkgutil
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from string import Template

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

import nfv_torchrl
from nfv_torchrl.cli import recipe_names
from nfv_torchrl.folders import claim
from nfv_torchrl.settings.recipes import RECIPES, check_recipe

ROOT = Path(__file__).parents[1]
NOT_FOR_USERS = {
    "archive", "cli", "files", "folders", "inputs", "locks", "state_checks", "tensor_checks", "tensor_files"
}  # fmt: skip
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "runs" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
COMMAND = re.compile(
    r"^\s*(?:(?:\.venv/bin/)?python recipes/(?P<file>\w+)\.py|nfv-torchrl run (?P<name>\w+))(?P<rest>.*)$"
)
VARIABLE = re.compile(r"^(?P<name>[A-Z]+)=(?P<value>[\"'].*)$")


def pages_with_links() -> Iterator[tuple[Path, str]]:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if not target.startswith(("http://", "https://", "mailto:")):
                yield page, target


def anchors(page: Path) -> set[str]:
    """What a link to a heading of ``page`` may say after the ``#``."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def printed_lines(page: Path) -> list[str]:
    """The lines of a page's code blocks, continued lines joined."""
    blocks = re.findall(r"^ *```\w*\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]


def printed_commands(page: Path) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Recipe and arguments of every command that a page prints; shell variables that it sets are filled in."""
    variables: dict[str, str] = {}
    for line in printed_lines(page):
        if found := VARIABLE.match(line):
            variables[found["name"]] = shlex.split(Template(found["value"]).safe_substitute(variables), comments=True)[
                0
            ]
        elif found := COMMAND.match(line):
            rest = Template(found["rest"]).safe_substitute(variables)
            yield found["file"] or found["name"], tuple(shlex.split(rest, comments=True))


ALL_COMMANDS = sorted({command for page in PAGES for command in printed_commands(page)})


def can_be_composed(name: str, arguments: tuple[str, ...]) -> bool:
    """Whether a command is Hydra's, without placeholders and without a config folder that only a reader has."""
    return name in RECIPES and "--config-dir" not in arguments and not re.search(r"\$|\.\.\.", " ".join(arguments))


def one_of_the_sweep(arguments: tuple[str, ...]) -> list[str]:
    """The overrides of the first run that ``-m`` starts."""
    if "-m" not in arguments:
        return list(arguments)
    overrides = [argument for argument in arguments if argument != "-m" and not argument.startswith("hydra/")]
    return [re.sub(r"^([^=]+=[^,\[{]*),.*$", r"\1", override) for override in overrides]


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stdout + done.stderr
    losses = (tmp_path / "site" / "api" / "losses.html").read_text()
    assert "nfv_torchrl.losses.dqn.DQN" in losses
    assert r'class="arithmatex">\[' in losses and ".. math" not in losses  # formulas are shown as formulas


def test_every_room_has_its_page_in_the_reference():
    written = "".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    rooms = {module.name for module in pkgutil.iter_modules(nfv_torchrl.__path__)} - NOT_FOR_USERS
    assert not {room for room in rooms if f"::: nfv_torchrl.{room}\n" not in written}


def test_links_lead_somewhere():
    lost = []
    for page, target in pages_with_links():
        file, _, anchor = target.partition("#")
        other = (page.parent / file).resolve() if file else page
        if not other.exists() or (anchor and anchor not in anchors(other)):
            lost.append(f"{page.relative_to(ROOT)}: {target}")
    assert not lost


def test_recipes_that_are_named_exist():
    assert {name for name, _ in ALL_COMMANDS} <= set(recipe_names())
    named = {name for page in PAGES for name in re.findall(r"recipes/([a-z_]+)\.py", page.read_text())}
    assert named <= set(recipe_names())


def test_files_that_are_named_exist():
    lost = []
    for page in PAGES:
        text = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        named = re.findall(r"`((?:nfv_torchrl|tests|recipes|docs)/[a-z0-9_/.]+)`", text)
        lost += [f"{page.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).exists()]
    assert not lost


def test_imports_that_are_printed_work():
    for page in PAGES:
        for line in printed_lines(page):
            if re.match(r"from nfv_torchrl[\w.]* import [\w, ]+$", line):
                exec(line, {})  # as a reader would


@pytest.mark.parametrize(
    "recipe", sorted({name for name, arguments in ALL_COMMANDS if can_be_composed(name, arguments)})
)
def test_commands_that_are_printed_would_start(recipe):
    for name, arguments in ALL_COMMANDS:
        if name == recipe and can_be_composed(name, arguments):
            check_recipe(name, one_of_the_sweep(arguments), ROOT / "recipes")


def overrides_in_recipes() -> Iterator[tuple[str, str]]:
    """Each override of the commands in the heads of recipes and of their configs, and the file that prints it."""
    for path in sorted((ROOT / "recipes").rglob("*.py")) + sorted((ROOT / "recipes").rglob("*.yaml")):
        for line in path.read_text().splitlines():
            if "python recipes/" in line:
                for quoted, plain in re.findall(r"\"([^\"\s]+=[^\"]*)\"|(?<=\s)([+~]*[\w.@/]+=\S+)", line):
                    yield str(path.relative_to(ROOT)), quoted or plain


def test_overrides_that_recipes_print_are_ones_that_hydra_reads():
    parser, unread, printed = OverridesParser.create(), [], list(overrides_in_recipes())
    assert len({file for file, _ in printed}) > 10  # else the search for them is what is broken
    for file, override in printed:
        try:
            parser.parse_override(override)
        except OverrideParseException:
            unread.append(f"{file}: {override}")
    assert not unread


def test_make_train_sets_up_trains_and_evaluates_in_folders_of_their_own(tmp_path, monkeypatch):
    for name in ("ARGS", "MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES"):  # those of a make that runs the tests
        monkeypatch.delenv(name, raising=False)
    done = subprocess.run(["make", "-nB", "train"], cwd=ROOT, capture_output=True, text=True, check=True)
    lines = done.stdout.replace("\\\n", " ").splitlines()
    assert [line for line in lines if re.search(r"-m pip install [^|]*-c constraints.txt -e '\.\[dev\]'$", line)]
    commands = {found["file"]: shlex.split(found["rest"]) for line in lines if (found := COMMAND.match(line))}
    for name, arguments in commands.items():
        check_recipe(name, arguments, ROOT / "recipes")
    folders = {name: dict(text.split("=", 1) for text in arguments) for name, arguments in commands.items()}
    monkeypatch.chdir(tmp_path)
    claim("run_dir", Path(folders["dqn"]["run_dir"]), "run").release()
    claim("output", Path(folders["evaluate"]["output"]), "evaluation").release()
