"""``evaluation.json``: what an evaluation's folder has to hold, so that nothing can be taken out of it unnoticed."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import RUN_FILES
from nfv_torchrl.files import write_atomically

MANIFEST = "evaluation.json"


def write_manifest(folder: str | os.PathLike[str], comparison: Comparison, reference: str | None) -> Path:
    """Write ``evaluation.json`` to ``folder``, after all else: methods, seeds and bounds in the order of the tables,
    the method others are paired with, and the SHA-256 of every file. Returns its path."""
    root = Path(folder)
    seeds = list(comparison.scenarios())
    runs = [f"{method}/seed_{seed}/{name}" for method in comparison.methods for seed in seeds for name in RUN_FILES]
    document = {
        "methods": comparison.methods,
        "seeds": seeds,
        "reference": reference,
        "bounds": {name: list(values) for name, values in comparison.bounds.items()},
        "files": {
            name: _digest(root / name) for name in ("summary.csv", "per_seed.csv", *runs) if (root / name).exists()
        },
    }
    path = root / MANIFEST
    write_atomically(path, json.dumps(document, indent=1) + "\n")
    return path


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
