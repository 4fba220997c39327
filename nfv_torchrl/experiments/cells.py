"""A cell is one piece of work, such as a method on ten workloads; figures that need the same cell share it."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.files import read_json, write_atomically
from nfv_torchrl.inputs import file_digests

LONGEST_LABEL = 80


@dataclass(frozen=True)
class Cell:
    """What is to be computed, and nothing of the figures that show it.

    Attributes:
        kind: which function computes it, see ``nfv_torchrl.experiments.work.WORK``.
        label: begins the name of its file, for people.
        content: all that its result depends on, as JSON.
        needs: cells that come first, such as the training of the policy that this one evaluates.
        alone: it measures time, so nothing else may run beside it.
    """

    kind: str
    label: str
    content: str
    needs: tuple[Cell, ...] = ()
    alone: bool = False

    @property
    def spec(self) -> dict[str, Any]:
        return json.loads(self.content)

    @property
    def key(self) -> str:
        """The same for the same kind and content, whoever asks."""
        # The label becomes a file's name, and on command lines the name of a config.
        label = re.sub(r"[^A-Za-z0-9_]+", "_", self.label)[:LONGEST_LABEL]
        return f"{label}-{hashlib.sha256(f'{self.kind} {self.content}'.encode()).hexdigest()[:12]}"


def make_cell(
    kind: str, label: str, spec: Mapping[str, Any], needs: Iterable[Cell] = (), *, alone: bool = False
) -> Cell:
    """A cell of the plain values in ``spec``; its mappings keep their order, since that of the services is a draw's.

    The content of files that ``spec`` names is part of it: after a change to one the cell is another.
    """
    files = file_digests(spec)
    content = {**spec, "files": files} if files else spec
    return Cell(kind, label, json.dumps(content, allow_nan=False), tuple(needs), alone)


def with_needs(cells: Iterable[Cell]) -> list[Cell]:
    """All of ``cells`` and what they need, each once, needs first."""
    found: dict[str, Cell] = {}
    for cell in cells:
        for one in (*with_needs(cell.needs), cell):
            found.setdefault(one.key, one)
    return list(found.values())


class CellStore:
    """Results of cells, one JSON each, in ``folder/cells``; a file is there whole or not at all.

    Args:
        folder: the output folder.
        recipes: where the recipes are that training cells run.
    """

    def __init__(self, folder: str | os.PathLike[str], recipes: str | os.PathLike[str] = "recipes") -> None:
        self.folder, self.recipes = Path(folder).resolve(), Path(recipes).resolve()

    def path(self, cell: Cell) -> Path:
        """The file of a cell."""
        return self.folder / "cells" / f"{cell.key}.json"

    def has(self, cell: Cell) -> bool:
        """Whether the cell was computed."""
        return self.path(cell).exists()

    def write(self, cell: Cell, result: Mapping[str, Any]) -> None:
        """Keep the result of a cell together with what it was computed from; NaN becomes null."""
        document = {"kind": cell.kind, "spec": cell.spec, "result": _null_for_nan(result)}
        write_atomically(self.path(cell), json.dumps(document, indent=1, allow_nan=False) + "\n")

    def read(self, cell: Cell) -> dict[str, Any]:
        """The result of a cell.

        Raises:
            ScenarioError: there is none, or its file was changed.
        """
        document = read_json(self.path(cell))
        if document.get("spec") != cell.spec or "result" not in document:
            raise ScenarioError(f"{self.path(cell)}: is not the cell it should be; remove it, it is computed again")
        return document["result"]


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_null_for_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
