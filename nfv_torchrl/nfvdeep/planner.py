"""NFVdeep as a planner: a learned policy chooses the nodes, the rest of the plan follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import scorer
from nfv_torchrl.networks import Sizes
from nfv_torchrl.nfvdeep.drafts import COMPLETE, OPEN, Drafts, Options, begin_rows, choose_rows, make_drafts
from nfv_torchrl.planners.base import Planner, refuse_free_ends
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import Tables

ROUTES = ("delay", "cost")


def check_requests(world: World) -> None:
    """Refuse worlds whose requests NFVdeep has no plans for.

    Raises:
        ScenarioError: requests with a free end, or without functions.
    """
    refuse_free_ends(world, "nfvdeep")
    if (world.tables.chain_length == 0).any():
        raise ScenarioError("nfvdeep: places functions one by one, and some requests have none; give them a chain")


class NFVdeepPlanner(Planner):
    """Plans of NFVdeep (Xiao et al., "NFVdeep: Adaptive Online Service Function Chain Deployment with Deep
    Reinforcement Learning", IWQoS 2019): a policy puts one function after the other on a node.

    Between the nodes the request takes the shortest route over links that can carry it; at a node it takes the cheapest
    VM that fits. Where no node is left for a function, the last placement is undone and its node ruled out for that
    function, at most ``backtracks`` times a request, then the request is refused.

    Without colocation a plan keeps to the walk of the environment: one function a hop, so never two in a row on one
    node, and no route through the egress, where all functions not placed yet go.

    It plans requests whose ends are both given. Of several kinds of resources the policy sees the first; the plan fits
    all.

    Args:
        actor: the policy; reads ``observation`` and ``action_mask`` as emitted by ``NFVdeepEnv``, writes ``action``.
            It can be given later, by ``follow``.
        route: what the shortest routes are short of, ``delay`` (ms) or ``cost`` (link unit costs).
        backtracks: placements undone a request.
        may_refuse: the policy may refuse a request even if a node is left.

    Raises:
        ScenarioError: no such ``route``, negative ``backtracks``.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase | None = None,
        *,
        route: str = "delay",
        backtracks: int = 5,
        may_refuse: bool = False,
    ) -> None:
        if route not in ROUTES:
            raise ScenarioError(f"planner.route: {route!r}; use one of {', '.join(ROUTES)}")
        if backtracks < 0:
            raise ScenarioError(f"planner.backtracks: {backtracks}; use 0 or more")
        self.actor = actor
        self.options = Options(by_cost=route == "cost", backtracks=int(backtracks), may_refuse=bool(may_refuse))
        self._tables: Tables | None = None
        self._drafts: Any = None

    @staticmethod
    def sizes(simulator: Simulator) -> Sizes:
        """The sizes of the policy's observation (4 N + 4) and actions (N + 1)."""
        nodes = simulator.tables.vm_count.shape[1]
        return Sizes(
            observation=4 * nodes + 4,
            actions=nodes + 1,
            services=simulator.tables.services,
            candidate_features=0,
        )

    def follow(self, actor: TensorDictModuleBase) -> NFVdeepPlanner:
        """Use ``actor`` for planning from now on."""
        self.actor = actor
        return self

    def plan_rows(self, world: World, rows: np.ndarray, plans: np.ndarray, lengths: np.ndarray) -> None:
        """Plan the requests of many environments, the policy called for all of them together; see ``Planner``."""
        check_requests(world)
        if self._tables is not world.tables or len(self._drafts.state) != len(world.env):
            self._tables, self._drafts = world.tables, make_drafts(world.tables, world.rules, len(world.env))
        drafts = self._drafts
        begin_rows(world, rows, self.options, drafts)
        waiting = rows
        while waiting.size:
            choose_rows(world, waiting, self._ask(drafts, waiting), self.options, drafts)
            waiting = waiting[drafts.state[waiting] == OPEN]
        lengths[rows] = np.where(drafts.state[rows] == COMPLETE, drafts.steps[rows], 0)
        within = np.arange(plans.shape[1]) < lengths[rows, None]
        plans[rows] = np.where(within, drafts.action[rows], plans[rows])

    def _ask(self, drafts: Drafts, rows: np.ndarray) -> np.ndarray:
        """The policy's choice for each of ``rows``."""
        if self.actor is None:
            raise ScenarioError("an NFVdeepPlanner has no policy yet; give it one by follow(actor)")
        device = next((weights.device for weights in self.actor.parameters()), torch.device("cpu"))
        flat, mask = torch.from_numpy(drafts.flat[rows]).to(device), torch.from_numpy(drafts.mask[rows]).to(device)
        scores = scorer(self.actor)
        if scores is not None and scores.in_keys == ["observation"]:  # the same choice without the bookkeeping
            with torch.no_grad():
                return scores.module(flat).masked_fill(~mask, -torch.inf).argmax(-1).cpu().numpy()
        seen = {"observation": flat, "action_mask": mask}
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.actor(TensorDict(seen, batch_size=[rows.size]))["action"].cpu().numpy()
