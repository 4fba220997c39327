"""What Hydra says of a command line it cannot use, in one line that names the nearest key."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import join, refuse_key


def explain(error: BaseException, recipes: Path, name: str, arguments: Sequence[str]) -> str:
    """One line about an error that Hydra raised while it composed the config ``name``.

    Args:
        error: what it raised.
        recipes: the folder with ``config``.
        name: the recipe.
        arguments: of the command line.
    """
    if isinstance(error, MissingConfigException) and error.options:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        return _no_option(group, option, error.options)
    unknown = re.search(r"Could not override '([^']+)'", str(error))
    if unknown:
        try:
            _refuse(unknown[1], _config(recipes, name, arguments))
        except ScenarioError as refusal:
            return str(refusal)
    missing = re.search(r"Could not load '([^']+)/([^'/]*)'", str(error))
    if missing:
        options = sorted(path.stem for path in (recipes / "config" / missing[1]).glob("*.yaml"))
        return _no_option(missing[1], missing[2], options)
    groups = "|".join(folder.name for folder in (recipes / "config").iterdir() if folder.is_dir())
    empty = next((given for given in arguments if re.fullmatch(rf"({groups})=(null|\[.*\bnull\b.*\])", given)), None)
    if empty is not None and (isinstance(error, TypeError) or "Config group override" in str(error)):
        group, _, value = empty.partition("=")
        return f"{group}: {value} where the name of a config was expected, or a list of names; see {name}.py --help"
    text = " ".join(str(error).split()).split(" See https://hydra.cc")[0]
    unread = next((given for given in arguments if text.startswith(f"LexerNoViableAltException: {given}")), None)
    if unread is not None:
        key, _, value = unread.partition("=")
        return f"{key}: {value} cannot be read; write it in full, and in quotes, such as {key}=\"'a b'\""
    return f"{text or type(error).__name__}; see {name}.py --help"


def _refuse(key: str, config: Mapping[str, Any]) -> None:
    """Refuse the first part of a dotted key that the config does not have."""
    where, here = "", config
    for part in key.split("."):
        if not isinstance(here, Mapping):
            raise ScenarioError(f"{where}: is a value and has no key {part!r}; set the value itself")
        if part not in here:
            refuse_key(join(where, part), here)
        where, here = join(where, part), here[part]


def _config(recipes: Path, name: str, arguments: Sequence[str]) -> dict[str, Any]:
    """What the config would be with the groups that were chosen, and the names of all groups."""
    groups = {folder.name: None for folder in (recipes / "config").iterdir() if folder.is_dir()}
    chosen = [text for text in arguments if re.fullmatch(r"\w+=\w+", text) and text.split("=")[0] in groups]
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(recipes.resolve() / "config"), version_base=None):
        try:
            composed = compose(name, chosen)
        except HydraException:
            composed = compose(name)
    return {**dict.fromkeys(sorted(groups)), **OmegaConf.to_container(composed, resolve=False)}  # type: ignore[dict-item]


def _no_option(group: str, option: str, options: Sequence[str]) -> str:
    return f"{group}: there is no {option!r}; {_guess(option, options)}use one of {', '.join(options)}"


def _guess(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean {close[0]!r}? " if close else ""
