"""Rewards. Each is a small function of what the last step brought.

A reward is any callable ``reward(outcome, scale) -> float64 [B]``. ``outcome`` maps the names in
``nfv_torchrl.simulator.state.Outcome`` to float64 [B]; ``scale`` holds the costs that make weights plain numbers. In a
recipe's yaml a reward is a ``_target_`` with ``_partial_: true``, so a function of your own package works as well. So
does a class, without ``_partial_``: its ``prepare(simulator)``, if it has one, is called before the first step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.menu import LEAST_COST
from nfv_torchrl.settings.values import OneOf
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.tables import Tables


class CostScale(NamedTuple):
    """Costs to measure by, $, float64 [B]: one per environment, since each may have a substrate of its own."""

    step: np.ndarray
    """phi_ref: the largest cost that a single step can have."""
    request: np.ndarray
    """Phi_ref: the largest cost, over the services, of a request whose functions are all on the dearest VM and whose
    route crosses the dearest link as often as the network's hop diameter."""


Reward = Callable[[Mapping[str, np.ndarray], CostScale], np.ndarray]


def prepared(reward: Reward | None, simulator: Simulator) -> Reward:
    """``reward`` ready for the networks of ``simulator``; without one, ``admission_step_cost``.

    What Hydra makes of a yaml checks its target anew in each call, longer than a reward takes to compute; it was
    checked when it was made, so a plain ``partial`` takes its place.
    """
    reward = reward or admission_step_cost
    if isinstance(reward, partial) and type(reward).__module__.startswith("hydra."):
        reward = partial(reward.func, *reward.args, **reward.keywords)
    if hasattr(reward, "prepare"):
        reward.prepare(simulator)
    return reward


ON_REJECTION = ("keep", "forfeit")
OnRejection = Annotated[str, OneOf(*ON_REJECTION)]


def paper(
    outcome: Mapping[str, np.ndarray],
    scale: CostScale,
    *,
    w_acc: float = 1.0,
    w_cost: float = 1.0,
    on_rejection: OnRejection = "keep",
) -> np.ndarray:
    """The paper's reward (eq. reward_f): ``w_acc - w_cost * phi~ / phi_ref`` for a step that passes, else 0.

    It is paid per step, so a longer walk earns more.

    Args:
        on_rejection: ``keep``: a rejected walk keeps what its steps earned, as the equation has it; ``forfeit``: the
            step that rejects takes it back, so that a rejected request earns 0 in all (Algorithm 3: r_k <- 0).

    Raises:
        ScenarioError: ``on_rejection`` is neither.
    """
    if on_rejection not in ON_REJECTION:
        raise ScenarioError(f"reward.on_rejection: {on_rejection!r} is unknown; use one of {list(ON_REJECTION)}")
    earned = np.where(outcome["passed"] > 0, w_acc - w_cost * outcome["step_cost"] / scale.step, 0.0)
    if on_rejection == "keep":
        return earned
    return earned - (w_acc * outcome["lost_steps"] - w_cost * outcome["lost_cost"] / scale.step)


def admission(
    outcome: Mapping[str, np.ndarray], scale: CostScale, *, w_acc: float = 1.0, w_cost: float = 1.0
) -> np.ndarray:
    """Paid once, at the end: ``w_acc - w_cost * phi / Phi_ref`` for an accepted request, 0 for a rejected one."""
    return np.where(outcome["accepted"] > 0, w_acc - w_cost * outcome["request_cost"] / scale.request, 0.0)


def admission_step_cost(
    outcome: Mapping[str, np.ndarray],
    scale: CostScale,
    *,
    w_acc: float = 1.0,
    w_cost: float = 0.2,
    w_step: float = 0.0,
) -> np.ndarray:
    """``w_acc`` on acceptance, and each step pays its own cost at once: ``- w_cost * phi~ / phi_ref - w_step``.

    The sum over an accepted request is that of ``admission`` on another scale, but the cost is credited to the step
    that caused it, which is learned from sooner. ``w_step``, paid for every step that passes, keeps requests whose
    traffic costs next to nothing from walking about.
    """
    steps = w_cost * outcome["step_cost"] / scale.step + w_step * outcome["passed"]
    return w_acc * outcome["accepted"] - steps


def admission_regret(
    outcome: Mapping[str, np.ndarray], scale: CostScale, *, w_acc: float = 1.0, w_cost: float = 0.1
) -> np.ndarray:
    """``w_acc - w_cost (phi / phi_min - 1)`` for an accepted request, 0 for a rejected one.

    phi_min is what the cheapest walk would have cost when the request came, so a request that is dear to everybody is
    worth as much as any, and a hop that costs a tenth more counts the same for each service. Only ``PlanEnv``, and
    ``NFVEnv`` with the rows of ``LookaheadObservation``, know phi_min. Where those rows are lower bounds
    (``exact=False``), so is phi_min.

    Raises:
        ScenarioError: the environment does not say phi_min.
    """
    if "least_cost" not in outcome:
        raise ScenarioError(
            "reward: admission_regret needs the least cost of a request; use env=plans or network=lookahead"
        )
    accepted = outcome["accepted"] > 0
    least = np.where(accepted, np.maximum(outcome["least_cost"], LEAST_COST), 1.0)
    return np.where(accepted, w_acc - w_cost * (outcome["request_cost"] / least - 1.0), 0.0)


def cost_scale(tables: Tables, net: np.ndarray) -> CostScale:
    """The cost scale of every environment; ``net`` int64 [B] is its row of ``tables``."""
    steps = np.array([_largest_step(tables, row) for row in range(len(tables.num_nodes))])
    requests = np.array([_largest_request(tables, row) for row in range(len(tables.num_nodes))])
    return CostScale(step=steps[net], request=requests[net])


def _largest_step(tables: Tables, row: int) -> float:
    """Place on a node's dearest VM after entering the node by its dearest link."""
    loads, rates = tables.load.max(axis=1), tables.rate.max(axis=1)
    largest = 0.0
    for node in range(tables.num_nodes[row]):
        unit_costs = tables.vm_unit_cost[row, node, : tables.vm_count[row, node]]
        vm = (unit_costs.max(axis=0) * loads).sum(axis=1) if len(unit_costs) else np.zeros(len(loads))
        links = tables.neighbour_link[row, node, : tables.degree[row, node]]
        link = tables.link_unit_cost[row, links].max()
        largest = max(largest, float((vm + link * rates).max()))
    return largest


def _largest_request(tables: Tables, row: int) -> float:
    nodes, links = tables.num_nodes[row], tables.num_links[row]
    reach = np.eye(nodes, dtype=bool)
    step = reach.copy()
    ends = tables.link_ends[row, :links]
    step[ends[:, 0], ends[:, 1]] = step[ends[:, 1], ends[:, 0]] = True
    diameter = 0
    while not reach.all():
        reach = reach @ step
        diameter += 1
    vm, link = tables.vm_unit_cost[row].max(axis=(0, 1)), tables.link_unit_cost[row, :links].max()
    return float(((vm * tables.load.sum(axis=1)).sum(axis=1) + link * diameter * tables.rate.max(axis=1)).max())
