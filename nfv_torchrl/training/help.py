"""What ``--help`` of a recipe prints: its own keys, with their values and what they mean, in one screen."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from hydra import compose
from omegaconf import DictConfig, OmegaConf

WIDTH = 120
HEAD_WIDTH = 16
VALUE_WIDTH = 36
ELSEWHERE = ("scenario", "method")
"""Sections too long for this page; the docs list their keys."""


def help_text(name: str, config: Path) -> str:
    """The help page of recipe ``name``; Hydra's search path has to lead to its configs (``recipe_configs``).

    Args:
        name: the recipe, such as ``dqn``.
        config: the folder with its yaml and the groups.

    Returns:
        What it does, examples, the groups with their options, and its keys, each on a line of at most 120 characters.
        ``*`` marks the default of a group. Settings within a group are not listed one by one.
    """
    text = (config / f"{name}.yaml").read_text(encoding="utf-8")
    about, examples = _header(text)
    groups = _groups(text, config)
    return "\n".join(
        [
            textwrap.fill(about, WIDTH),
            "",
            *examples,
            "",
            "Groups (GROUP=OPTION; * is the default, config/GROUP/OPTION.yaml has the settings of each):",
            *(_wrapped(group, options) for group, options in groups.items()),
            "",
            "Keys (KEY=VALUE, SECTION.KEY=VALUE; scenario.* is in docs/data.md):",
            *_keys(compose(name), _comments(text), groups),
            "",
            "All settings as they would be used: --cfg job. Several runs: -m KEY=A,B. More: docs/runs.md",
        ]
    )


def _header(text: str) -> tuple[str, list[str]]:
    """The first comment: a sentence, and lines indented in it, which are examples."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("#").removeprefix(" "))
    examples = [line[:WIDTH] for line in lines if line.startswith("  ")]
    return " ".join(line for line in lines if not line.startswith("  ")), examples


def _groups(text: str, config: Path) -> dict[str, list[str]]:
    """Options of every group in the defaults of the recipe and of those defaults, the chosen ones with a ``*``.

    A preset's choices take the place of the recipe's own.
    """
    groups: dict[str, list[str]] = {}
    waiting = [text]
    while waiting:
        content = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.create(waiting.pop(0))))
        for group, chosen, overrides in _choices(content.get("defaults", [])):
            folder = config / group
            if not folder.is_dir() or (group in groups and not overrides):
                continue
            names = sorted(path.stem for path in folder.glob("*.yaml") if not path.stem.startswith("_"))
            groups[group] = [f"{name}*" if name in chosen else name for name in names]
            waiting += [(folder / f"{name}.yaml").read_text(encoding="utf-8") for name in chosen if name in names]
    return groups


def _choices(defaults: list[Any]) -> Iterator[tuple[str, list[str], bool]]:
    """Of each entry of a list of defaults: the group, what is chosen, and whether in place of an earlier choice."""
    for entry in defaults:
        for group, chosen in entry.items() if isinstance(entry, Mapping) else ():
            if "hydra" not in group:
                plain = group.removeprefix("optional ").removeprefix("override ").lstrip("/").split("@")[0]
                yield plain, [chosen] if isinstance(chosen, str) else list(chosen or ()), "override " in group


def _comments(text: str) -> dict[str, str]:
    """What the recipe's own yaml says behind a key of the first level."""
    found = (re.match(r"(\w+):.*?\s#\s*(.*)", line) for line in text.splitlines())
    return {match[1]: match[2] for match in found if match}


def _keys(config: DictConfig, comments: Mapping[str, str], groups: Collection[str]) -> Iterator[str]:
    for key, value in cast(dict[str, Any], OmegaConf.to_container(config, resolve=False)).items():
        if key in groups and not isinstance(value, Mapping):
            continue  # nothing was chosen there
        if not isinstance(value, Mapping):
            line = f"  {f'{key} = {_plain(value)}':<{VALUE_WIDTH}} {comments.get(key, '')}".rstrip()
            yield textwrap.fill(line, WIDTH, subsequent_indent=" " * (VALUE_WIDTH + 3))
        elif key not in ELSEWHERE and (parts := _parts(value)):
            yield _wrapped(key, parts)


def _parts(section: Mapping[str, Any]) -> list[str]:
    """``name=value`` of what is short, the name alone of the rest; ``_target_`` is no setting but a choice."""
    named = {key: value for key, value in section.items() if not key.startswith("_")}
    told = {key: "" if isinstance(value, Mapping) else f"={_plain(value)}" for key, value in named.items()}
    return [f"{key}{value if len(value) <= VALUE_WIDTH else ''}" for key, value in told.items()]


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(_plain, value))}]"
    if isinstance(value, Mapping):
        return "{...}"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _wrapped(head: str, words: list[str]) -> str:
    """Words behind a head, in as many lines as they need."""
    first = f"  {head:<{HEAD_WIDTH}} "
    # Spaces within a value must not break it over two lines.
    line = " ".join(word.replace(" ", "\0") for word in words)
    filled = textwrap.fill(
        line, WIDTH, initial_indent=first, subsequent_indent=" " * len(first), break_on_hyphens=False
    )
    return filled.replace("\0", " ")
