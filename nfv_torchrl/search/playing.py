"""Compiled play: what every kernel that answers requests of a whole horizon does around its own decisions."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.simulator.compiled import part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME

FINISHED, NO_ROOM = 0, 1
"""What such a kernel returns when it is done, and when the simulator's pools run low (grow them and call again)."""


@part
def has_room(world, b):
    """Whether the pools of environment b hold the longest walk."""
    e = world.env[b]
    most = world.rules.max_steps
    if e.free_records < 1 or e.free_entries < 2 * most:
        return False
    return not (world.log.enabled and world.log.action.shape[1] - e.log_length < most)


@part
def play_plan(world, b, steps, plan):
    """Answer the request of environment b with the first ``steps`` actions of ``plan``, or refuse it when 0.

    Returns its cost ($), NaN if it was not accepted.
    """
    if steps == 0:
        step_env(world, b, np.int64(world.seen.mask.shape[1] - 1))
    for k in range(steps):
        step_env(world, b, plan[k])
    return request_cost(world, b)


@part
def request_cost(world, b):
    """Cost ($) of the request that the last step ended, NaN if it was not accepted."""
    return world.outcome[b, OUTCOME.request_cost] if world.outcome[b, OUTCOME.accepted] > 0.0 else np.nan
