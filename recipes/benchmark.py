"""How fast everything is on this machine: kernels, environment, collector, training, decisions, memory.

    python recipes/benchmark.py
    python recipes/benchmark.py parts=[kernel,methods] nodes=[10,100] batch_sizes=[64] output=runs/benchmark.json

Rates are per second of processor time on one core, so that other work on the machine hardly counts; those per second
of wall time stand beside them. Medians of repeats, compilation and warm-up left out. Networks are loaded by a quick
compiled rule first; tables show how full their VMs are. All keys: config/benchmark.yaml.
"""

from __future__ import annotations

import json
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
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
from torchrl.collectors import Collector
from tqdm import tqdm

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import scenario_for
from nfv_torchrl.evaluation.tables import Table
from nfv_torchrl.files import read_json, write_atomically
from nfv_torchrl.folders import claim_file
from nfv_torchrl.methods import methods_from_config
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.settings.recipes import BenchmarkSettings, read_settings
from nfv_torchrl.simulator import Simulator, kernels
from nfv_torchrl.simulator.state import OUTCOME, grow_pools
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.random_policy import RandomPolicy
from nfv_torchrl.training.setup import quote, run_file, set_threads

DIFFERENT = 4
"""Networks of a batch that are loaded each for itself; the others begin as copies and go their own ways."""
ROLLOUT, COLLECTED = 64, 16
"""Steps of each environment in a rollout, and in a batch of the collector."""
MOST_STEPS = 512

Row = dict[str, Any]


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
        results[part] = list(tqdm(run(config), desc=part, unit="row", disable=None))
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


# ------------------------------------------------------------------------------------------- networks under load


def make_scenario(config: dict[str, Any], nodes: int, slots: int) -> Scenario:
    """The scenario with N = ``nodes``, lasting ``slots`` after the loaded slot."""
    values = dict(config["scenario"])
    values["substrate"] = {**values["substrate"], "nodes": nodes}
    values["horizon"] = config["loaded_slot"] + slots
    if config["arrivals_per_node"] is not None:
        values["arrival_rate"] = max(round(2 * config["arrivals_per_node"] * nodes) / 2, 0.5)
    return Scenario.from_config(values)


def slots_for(config: dict[str, Any], nodes: int, steps: int) -> int:
    """Slots in which so many steps of one environment end surely: a request takes at least one."""
    rate = config["scenario"]["arrival_rate"]
    if config["arrivals_per_node"] is not None:
        rate = config["arrivals_per_node"] * nodes
    return int(1.2 * steps / rate) + 100


def load_networks(simulator: Simulator, slot: int, different: int = DIFFERENT) -> None:
    """Bring all environments to ``slot``: the first ``different`` by the exact search, the others as copies."""
    loader = Loader(simulator)
    for b in range(min(different, simulator.batch_size)):
        scenario = simulator.scenario(b)
        simulator.start(b, scenario.workload(b), scenario.failure_timeline(b))
        loader.forward(b, slot, np.random.default_rng(b))
    simulator.world = grow_pools(simulator.world)  # kernels.random_steps does not stop to grow them
    world = simulator.world
    origin = np.arange(different, simulator.batch_size) % different
    if origin.size:
        groups = (world.ledger, world.arrivals, world.running, world.walk)
        arrays = [array for group in groups for array in group]
        for array in (*arrays, world.seen.mask, world.seen.valid, world.seen.flat, world.env):
            array[different:] = array[origin]


def vm_use(simulator: Simulator) -> float:
    """Used share of all VM capacity, mean over the environments."""
    env = simulator.world.env
    return float((env["vm_used"] / simulator.tables.vm_total[env["net"]]).mean())


class LoadedEnv(NFVEnv):
    """An ``NFVEnv`` whose horizons begin on a loaded network at ``loaded_slot``."""

    loaded_slot = 0

    def _start(self, rows: np.ndarray) -> None:
        load_networks(self.simulator, self.loaded_slot)


