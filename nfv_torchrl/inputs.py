"""Fingerprints of what a result depends on beside its settings: the files that these name, and the network built."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.arrivals import FILE, UNIFORM
from nfv_torchrl.scenario.kinds import CPU
from nfv_torchrl.scenario.scenario import Scenario

NAMING = ("path", "checkpoint", "init_from", "dataset")
"""Last words of settings that name an input file, at any depth. Of a dataset it is the manifest."""
_OVERRIDE = re.compile(rf"\+*([\w.]*\b(?:{'|'.join(NAMING)}))=(.+)", re.DOTALL)


def file_digests(config: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of every existing file that ``config`` names, by its key such as ``scenario.substrate.path``.

    A list of overrides (``[scenario.substrate.path=net.json]``) counts as what it sets. Names of what ships with the
    package are no files.

    Raises:
        ScenarioError: a file cannot be read.
    """
    return {key: digest for key, path in _named(config) if (digest := _digest(key, path)) is not None}


def world_digests(scenarios: Iterable[Scenario]) -> dict[str, str]:
    """Fingerprints of the networks, services, endpoints and given requests that were built."""
    parts: dict[str, Any] = {name: hashlib.sha256() for name in ("network", "services", "endpoints", "workload")}
    for scenario in scenarios:
        names = [field.name for field in dataclasses.fields(scenario.substrate) if field.name not in _FOR_PEOPLE]
        for name in names:
            if name not in _NEWER or _is_used(getattr(scenario.substrate, name)):
                _add(parts["network"], getattr(scenario.substrate, name))
        _add(parts["services"], (scenario.catalogue.types, dict(scenario.catalogue.vnfs)))
        for service in scenario.catalogue.types:  # newer attributes are not in its repr
            if (service.rates, service.ingress, service.egress) != (None, None, None):
                _add(parts["services"], (service.rates, service.ingress, service.egress))
        if scenario.catalogue.resources != CPU:
            _add(parts["services"], scenario.catalogue.resources)
        _add(parts["endpoints"], scenario.endpoint_pairs)
        if scenario.arrivals not in (UNIFORM, FILE):
            _add(parts["workload"], scenario.arrivals)
            for part in scenario.traffic.arrays() if scenario.arrivals.process == "matrix" else ():
                _add(parts["workload"], part)
        if scenario.workload_path is not None:
            for name in ("slot", "service", "ingress", "egress", "lifetime"):
                _add(parts["workload"], getattr(scenario.file_workload, name))
            if scenario.file_workload.own is not None:
                for part in (scenario.file_workload.profile, *vars(scenario.file_workload.own).values()):
                    _add(parts["workload"], part)
            if scenario.file_workload.time is not None:
                _add(parts["workload"], scenario.file_workload.time)
    return {name: digest.hexdigest() for name, digest in parts.items()}


_FOR_PEOPLE = ("name", "labels", "ids", "coordinates")
"""Of a substrate: what decides nothing."""


_NEWER = ("resources", "extra_capacity", "extra_unit_cost", "back_capacity")
"""Left out where they are not used, so that fingerprints of older runs stay."""


def _is_used(value: Any) -> bool:
    return isinstance(value, np.ndarray) or (value is not None and value != ("cpu",))


def _add(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes())
    else:
        digest.update(repr(value).encode())


def _named(config: Any, where: str = "") -> Iterator[tuple[str, Path]]:
    """Keys and paths of the files that settings name, in order."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            if key in NAMING and isinstance(value, str) and value:
                yield f"{where}{key}", Path(value)
            else:
                yield from _named(value, f"{where}{key}.")
    elif isinstance(config, list | tuple):
        for place, value in enumerate(config):
            match = _OVERRIDE.fullmatch(value) if isinstance(value, str) else None
            if match is not None:
                yield f"{where}{match[1]}", Path(match[2].strip("'\""))
            else:
                yield from _named(value, f"{where}{place}.")


def _digest(key: str, path: Path) -> str | None:
    try:
        file = path / "dataset.json" if path.is_dir() else path
        if not file.is_file():
            return None
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{key}: {os.fspath(path)!r} cannot be read ({error}); give a readable file") from error
