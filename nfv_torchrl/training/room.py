"""What a training would take is estimated and refused before its folder is opened: memory, and a compiler."""

from __future__ import annotations

from typing import Any

import torch

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError, one_line
from nfv_torchrl.losses import q_network
from nfv_torchrl.scenario.limits import check_memory
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.simulator import Simulator


def check_environments(scenario: Scenario, num_envs: int, steps: int, key: str = "collector") -> None:
    """Refuse more environments, or longer batches of them, than there is memory for.

    ``key``: the settings that ``num_envs`` and ``steps`` stand under.

    Raises:
        ScenarioError: too little memory; the message names the setting and the GB.
    """
    one = Simulator(scenario, 1)
    frame = 2 * (one.world.seen.flat.nbytes + one.world.seen.mask.nbytes)  # before the step and after
    check_memory(
        {
            f"{key}.num_envs={num_envs}": float(one.memory_bytes()) * num_envs,
            f"{key}.steps={steps} of {num_envs} environments": float(frame) * num_envs * steps,
        }
    )


def check_buffer(loss: Any, scenario: Scenario, *, one_hot: bool, size: int, steps: int) -> None:
    """Refuse a replay memory of ``size`` rows that there is no memory for.

    ``steps``: of a row, where the loss learns from sequences.

    Raises:
        ScenarioError: too little memory; the message names the setting and the GB.
    """
    network = q_network(loss)
    frame = NFVEnv(scenario, 1, one_hot=one_hot, observations=network.observations()).fake_tensordict()
    values = [frame.get(key, None) for key in loss.in_keys]
    row = sum(value.numel() * value.element_size() for value in values if value is not None)
    if hasattr(network, "unroll"):
        row *= steps
    check_memory({f"buffer.size={size}": float(row) * size})


def check_compiler(device: torch.device) -> None:
    """Compile one small function, for ``learner.compile=true``.

    Raises:
        ScenarioError: it does not work on this machine.
    """
    try:
        torch.compile(lambda x: x + 1)(torch.ones(2, device=device))
    except Exception as error:  # whatever torch.compile raises without a compiler, its headers or a place to write to
        raise ScenarioError(
            f"learner.compile: true, but torch.compile does not work here ({one_line(error)}); install a C++ compiler "
            "such as g++, or set learner.compile=false"
        ) from error
