"""What a training would take is refused before its folder is opened: memory, a compiler, networks of any size."""

from __future__ import annotations

from typing import Any

import torch

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


def check_any_size(loss: Any, networks: Any) -> None:
    """Refuse ``networks``, substrates of several sizes, for a loss whose network fits one size; None: there are none.

    Raises:
        ScenarioError: so it is.
    """
    if networks is not None and not q_network(loss).any_size:
        raise ScenarioError(
            "networks: substrates of several sizes need a network that fits any; set network=lookahead, or preset=mlp, "
            "which trains on the scenario's network alone"
        )


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
