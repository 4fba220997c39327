"""Networks under load, and how fast something is there: what the benchmark measures on."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.progress_bar import ProgressBar
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import grow_pools

DIFFERENT = 4
"""Networks of a batch that are loaded each for itself; the others begin as copies and go their own ways."""
MOST_STEPS = 512
"""Steps of each environment in a repeat, where not all is compiled."""


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
    world = simulator.world
    return float((world.ledger.vm_used / simulator.tables.vm_total[world.env["net"]]).mean())


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
                ProgressBar.write(f"N = {nodes}, B = {batch} is left out: {gigabytes:.0f} GB, memory_limit is "
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


def loaded_env(config: dict[str, Any], batch: int, scenario: Scenario) -> LoadedEnv:
    env = LoadedEnv(scenario, batch, one_hot=False, observations=())
    env.loaded_slot = config["loaded_slot"]
    return env
