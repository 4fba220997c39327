"""Running recipes for real at tiny size."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from forked import run_forked

ROOT = Path(__file__).resolve().parents[1]
TINY_SCENARIO = [
    "scenario.substrate.nodes=5",
    "scenario.horizon=60",
    "scenario.arrival_rate=4",
    "scenario.mean_lifetime=40",
]
TINY_TRAINING = [
    "collector.num_envs=4",
    "collector.steps=8",
    "collector.total_frames=960",
    "buffer.size=500",
    "buffer.batch_size=32",
    "buffer.warmup_frames=64",
    "learner.updates=2",
    "logger.interval=2",
    "logger.figures=false",
    "eval.interval=10",
    "eval.seeds=[1000]",
    "saving.interval=5",
]


def command(recipe: str, *overrides: str) -> list[str]:
    """The command line of a recipe."""
    return [sys.executable, str(ROOT / "recipes" / recipe), *overrides]


def run(recipe: str, *overrides: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a recipe to its end and return what it printed."""
    return run_forked(ROOT / "recipes" / recipe, overrides, cwd, timeout=900)  # on a busy machine, too


def with_preset(overrides: Sequence[str]) -> list[str]:
    """Overrides of dqn.py, with the quickest preset unless they name one."""
    return [*([] if any(text.startswith("preset=") for text in overrides) else ["preset=mlp"]), *overrides]


def train(run_dir: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    """Train a tiny DQN in ``run_dir``."""
    arguments = [f"run_dir={run_dir}", *TINY_SCENARIO, *TINY_TRAINING, *with_preset(overrides)]
    return run("dqn.py", *arguments, cwd=run_dir.parent)
