"""A policy over menus as a planner: it chooses one of the walks of a request's menu, or refuses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import QValueActor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.actors import scorer
from nfv_torchrl.networks import Sizes
from nfv_torchrl.networks.compiled import CompiledPerceptron, compiled_perceptron, score_row
from nfv_torchrl.networks.menu import MenuNetwork
from nfv_torchrl.observations.asked import ASKED
from nfv_torchrl.observations.menu import describe_menu, describes_asked
from nfv_torchrl.observations.menu_layout import FACTORS, ROW, STATE, MenuShape
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.planners.menu import LEVELS, STEEPNESS, fill_menu, grow_menu_scratch
from nfv_torchrl.plans.acting import BY_COST, Acting, counts_against, fill_rules, rule_for
from nfv_torchrl.plans.menus import Menus
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room, play_plan
from nfv_torchrl.search.walks import OVERFLOW
from nfv_torchrl.settings.values import AboveOne, Count, NotNegative, Share, parse
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.state import World

PER_STAY = 4.0
"""What a stay of the mean lifetime is charged, in bid prices, where lifetimes are seen, by a policy whose file does not
say; trainings write what ``env/plans.yaml`` has, which was chosen on networks of its own (docs/results/plans.md)."""
COMPARE_AT = 0.0
"""The price level at which walks are compared where functions of a request may not share a node, by a policy whose file
does not say, as above; 0: by true costs."""


class Prices(NamedTuple):
    """A ``MenuNetwork`` as compiled code takes it: what decides between walks and reject; V is the same for all."""

    price: CompiledPerceptron
    x: np.ndarray  # float32, what the perceptron sees of the state and of a walk
    by_demand: bool  # whether the form is ``price``
    w_acc: float
    w_cost: float
    acting: Acting


@part
def _choose_row(world, b, offers, prices):
    """The walk of the highest value of environment b, or reject, the number after the last.

    What counts against walks tells which one a request gets, and not whether it is refused."""
    menu, flat, shape = offers.menu, offers.flat, offers.shape
    net, rule = prices.price, rule_for(world, b, flat[b], prices.acting)
    best, highest, most = np.int64(shape.rows), -np.inf, -np.inf
    for i in range(FACTORS, shape.state):
        prices.x[i - FACTORS] = flat[b, i]
    for k in range(shape.rows):
        if not menu.mask[b, k]:
            continue
        first = shape.state + k * shape.row
        row = flat[b, first : first + shape.row]
        for i in range(shape.row):
            prices.x[shape.state - FACTORS + i] = row[i]
        price = np.float64(score_row(net.weights, net.sizes, net.activation, prices.x, net.now, net.after))
        if prices.by_demand:
            price *= np.float64(flat[b, STATE.demand]) * np.float64(flat[b, STATE.stay])
        pays = prices.w_acc - prices.w_cost * np.float64(row[ROW.regret])
        most = max(most, pays - rule.refusing * price)
        value = pays - rule.between * price - counts_against(b, k, menu, row, rule, prices.w_cost)
        if value > highest:
            best, highest = np.int64(k), value
    return best if most >= 0.0 else np.int64(shape.rows)


@kernel
def choose_rows(world, rows, offers, prices, choices):
    """Fill ``choices`` int64 [B] of the environments ``rows`` with the walk of the highest value, or with reject."""
    for r in range(rows.size):
        choices[rows[r]] = _choose_row(world, rows[r], offers, prices)


@kernel
def play_priced_menus(world, b, own, view, offers, prices):
    """Answer all requests of environment b by the walks of the highest value.

    Returns FINISHED, NO_ROOM if the simulator's pools run low, or OVERFLOW if ``own`` must grow (then call again).
    """
    menu, last = offers.menu, np.int64(offers.shape.rows - 1)
    while world.env[b].done == 0:
        if not has_room(world, b):
            return NO_ROOM
        if fill_menu(world, b, own, menu) == OVERFLOW:
            return OVERFLOW
        describe_menu(world, b, view, menu, offers.flat[b])
        k = _choose_row(world, b, offers, prices)
        play_plan(world, b, menu.steps[b, k] if k <= last else np.int64(0), menu.action[b, min(k, last)])
    return FINISHED


class MenuPlanner(Planner):
    """Plans of a policy that was trained in ``PlanEnv``; without one, the cheapest walk of each request.

    Args:
        levels: price levels of the menu, as in ``Menus``.
        steepness: as in ``Menus``.
        per_stay: as in ``Menus``.
        labels: as in ``Menus``. Requests with a search that was stopped are counted as ``unproved``.
        compare_at: p, in mean unit costs of the network's VMs: a policy whose network is a ``MenuNetwork`` compares
            walks with each other by their costs at this price level where functions of a request may not share a node
            (colocation off). Whether it refuses is decided by true costs all the same. 0: true costs for both.
        compare_full: p where all VMs are used. From ``compare_at``, where none is, it rises with the fourth power of
            the used share. None: ``compare_at`` everywhere.
        between: share of the learned bid prices that counts between walks, with colocation off. 0: the price level
            alone tells which walk a request gets.
        refusing: share of them that counts against accepting a request, with colocation off and lifetimes hidden. 1: as
            they were learned.
        refusing_full: the same share where one of the latest requests of another service finds no room. From
            ``refusing``, where all find plenty, it rises with the square of how close such a request is to finding
            none (1 / (1 + n / 4), where n chains of the mean load fit). None: ``refusing`` everywhere.
        reserve: what counts between walks, with colocation off, against one that leaves one of the latest requests no
            room, in accepted requests; for each service, and in proportion to how much closer it brings the one that
            it brings closest. 0: nothing.
        most_nodes: as in ``Menus``. For policies that were trained on smaller networks than they are used on.

    Raises:
        ScenarioError: levels that do not rise from 0, labels or most_nodes < 1, or another number out of its range.
    """

    def __init__(
        self,
        levels: Sequence[NotNegative] = LEVELS,
        steepness: AboveOne = STEEPNESS,
        per_stay: NotNegative | None = PER_STAY,
        labels: Count | None = None,
        compare_at: NotNegative = COMPARE_AT,
        most_nodes: Count | None = None,
        compare_full: NotNegative | None = None,
        between: Share = 1.0,
        refusing: NotNegative = 1.0,
        refusing_full: NotNegative | None = None,
        reserve: NotNegative = 0.0,
    ) -> None:
        self.menus = Menus(levels, steepness, per_stay, labels, most_nodes)
        self._acting = Acting(
            empty=parse(compare_at, NotNegative, "compare_at"),
            full=parse(compare_at if compare_full is None else compare_full, NotNegative, "compare_full"),
            between=parse(between, Share, "between"),
            reserve=parse(reserve, NotNegative, "reserve"),
            refusing=parse(refusing, NotNegative, "refusing"),
            refusing_full=parse(refusing if refusing_full is None else refusing_full, NotNegative, "refusing_full"),
        )
        self._actor: Any = None
        self._prices: Prices | None = None

    def sizes(self, simulator: Simulator) -> Sizes:
        """The sizes of the policy's observation and actions (one for each level, and reject)."""
        return Sizes(
            observation=self.menus.shape(simulator.world).size,
            actions=len(self.menus.level) + 1,
            services=simulator.tables.services,
            candidate_features=len(ASKED) if describes_asked(simulator.world) else 0,
        )

    def follow(self, actor: TensorDictModuleBase) -> MenuPlanner:
        """Decide by ``actor`` from now on; by the weights that it has now, where its network can be compiled."""
        self._actor, self._prices = actor, compiled_prices(actor, self._acting)
        return self

    def prepare(self, world: World) -> None:
        """See ``Planner``."""
        self.menus.prepare(world)
        self.unproved = self.menus.unproved
        self._choices = np.zeros(len(world.env), np.int64)

    def plan_rows(self, world: World, rows: np.ndarray, plans: np.ndarray, lengths: np.ndarray) -> None:
        """See ``Planner``."""
        if len(getattr(self, "_choices", ())) != len(world.env):
            self.prepare(world)
        self.menus.make(world, rows)
        menu, choices = self.menus.menu, self._choices
        if self._actor is None:
            choices[rows] = menu.mask[rows].argmax(-1)
        elif self._prices is not None:
            choose_rows(world, rows, self.menus.offers, self._prices, choices)
        elif rows.size:
            choices[rows] = self._ask(world, rows)
        walk = np.minimum(choices[rows], len(self.menus.level) - 1)
        plans[rows] = menu.action[rows, walk]
        lengths[rows] = np.where(choices[rows] == len(self.menus.level), 0, menu.steps[rows, walk])

    @property
    def plays_whole(self) -> bool:
        """Whether ``play`` can be called: the policy is compiled."""
        return self._prices is not None

    def play(self, simulator: Simulator, b: int) -> None:
        """Answer all requests of environment b, whose horizon has begun, as ``plan_rows`` does, in compiled calls."""
        menus, tables = self.menus, simulator.tables
        while True:
            outcome = play_priced_menus(simulator.world, b, menus.own, menus.view, menus.offers, self._prices)
            if outcome == FINISHED:
                return
            if outcome == NO_ROOM:
                simulator.make_room_for(b)
            else:
                menus.own = grow_menu_scratch(tables, menus.own)

    def _ask(self, world: World, rows: np.ndarray) -> np.ndarray:
        """What the actor chooses for the environments ``rows``."""
        flat, mask = torch.from_numpy(self.menus.flat[rows]), torch.from_numpy(self.menus.menu.mask[rows])
        scores = scorer(self._actor)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            if scores is not None and scores.in_keys == ["observation"]:
                values = scores.module(flat).masked_fill(~mask, -torch.inf)
                return self._choose(world, rows, values, scores.module).numpy()
            seen = TensorDict({"observation": flat, "action_mask": mask}, batch_size=[rows.size])
            return self._actor(seen)["action"].numpy()

    def _choose(self, world: World, rows: np.ndarray, values: torch.Tensor, network: nn.Module) -> torch.Tensor:
        """As ``_choose_row``, from values [R, K + 1] of all walks and reject."""
        best, reject = values.argmax(-1), values.shape[-1] - 1
        if world.rules.colocation or self._acting == BY_COST or not isinstance(network, MenuNetwork):
            return best
        offers = self.menus.offers
        offered = torch.from_numpy(offers.menu.mask[rows, :-1])
        walks = offers.flat[rows, offers.shape.state :].astype(np.float64).reshape(len(rows), reject, -1)
        counts = np.zeros((len(rows), reject + 1))
        fill_rules(world, rows, offers, self._acting, network.w_cost, counts)
        against, refusing = torch.from_numpy(counts[:, :-1]), torch.from_numpy(counts[:, -1:])
        pays = network.w_acc - network.w_cost * torch.from_numpy(walks[..., ROW.regret])
        price = pays - (values[:, :-1] - values[:, -1:])
        most = (pays - refusing * price).masked_fill(~offered, -torch.inf).amax(-1)
        value = pays - self._acting.between * price - against
        walk = value.masked_fill(~offered, -torch.inf).argmax(-1)
        return torch.where(most >= 0.0, walk, reject)


def compiled_prices(actor: Any, acting: Acting = BY_COST) -> Prices | None:
    """The network of ``actor`` as compiled code takes it, None where it is of a kind that torch has to run."""
    scores = scorer(actor) if isinstance(actor, QValueActor) else None
    network: nn.Module | None = None if scores is None else scores.module
    if type(network) is not MenuNetwork or network.outputs != 1:  # a class derived from it may compute something else
        return None
    try:
        price = compiled_perceptron(network.price)
    except ScenarioError:
        return None
    shape: MenuShape = network.shape
    x = np.zeros(shape.state - FACTORS + shape.row, np.float32)
    return Prices(price, x, network.form == "price", network.w_acc, network.w_cost, acting)
