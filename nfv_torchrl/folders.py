"""Whose folder is it? A command writes to folders of its own kind and to new ones, never among a user's files."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.locks import LONGEST_NOTE, Lock, is_locked, read_note

MARKER = ".nfv_torchrl.lock"
"""The lock file of a folder, which stays and says what the folder is."""
RUN_FILES = ("scenario.json", "substrate.json", "workload.csv", "decisions.jsonl", "metrics.json")
"""Files of one method on one workload, see ``nfv_torchrl.evaluation.records.write_run``."""
KINDS = {
    "run": "a training run",
    "evaluation": "an evaluation",
    "cells": "an output folder of figures or comparisons",
    "dataset": "a recorded dataset",
}
_CELL = re.compile(r".+-[0-9a-f]{12}\.(json|npz|yaml)")
_TEMPORARY = re.compile(r"\.(?P<name>.+?)(\.\d+\.partial|\.\w{8}\.tmp|\.\d+\.old|\.partial\.npz)")


def check_place(key: str, value: Any) -> Path:
    """``value`` of the setting ``key`` as the folder it names, if a command may own such a folder at all.

    Raises:
        ScenarioError: it is no path, or names the working folder, one above it, or the home folder.
    """
    if isinstance(value, bool) or not isinstance(value, str | int | os.PathLike) or not str(value).strip():
        raise ScenarioError(f"{key}: {value!r} names no folder; give one, such as {key}=runs/mine")
    path = Path(str(value))
    if str(value).startswith("~"):
        raise ScenarioError(f"{key}: {value}: the shell replaces ~ only at the start of a word; write the path in full")
    try:
        place, here = path.resolve(), Path.cwd().resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ScenarioError(f"{key}: {value!r} is no path ({error}); give another") from error
    if place == here or place in here.parents or place in (Path(place.anchor), Path.home()):
        raise ScenarioError(
            f"{key}: {value} is the working folder, the home folder or one above; name a folder of its own, such as "
            f"{key}=runs/mine"
        )
    return path


def kind_of(folder: Path) -> str | None:
    """Which of ``KINDS`` a folder is: what its marker says, or what older versions left in it; None: none."""
    return _marked(folder) or next((kind for kind, is_one in _RECOGNISED.items() if is_one(folder)), None)


def refuse_foreign(key: str, path: Path, kind: str) -> None:
    """Refuse a folder that holds anything but ``kind``, or lies inside what a run owns.

    Raises:
        ScenarioError: so it is, or it cannot be read.
    """
    place = path.resolve()
    try:
        if place.exists() and not place.is_dir():
            raise ScenarioError(f"{key}: {path} is a file; name a folder")
        if contents(place) and (found := kind_of(place)) != kind:
            what = f"is {KINDS[found]}" if found else "holds files that are none of ours"
            raise ScenarioError(
                f"{key}: {path} {what}, not {KINDS[kind]}, and is left alone; name a new or an empty folder"
            )
        owner = next((above for above in place.parents if _owns_all_below(above)), None)
        ground = next(each for each in (place, *place.parents) if each.exists())
    except OSError as error:
        raise ScenarioError(f"{key}: {path} cannot be used ({error.strerror}); name another folder") from error
    if owner is not None:
        raise ScenarioError(f"{key}: {path} lies inside the run {owner}; name a folder outside it")
    if not ground.is_dir() or not os.access(ground, os.W_OK | os.X_OK):
        raise ScenarioError(f"{key}: {path} cannot be written (see {ground}); name another folder")


def refuse_files(key: str, path: Path) -> None:
    """Refuse a folder for a sweep, in which jobs make folders of their own, if it holds a user's files.

    Raises:
        ScenarioError: there are files, and no folder of ours beside them.
    """
    try:
        inside = list(path.iterdir()) if path.is_dir() else []
        files = sorted(each.name for each in inside if each.name != MARKER and not each.is_dir())
        ours = not files or any(kind_of(each) for each in inside if each.is_dir())
    except OSError as error:
        raise ScenarioError(f"{key}: {path} cannot be used ({error.strerror}); name another folder") from error
    if not ours:
        raise ScenarioError(
            f"{key}: {path} holds {files[0]}, and a sweep takes a folder for its jobs alone; name a new or an empty one"
        )


def claim(key: str, path: Path, kind: str) -> Lock:
    """The lock on the folder ``path``, which is made if it is not there, and then belongs to this command.

    What killed writes of an earlier command left in it is removed.

    Args:
        key: the setting that names it, for messages.
        path: the folder.
        kind: one of ``KINDS``.

    Raises:
        ScenarioError: another command is at work there, the folder is not of this kind, or cannot be written.
    """
    refuse_foreign(key, path, kind)
    lock = lock_folder(key, path, kind)
    try:
        remove_leftovers(path)
    except OSError as error:
        raise ScenarioError(f"{key}: {path} cannot be written ({error.strerror}); name another folder") from error
    return lock


def lock_folder(key: str, path: Path, kind: str) -> Lock:
    """The lock of a folder, which is made if it is not there; nothing else is checked."""
    try:
        path.resolve().mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScenarioError(f"{key}: {path} cannot be made ({error.strerror}); name another folder") from error
    return Lock(path.resolve() / MARKER, f"{key}: {path}", kind)


def is_marked(folder: Path) -> bool:
    """Whether the file is there by which a folder of ours is known."""
    return (folder / MARKER).exists()


def at_work(folder: Path) -> bool:
    """Whether a live command holds the folder."""
    return is_locked(folder / MARKER)


def claim_file(key: str, value: Any, ours: Callable[[Path], bool]) -> Lock:
    """The lock on an output file that is written at the end.

    Args:
        key: the setting that names it.
        value: its path.
        ours: whether an existing file is one that this recipe wrote, and so may be replaced.

    Raises:
        ScenarioError: another command writes it, or there is something else in its place.
    """
    path = check_place(key, value)
    try:
        if path.is_dir():
            raise ScenarioError(f"{key}: {path} is a folder; name a file")
        if path.exists() and path.stat().st_size and not (path.is_file() and ours(path)):
            raise ScenarioError(f"{key}: {path} was not written by this recipe and is left alone; name another file")
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScenarioError(f"{key}: {path} cannot be written ({error.strerror}); name another file") from error
    return Lock(path.parent.resolve() / f".{path.name}.lock", f"{key}: {path}", "file", passing=True)


def set_aside(folder: Path) -> Path:
    """Rename a folder to the first free of ``folder.1``, ``folder.2``, ...; returns its new name."""
    place, number = folder.resolve(), 1
    while os.path.lexists(older := place.with_name(f"{place.name}.{number}")):
        number += 1
    return place.rename(older)


def contents(folder: Path) -> list[str]:
    """Names of what is in a folder, but for the marker; of a folder that is not there, nothing."""
    return sorted(path.name for path in folder.iterdir() if path.name != MARKER) if folder.exists() else []


def holds_runs(folder: Path) -> Path | None:
    """A run or an output folder below ``folder``, if there is one; a run's own dataset does not count."""
    for root, folders, files in os.walk(folder):
        below = Path(root)
        if below != folder and ("decisions.jsonl" in files or kind_of(below) not in (None, "dataset")):
            return below
        folders[:] = [name for name in folders if not name.startswith("part_")]
    return None


