"""How fast everything is on this machine: kernels, environment, collector, training, decisions, memory.

    python recipes/benchmark.py
    python recipes/benchmark.py scenario=paper_memory parts=[kernel]       # VMs with two kinds of resources
    python recipes/benchmark.py parts=[gym] nodes=[10] batch_sizes=[64]    # needs the extra sb3
    python recipes/benchmark.py parts=[kernel,methods] nodes=[10,100] batch_sizes=[64] output=runs/benchmark.json

Rates are per second of processor time on one core, so that other work on the machine hardly counts; those per second
of wall time stand beside them. Medians of repeats, compilation and warm-up left out. Networks are loaded by a quick
compiled rule first; tables show how full their VMs are. All keys: config/benchmark.yaml.
"""

from __future__ import annotations

import json
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np
import tensordict
import torch
import torchrl
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.experiments.evaluation_speed import run_evaluations
from nfv_torchrl.experiments.gym_speed import run_gym
from nfv_torchrl.experiments.loaded import make_scenario
from nfv_torchrl.experiments.speed import (
    COLLECTED,
    Row,
    run_collector,
    run_env,
    run_kernel,
    run_memory,
    run_methods,
    run_rows,
)
from nfv_torchrl.experiments.worker_speed import run_workers
from nfv_torchrl.files import read_json, write_atomically
from nfv_torchrl.folders import claim_file
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.settings.recipes import BenchmarkSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import quote, run_file, set_threads


@recipe("benchmark")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, BenchmarkSettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    output = None if config["output"] is None else run_file(config["output"])
    if output is not None:
        claim_file("output", output, is_benchmark)
    set_threads(1)
    machine = describe_machine()
    print("\n".join(f"{key}: {value}" for key, value in machine.items()))
    results: dict[str, list[Row]] = {}
    for part in config["parts"]:
        title, run = PARTS[part]
        results[part] = list(ProgressBar(run(config), desc=part, unit="row"))
        print(f"\n{as_table(title, results[part]).text()}")
        if output is not None:  # part by part: an interrupted benchmark has not been for nothing
            text = json.dumps({"machine": machine, "config": config, "results": results}, indent=1)
            write_atomically(output, text + "\n")


def is_benchmark(path: Path) -> bool:
    """Whether a file is an output of this recipe, and so may be replaced."""
    try:
        return {"machine", "config", "results"} <= read_json(path).keys()
    except ScenarioError:
        return False


def describe_machine() -> dict[str, Any]:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": len(names) or None,
        "threads used": 1,
        "python": platform.python_version(),
        **{module.__name__: str(module.__version__) for module in (np, numba, torch, tensordict, torchrl)},
    }


def run_training(config: dict[str, Any]) -> Iterator[Row]:
    """The DQN recipe itself, in a process of its own; speeds as it logs them; the learner's are per wall time."""
    choice = HydraConfig.get().runtime.choices["scenario"]
    for nodes in config["nodes"]:
        with tempfile.TemporaryDirectory(prefix="benchmark_") as folder:
            scenario = make_scenario(config, nodes, 0)
            arguments = [
                f"preset={config['training']['preset']}", f"scenario={choice}", f"scenario.substrate.nodes={nodes}",
                f"scenario.arrival_rate={scenario.arrival_rate}", f"run_dir={quote(Path(folder) / 'run')}",
                f"collector.total_frames={config['training']['frames']}",
                "logger.interval=5", "eval.interval=0", "saving.interval=1000000", *config["training"]["overrides"],
            ]  # fmt: skip
            recipe = Path(__file__).with_name("dqn.py")
            run = subprocess.run([sys.executable, str(recipe), *arguments], capture_output=True, text=True)
            if run.returncode != 0:
                raise ScenarioError(f"recipes/dqn.py failed with {' '.join(arguments)}:\n{run.stderr[-2000:]}")
            settings = OmegaConf.load(f"{folder}/run/config.yaml")
            frames = late_median(f"{folder}/run", "speed/frames_per_processor_second")
            wall = late_median(f"{folder}/run", "speed/frames_per_second")
            updates = late_median(f"{folder}/run", "speed/updates_per_second")
        alone = updates * settings.collector.num_envs * settings.collector.steps / settings.learner.updates
        yield {
            "N": nodes,
            "B": settings.collector.num_envs,
            "frames/s": frames,
            "frames/s (wall)": wall,
            "updates/s of the learner": updates,
            "frames/s if only updating": alone,
            "share": wall / alone,
        }


def late_median(folder: str, tag: str) -> float:
    """Median of the later half of a scalar in TensorBoard's files."""
    events = EventAccumulator(folder)
    events.Reload()
    values = [event.value for event in events.Scalars(tag)]
    return statistics.median(values[len(values) // 2 :])


PARTS: dict[str, tuple[str, Callable[[dict[str, Any]], Iterator[Row]]]] = {
    "kernel": ("Kernel: random valid actions, mask and flat observation updated, one core", run_kernel),
    "env": ("NFVEnv: rollouts with a random masked policy", run_env),
    "collector": (f"Collector: random masked policy, {COLLECTED} steps a batch", run_collector),
    "workers": ("Collectors of dqn.py: wall time, with the learner at rest", run_workers),
    "rows": ("Rows of candidate and of lookahead: an environment's step with them, the same actions", run_rows),
    "gym": ("Gymnasium: MaskablePPO of sb3-contrib, rollouts alone and learning", run_gym),
    "training": ("Training: recipes/dqn.py", run_training),
    "methods": ("Methods: decisions on loaded networks, simulation not counted", run_methods),
    "evaluation": ("Evaluations in a training: greedy policies of fresh networks, simulation counted", run_evaluations),
    "memory": ("Memory: arrays of a batch at the end of its horizon", run_memory),
}


def as_table(title: str, rows: list[Row]) -> Table:
    columns = tuple(rows[0]) if rows else ("nothing measured",)
    return Table(title, columns, tuple(tuple(show(value) for value in row.values()) for row in rows))


def show(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
