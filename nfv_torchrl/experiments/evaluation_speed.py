"""How fast the greedy policy of a network is evaluated, compiled and through torch; rows for a table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.experiments.loaded import make_scenario
from nfv_torchrl.losses import DQN, IQN, QuantileDQN, Rainbow, q_network
from nfv_torchrl.losses.recurrent_dqn import RecurrentDQN
from nfv_torchrl.methods import Method, PolicyMethod, fastest_method
from nfv_torchrl.networks import DuelingNetwork, GRUNetwork, ImplicitQuantileNetwork, MLPNetwork, Sizes
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator

SLOTS, WORKLOADS = 50, (1000, 1001)
"""Length of the horizons, and as many of them as a training's evaluations have by default."""
LOSSES: dict[str, Callable[[Sizes], Any]] = {
    "mlp": partial(DQN, MLPNetwork),
    "dueling": partial(DQN, DuelingNetwork),
    "quantiles of mlp": partial(QuantileDQN, MLPNetwork),
    "rainbow": partial(Rainbow, partial(DuelingNetwork, noisy=True)),
    "implicit": partial(IQN, ImplicitQuantileNetwork),
    "gru": partial(RecurrentDQN, GRUNetwork),
}


def run_evaluations(config: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Steps per second of processor time, the simulator's part included, of networks with fresh weights."""
    for nodes in config["nodes"]:
        scenario = make_scenario({**config, "loaded_slot": 0}, nodes, SLOTS)
        sizes = Sizes.of(Simulator(scenario, 1, one_hot=True))
        for name, make in LOSSES.items():
            torch.manual_seed(0)
            loss = make(sizes)
            loss.actor.eval()
            network = q_network(loss)
            compiled = steps_per_second(scenario, fastest_method(loss.actor, network, one_hot=True))
            slow = steps_per_second(scenario, PolicyMethod(loss.actor, network.observations(), one_hot=True))
            yield {"network": name, "N": nodes, "steps/s": compiled, "steps/s by torch": slow, "times": compiled / slow}


def steps_per_second(scenario: Scenario, method: Method) -> float:
    """Over whole horizons, of one more workload before: the first may compile."""
    run_method(scenario, method, WORKLOADS[:1])
    begun = time.process_time()
    records = run_method(scenario, method, WORKLOADS)
    return sum(int(record.step_offsets[-1]) for record in records) / (time.process_time() - begun)
