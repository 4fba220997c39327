"""Demand matrices from files: of one network file, of a file of demands, or of a folder that holds one a time."""

from __future__ import annotations

import os
import warnings
from functools import lru_cache
from pathlib import Path

from nfv_torchrl.errors import ScenarioError, ScenarioWarning
from nfv_torchrl.files import read_bytes
from nfv_torchrl.scenario.formats.demands import DemandMatrix
from nfv_torchrl.scenario.formats.graph import MAX_NETWORK_BYTES
from nfv_torchrl.scenario.formats.repetita import parse_demands
from nfv_torchrl.scenario.topology_zoo import read_network_file

SERIES = (".xml", ".txt", ".demands")


def read_demands(path: str | os.PathLike[str]) -> DemandMatrix:
    """The demands of Repetita's ``.demands``, or of a network file of SNDlib or TopoHub, which may have no links.

    Raises:
        ScenarioError: the file cannot be read, or has no demands.
    """
    demands = _demands_of(path)
    if demands is None:
        raise ScenarioError(f"{path}: holds no demands; those of SNDlib, Repetita (.demands) and TopoHub are read")
    return demands


def _demands_of(path: str | os.PathLike[str]) -> DemandMatrix | None:
    if Path(path).suffix.lower() == ".demands":
        return parse_demands(read_bytes(Path(path), MAX_NETWORK_BYTES), str(path))
    return read_network_file(path).demands


def read_demand_series(folder: str | os.PathLike[str]) -> list[DemandMatrix]:
    """The demands of all files in ``folder``, in order of their times, or of their names if they have none.

    Series that were measured have gaps. Files without demands are left out, and a warning says how many.

    Raises:
        ScenarioError: no such files, none with demands, or two of them that differ in nodes or unit.
    """
    paths = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in SERIES)
    if not paths:
        raise ScenarioError(f"{folder}: holds no files ending in {', '.join(SERIES)}")
    return list(_read_series(tuple(paths), tuple((path.stat().st_mtime_ns, path.stat().st_size) for path in paths)))


@lru_cache(maxsize=4)
def _read_series(paths: tuple[Path, ...], stamps: tuple[tuple[int, int], ...]) -> tuple[DemandMatrix, ...]:
    """Kept, since a week of them takes seconds to read and every seed asks for it; ``stamps``: sizes and times."""
    found = [(path, _demands_of(path)) for path in paths]
    series = [matrix for _, matrix in found if matrix is not None]
    empty = [path for path, matrix in found if matrix is None]
    if not series:
        raise ScenarioError(f"{paths[0].parent}: none of its {len(paths)} files holds demands")
    if empty:
        many = f"{len(empty)} of {len(paths)} files hold no demands and are left out, such as {empty[0].name}"
        warnings.warn(f"{empty[0].parent}: {many}", ScenarioWarning, stacklevel=3)
    for matrix in series[1:]:
        if (matrix.names, matrix.unit) != (series[0].names, series[0].unit):
            raise ScenarioError(
                f"{matrix.source}: has other nodes or another unit than {series[0].source}; keep one kind"
            )
    return tuple(sorted(series, key=lambda matrix: matrix.time))
