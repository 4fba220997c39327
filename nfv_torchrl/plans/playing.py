"""Compiled play of the walks chosen from menus."""

from __future__ import annotations

import numpy as np

from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.state import OUTCOME

NO_ACTION = np.int64(-1)


@part
def _play_walk(world, menu, b, k):
    """All steps of walk k; ``step_cost`` of the outcome is theirs together."""
    cost = 0.0
    for j in range(menu.steps[b, k]):
        step_env(world, b, menu.action[b, k, j])
        cost += world.outcome[b, OUTCOME.step_cost]
    world.outcome[b, OUTCOME.step_cost] = cost


@kernel
def play_menus(world, menu, choices, least_cost):
    """Answer the requests of all environments by the walks ``choices`` int64 [B] of their menus; the last one refuses.

    A choice that is not offered answers with ``invalid_action``. ``least_cost`` float64 [B] receives the cost ($) of
    the cheapest walk of each, NaN if it had none. Returns the room left, as ``step_range`` of the simulator does.
    """
    refuse = menu.mask.shape[1] - 1
    reject = np.int64(world.seen.mask.shape[1] - 1)
    records = entries = places = np.int64(1) << 60
    for b in range(choices.size):
        e, k = world.env[b], choices[b]
        least_cost[b] = menu.cost[b, 0] if menu.mask[b, 0] else np.nan
        if k == refuse:
            step_env(world, b, reject)
        elif k < 0 or k > refuse or not menu.mask[b, k]:
            step_env(world, b, NO_ACTION)
        else:
            _play_walk(world, menu, b, k)
        records = min(records, e.free_records)
        entries = min(entries, e.free_entries)
        places = min(places, world.log.action.shape[1] - e.log_length)
    return records, entries, places
