"""How fast environments act in one process and in several, as in a training; rows for a table."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.experiments.loaded import make_scenario
from nfv_torchrl.losses import DQN
from nfv_torchrl.networks import Sizes
from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.collecting import MultiAsync, MultiSync, Single, World

STEPS, WARM_UP = 16, 5
"""Steps of each environment in a batch, as in ``dqn.py``; batches before the clock starts."""
KINDS: dict[str, Callable[..., Single]] = {"single": Single, "multi_sync": MultiSync, "multi_async": MultiAsync}


def run_workers(config: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Frames a second of wall time, with the network of ``dqn.py`` choosing actions; nobody learns meanwhile."""
    for nodes in config["nodes"]:
        for batch in config["batch_sizes"]:
            alone = 0.0
            for name, workers in (("single", 1), *((kind, n) for kind in KINDS if kind != "single" for n in (1, 2, 4))):
                if batch % workers:
                    continue
                rate = _collect(config, name, workers, nodes, batch)
                alone = alone or rate
                yield {
                    "N": nodes,
                    "B": batch,
                    "collector": name,
                    "workers": workers,
                    "cores": len(os.sched_getaffinity(0)),
                    "frames/s (wall)": rate,
                    "to single": f"{rate / alone:.2f}",
                }


def _collect(config: dict[str, Any], name: str, workers: int, nodes: int, batch: int) -> float:
    scenario = make_scenario(config, nodes, 1000)  # slots; environments begin horizons anew
    loss = DQN(MLPNetwork, Sizes.of(Simulator(scenario, 1, one_hot=True)))
    explore = EGreedyModule(Categorical(loss.actor.spec["action"].n), action_mask_key="action_mask", eps_init=0.1)
    sizes = {"num_envs": batch, "steps": STEPS, "total_frames": config["frames"]}
    collector = KINDS[name](**sizes) if name == "single" else KINDS[name](**sizes, workers=workers)
    collector.prepare(World(partial(NFVEnv, seed=0, one_hot=True, stagger=True, segment=20), [scenario], 0))
    batches = collector.start(TensorDictSequential(loss.actor, explore), torch.device("cpu"))
    try:
        for _ in range(WARM_UP):
            next(batches)
        begun, frames = time.perf_counter(), 0
        while frames < config["frames"]:
            frames += next(batches).numel()
        return frames / (time.perf_counter() - begun)
    finally:
        collector.shutdown()