def batches(config: dict[str, Any], multiple: int = 0) -> Iterator[tuple[int, int, Scenario, int]]:
    """N, B, scenario and steps per environment and repeat, for every combination that fits into memory.

    The steps are a ``multiple`` if one is given, and then few: what is not all compiled is slow for a small B.
    """
    for nodes in config["nodes"]:
        for batch in config["batch_sizes"]:
            steps = max(config["frames"] // batch, 1)
            if multiple:
                steps = max(min(steps, MOST_STEPS) // multiple, 1) * multiple
            scenario = make_scenario(config, nodes, slots_for(config, nodes, steps * (config["repeats"] + 1)))
            few = Simulator(scenario, min(batch, DIFFERENT))
            load_networks(few, config["loaded_slot"])
            gigabytes = few.memory_bytes() / few.batch_size * batch / 1e9
            if gigabytes > config["memory_limit"]:
                tqdm.write(f"N = {nodes}, B = {batch} is left out: {gigabytes:.0f} GB, memory_limit is "
                           f"{config['memory_limit']} GB")  # fmt: skip
                continue
            yield nodes, batch, scenario, steps


def median_rates(config: dict[str, Any], count: Callable[[], int]) -> tuple[float, float]:
    """What ``count`` does and counts, per second of processor time and of wall time."""
    rates = []
    for _ in range(config["repeats"] + 1):
        cpu, wall = time.process_time(), time.perf_counter()
        done = count()
        rates.append((done / (time.process_time() - cpu), done / (time.perf_counter() - wall)))
    first, second = zip(*rates[1:], strict=True)
    return statistics.median(first), statistics.median(second)


# -------------------------------------------------------------------------------------------------------- parts


def run_kernel(config: dict[str, Any]) -> Iterator[Row]:
    for nodes, batch, scenario, steps in batches(config):
        simulator = Simulator(scenario, batch)
        load_networks(simulator, config["loaded_slot"])
        states = np.random.default_rng(0).integers(1, 2**63, batch).astype(np.uint64)
        before, slot = vm_use(simulator), int(simulator.world.env["slot"].min())
        answered: list[int] = []

        def count(simulator=simulator, states=states, steps=steps, answered=answered) -> int:
            answered.append(kernels.random_steps(simulator.world, steps, states))
            return steps * len(states)

        cpu, wall = median_rates(config, count)
        if simulator.world.env["slot"].min() < slot:
            raise ScenarioError("a network was emptied while it was measured; lower frames or repeats")
        requests = sum(answered) / (len(answered) * steps * batch)
        yield {
            "N": nodes,
            "B": batch,
            "steps/s": cpu,
            "steps/s (wall)": wall,
            "requests/s": cpu * requests,
            "VM use before": before,
            "VM use after": vm_use(simulator),
            "MB per env": simulator.memory_bytes() / batch / 1e6,
        }


def loaded_env(config: dict[str, Any], batch: int, scenario: Scenario) -> LoadedEnv:
    env = LoadedEnv(scenario, batch, one_hot=False, observations=())
    env.loaded_slot = config["loaded_slot"]
    return env


def run_env(config: dict[str, Any]) -> Iterator[Row]:
    for nodes, batch, scenario, steps in batches(config, ROLLOUT):
        env, policy = loaded_env(config, batch, scenario), RandomPolicy()
        env.reset()
        state = {"next": env.rollout(1, policy, auto_reset=False, tensordict=env.reset())[:, -1]["next"]}

        def count(env=env, policy=policy, steps=steps, state=state, batch=batch) -> int:
            for _ in range(steps // ROLLOUT):
                rollout = env.rollout(ROLLOUT, policy, auto_reset=False, tensordict=state["next"])
                state["next"] = rollout[:, -1]["next"].exclude("reward")
            return steps // ROLLOUT * ROLLOUT * batch

        cpu, wall = median_rates(config, count)
        yield {
            "N": nodes,
            "B": batch,
            "frames/s": cpu,
            "frames/s (wall)": wall,
            f"rollouts of {ROLLOUT} steps/s": cpu / ROLLOUT / batch,
            "VM use after": vm_use(env.simulator),
        }


def run_collector(config: dict[str, Any]) -> Iterator[Row]:
    for nodes, batch, scenario, steps in batches(config, COLLECTED):
        env = loaded_env(config, batch, scenario)
        collector = Collector(env, RandomPolicy(), frames_per_batch=COLLECTED * batch, total_frames=-1,
                              auto_register_policy_transforms=False)  # fmt: skip
        data = iter(collector)

        def count(data=data, steps=steps) -> int:
            return sum(next(data).numel() for _ in range(steps // COLLECTED))

        cpu, wall = median_rates(config, count)
        yield {"N": nodes, "B": batch, "frames/s": cpu, "frames/s (wall)": wall, "VM use after": vm_use(env.simulator)}
        collector.shutdown()


def run_training(config: dict[str, Any]) -> Iterator[Row]:
    """The DQN recipe itself with its defaults, in a process of its own; speeds as it logs them (wall time)."""
    choice = HydraConfig.get().runtime.choices["scenario"]
    for nodes in config["nodes"]:
        with tempfile.TemporaryDirectory(prefix="benchmark_") as folder:
            scenario = make_scenario(config, nodes, 0)
            arguments = [
                f"scenario={choice}", f"scenario.substrate.nodes={nodes}",
                f"scenario.arrival_rate={scenario.arrival_rate}", f"run_dir={quote(Path(folder) / 'run')}",
                f"collector.total_frames={config['training']['frames']}",
                "logger.interval=5", "eval.interval=0", "checkpoint.interval=1000000", *config["training"]["overrides"],
            ]  # fmt: skip
            recipe = Path(__file__).with_name("dqn.py")
            run = subprocess.run([sys.executable, str(recipe), *arguments], capture_output=True, text=True)
            if run.returncode != 0:
                raise ScenarioError(f"recipes/dqn.py failed with {' '.join(arguments)}:\n{run.stderr[-2000:]}")
            settings = OmegaConf.load(f"{folder}/run/config.yaml")
            frames = late_median(f"{folder}/run", "speed/frames_per_second")
            updates = late_median(f"{folder}/run", "speed/updates_per_second")
        alone = updates * settings.collector.num_envs * settings.collector.steps / settings.learner.updates
        yield {
            "N": nodes,
            "B": settings.collector.num_envs,
            "frames/s": frames,
            "updates/s of the learner": updates,
            "frames/s if only updating": alone,
            "share": frames / alone,
        }


def late_median(folder: str, tag: str) -> float:
    """Median of the later half of a scalar in TensorBoard's files."""
    events = EventAccumulator(folder)
    events.Reload()
    values = [event.value for event in events.Scalars(tag)]
    return statistics.median(values[len(values) // 2 :])


def run_methods(config: dict[str, Any]) -> Iterator[Row]:
    batch = config["methods"]["batch_size"]
    for nodes in config["nodes"]:
        for name, entry in config["method"].items():
            scenario = make_scenario(config, nodes, 1000)
            (method,) = methods_from_config({name: entry}, scenario)
            simulator = Simulator(scenario_for(scenario, method), batch, one_hot=method.one_hot)
            load_networks(simulator, config["loaded_slot"], different=batch)
            method.prepare(simulator, range(batch))
            before = vm_use(simulator)
            decide(simulator, method, config["methods"]["seconds"] / 10)
            requests, cpu, wall = decide(simulator, method, config["methods"]["seconds"])
            yield {
                "method": method.name,
                "N": nodes,
                "requests/s": requests / cpu,
                "requests/s (wall)": requests / wall,
                "us per request": 1e6 * cpu / requests,
                "VM use before": before,
                "VM use after": vm_use(simulator),
            }


def decide(simulator: Simulator, method: Any, seconds: float) -> tuple[int, float, float]:
    """Let ``method`` decide for so long. Returns requests answered, processor and wall seconds it took to decide."""
    requests, cpu, wall = 0, 0.0, 0.0
    while (cpu < seconds or not requests) and not simulator.world.env["done"].all():
        begun = time.process_time(), time.perf_counter()
        actions = method.act(simulator)
        cpu += time.process_time() - begun[0]
        wall += time.perf_counter() - begun[1]
        simulator.step(np.ascontiguousarray(actions, np.int64))
        requests += int(simulator.world.outcome[:, OUTCOME.request_done].sum())
    return max(requests, 1), cpu, wall


def run_memory(config: dict[str, Any]) -> Iterator[Row]:
    for setting in config["memory"]:
        values = {key: value for key, value in setting.items() if key not in ("nodes", "batch_size")}
        substrate = {**config["scenario"]["substrate"], "nodes": setting["nodes"]}
        scenario = Scenario.from_config({**config["scenario"], **values, "substrate": substrate})
        simulator = Simulator(scenario, setting["batch_size"])
        # No request arrives after the last slot, so the pools have their final size.
        load_networks(simulator, scenario.horizon - 1, different=2)
        yield {
            "N": setting["nodes"],
            "B": setting["batch_size"],
            "lambda": scenario.arrival_rate,
            "mu": scenario.mean_lifetime,
            "T": scenario.horizon,
            "running requests": float(simulator.world.env["num_running"].mean()),
            "GB": simulator.memory_bytes() / 1e9,
            "MB per env": simulator.memory_bytes() / setting["batch_size"] / 1e6,
            "largest GB of the process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        }


PARTS: dict[str, tuple[str, Callable[[dict[str, Any]], Iterator[Row]]]] = {
    "kernel": ("Kernel: random valid actions, mask and flat observation updated, one core", run_kernel),
    "env": ("NFVEnv: rollouts with a random masked policy", run_env),
    "collector": (f"Collector: random masked policy, {COLLECTED} steps a batch", run_collector),
    "training": ("Training: recipes/dqn.py with its defaults", run_training),
    "methods": ("Methods: decisions on loaded networks, simulation not counted", run_methods),
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