def remove_leftovers(folder: Path, depth: int = 2) -> None:
    """Remove what killed writes left in a folder whose lock is held: temporary files beside names of ours.

    A run that was moved out of the way and not yet replaced takes its name again.
    """
    for path in sorted(folder.iterdir()):
        match = _TEMPORARY.fullmatch(path.name)
        if match is None:
            # Runs inside clean up after themselves.
            if depth and path.is_dir() and not path.is_symlink() and kind_of(path) is None:
                remove_leftovers(path, depth - 1)
        elif _is_our_name(match["name"]):
            target = path.with_name(match["name"])
            if path.name.endswith(".old") and not target.exists():
                path.rename(target)
            elif path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _marked(folder: Path) -> str | None:
    try:
        with (folder / MARKER).open("rb") as file:
            kind = read_note(file.read(LONGEST_NOTE)).get("kind")
    except OSError:
        return None  # an older version's, or not ours
    return kind if kind in KINDS else None


def _owns_all_below(folder: Path) -> bool:
    """Whether what is below a folder belongs to it, and is moved or replaced with it."""
    return _marked(folder) in ("run", "evaluation", "dataset") or _is_run(folder) or (folder / RUN_FILES[3]).is_file()


_OUR_NAMES = re.compile(
    r"checkpoint_\d+\.pt|best\.pt|config\.yaml|(dataset|evaluation)\.json|seed_(\d+|None)|(summary|per_seed)\.csv|"
    r"(losses|transfer)\.(md|csv)|[a-z_]+\.(png|pdf|csv)|.+-[0-9a-f]{12}(\.json|\.npz|\.yaml|)"
)


def _is_our_name(name: str) -> bool:
    return _OUR_NAMES.fullmatch(name) is not None


def _is_run(folder: Path) -> bool:
    """A config that a training recipe wrote, and what a training leaves."""
    try:
        config = (folder / "config.yaml").read_bytes()[:1_000_000].splitlines()
    except OSError:
        return False
    keys = {line.split(b":")[0] for line in config}
    return {b"run_dir", b"scenario"} <= keys and _any(
        folder, lambda name: name.startswith(("checkpoint_", "events.out.tfevents")) or name == "best.pt"
    )


def _is_evaluation(folder: Path) -> bool:
    """METHOD/seed_S and the tables, and nothing else."""
    names = [path for path in _entries(folder) if not path.name.startswith(".")]
    return any(map(_is_method, names)) and all(
        _is_method(path) if path.is_dir() else path.name in ("summary.csv", "per_seed.csv", "evaluation.json")
        for path in names
    )


def _is_method(folder: Path) -> bool:
    seeds = [path for path in _entries(folder) if not path.name.startswith(".")]
    return bool(seeds) and all(
        path.is_dir() and path.name.startswith("seed_") and {each.name for each in _entries(path)} <= set(RUN_FILES)
        for path in seeds
    )


def _is_cells(folder: Path) -> bool:
    return any(_any(folder / place, lambda name: _CELL.fullmatch(name) is not None) for place in _CELL_PLACES)


_CELL_PLACES = ("cells", "configs/scenario")


def _is_dataset(folder: Path) -> bool:
    """Parts of a recording, whole or interrupted, and nothing else."""
    names = [path.name for path in _entries(folder) if not path.name.startswith(".")]
    return bool(names) and all(re.fullmatch(r"part_\d{4,}|dataset\.json", name) for name in names)


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _any(folder: Path, wanted: Callable[[str], bool]) -> bool:
    names: Iterable[Path] = folder.iterdir() if folder.is_dir() else ()
    return any(wanted(path.name) for path in names)


_RECOGNISED: dict[str, Callable[[Path], bool]] = {
    "run": _is_run,
    "evaluation": _is_evaluation,
    "cells": _is_cells,
    "dataset": _is_dataset,
}
