"""The menu of a request: the cheapest walk at several levels of prices that rise with use, found together.

Level k charges a unit what it costs plus p_k (M^u - 1) / (M - 1) times the mean unit cost of the network's VMs, u being
the used share of the resource (the prices of ``priced``). Level 0 has p = 0, so its walk is the cheapest there is.

Few searches make the whole menu. What a walk costs is linear in p, so a walk that is cheapest at two levels is cheapest
at every level between them: the outer levels are searched first, and those between two different walks only. A
request without a walk at one level has none at any. And what the walks found cost at a level is a limit for its search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.priced import PriceRule, fill_prices
from nfv_torchrl.search.cheapest import Scratch, grow_scratch, plan_cheapest, plan_within
from nfv_torchrl.search.walks import OVERFLOW, Prices, make_problem, unit_costs, walk_totals
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.tables import Rules, Tables

LEVELS = (0.0, 1.0, 4.0, 16.0, 64.0)
STEEPNESS = 3000.0
LEAST_COST = 1e-9
"""$, what costs are divided by at least, for networks where something is free."""
SLACK = 1e-9
"""Share of a limit, and $, that rounding may take."""
MADE = 0
"""What ``fill_menu`` returns when it is done."""


class Menu(NamedTuple):
    """The walks of B environments at K levels; walk k is offered where ``mask`` says so."""

    action: np.ndarray  # int64 [B, K, J], the actions of each walk
    steps: np.ndarray  # int64 [B, K], how many; 0: not searched, or none
    cost: np.ndarray  # float64 [B, K], true cost, $
    delay: np.ndarray  # float64 [B, K], ms
    rise: np.ndarray  # float64 [B, K], $, what each costs more at p = 1; inf where the level was not searched
    mask: np.ndarray  # bool [B, K + 1], walks that differ from every one before them, and reject, which is always there


class MenuScratch(NamedTuple):
    """What making menus reads and writes while it works; one for each thread."""

    level: np.ndarray  # float64 [K], p_k in mean unit costs of the network's VMs, ascending, the first 0
    steepness: float  # M
    mean_cost: np.ndarray  # float64 [S], $ per Mcycles/s, of the first kind of resources
    search: Scratch
    risen: Prices  # prices at p = 1
    rise: np.ndarray  # float64 [K], $, what the walk of each level costs more at p = 1; inf: not searched yet
    waiting: np.ndarray  # int64 [K, 2], pairs of levels with others between them


def check_levels(levels: Sequence[float]) -> np.ndarray:
    """The levels as float64 [K].

    Raises:
        ScenarioError: they do not rise from 0.
    """
    level = np.asarray(levels, np.float64)
    if (
        level.ndim != 1
        or not len(level)
        or level[0] != 0
        or (np.diff(level) <= 0).any()
        or not np.isfinite(level).all()
    ):
        raise ScenarioError(f"levels: {list(levels)}; give price levels that rise from 0, such as {list(LEVELS)}")
    return level


def make_menu(rules: Rules, batch: int, levels: int) -> Menu:
    """Room for the menus of ``batch`` environments; nothing is offered."""
    return Menu(
        action=np.zeros((batch, levels, rules.max_steps), np.int64),
        steps=np.zeros((batch, levels), np.int64),
        cost=np.zeros((batch, levels)),
        delay=np.zeros((batch, levels)),
        rise=np.full((batch, levels), np.inf),
        mask=np.zeros((batch, levels + 1), np.bool_),
    )


def make_menu_scratch(tables: Tables, level: np.ndarray, steepness: float, search: Scratch) -> MenuScratch:
    """Scratch for any network and request of ``tables``, with ``search`` for its searches."""
    _, nodes, vms, kinds = tables.vm_capacity.shape
    counts = np.maximum(tables.vm_count.sum(axis=1), 1)
    return MenuScratch(
        level=level,
        steepness=float(steepness),
        mean_cost=tables.vm_unit_cost[..., 0].sum(axis=(1, 2)) / counts,
        search=search,
        risen=Prices(np.zeros((nodes, vms, kinds)), np.zeros(tables.link_capacity.shape[1])),
        rise=np.full(len(level), np.inf),
        waiting=np.zeros((len(level) + 1, 2), np.int64),
    )


def grow_menu_scratch(tables: Tables, own: MenuScratch) -> MenuScratch:
    """The same with more memory for searches."""
    return own._replace(search=grow_scratch(tables, own.search))


@part
def _search_cheapest(world, b, own, menu):
    """The walk of level 0 into its menu, and the prices of the other levels; its number of steps, or OVERFLOW."""
    own.rise[:] = np.inf
    steps = plan_cheapest(world, b, unit_costs(world, b), own.search, menu.action[b, 0])
    _note(own, menu, b, 0, steps)
    if steps > 0:
        fill_prices(world, b, PriceRule(own.mean_cost[world.env[b].net], own.steepness, np.inf), own.risen)
        risen = walk_totals(make_problem(world, b, own.risen), own.risen, own.search.walk, steps)[0]
        own.rise[0] = risen - menu.cost[b, 0]
    return steps


@part
def _search_level(world, b, k, own, menu):
    """Walk k > 0 of environment b into its menu; its number of steps, or OVERFLOW."""
    tables, net = world.tables, world.env[b].net
    unit, p = unit_costs(world, b), own.level[k]
    prices = Prices(own.search.vm_price, own.search.link_price)
    for node in range(tables.num_nodes[net]):
        for vm in range(tables.vm_count[net, node]):
            for kind in range(prices.vm.shape[2]):
                here = unit.vm[node, vm, kind]
                prices.vm[node, vm, kind] = here + p * (own.risen.vm[node, vm, kind] - here)
    for link in range(tables.num_links[net]):
        prices.link[link] = unit.link[link] + p * (own.risen.link[link] - unit.link[link])
    known, least = _best_known(own, menu, b, p)
    limit = least * (1.0 + SLACK) + SLACK
    steps = plan_within(world, b, prices, limit, own.search, menu.action[b, k])
    dearer = own.search.cut[0] > 0 and own.search.result[0] > limit  # of a search that was stopped
    if steps == 0 or (steps > 0 and dearer):
        # None is within the limit but for rounding: the walk that set it is the cheapest.
        steps = menu.steps[b, known]
        for j in range(steps):
            menu.action[b, k, j] = menu.action[b, known, j]
        menu.steps[b, k], menu.cost[b, k], menu.delay[b, k] = steps, menu.cost[b, known], menu.delay[b, known]
        own.rise[k] = own.rise[known]
        return steps
    _note(own, menu, b, k, steps)
    own.rise[k] = (own.search.result[0] - own.search.result[1]) / p
    return steps


@part
def _note(own, menu, b, k, steps):
    """Write what the search found of walk k."""
    menu.steps[b, k] = steps
    menu.cost[b, k] = own.search.result[1]
    menu.delay[b, k] = own.search.result[2]


@part
def _best_known(own, menu, b, p):
    """Of the walks found so far, the cheapest at price p, and what it costs there ($)."""
    best, least = 0, np.inf
    for j in range(own.rise.size):
        if own.rise[j] < np.inf and menu.cost[b, j] + p * own.rise[j] < least:
            best, least = j, menu.cost[b, j] + p * own.rise[j]
    return best, least


@part
def _same_walk(menu, b, one, other):
    if menu.steps[b, one] != menu.steps[b, other]:
        return False
    same = True
    for j in range(menu.steps[b, one]):
        same = same and menu.action[b, one, j] == menu.action[b, other, j]
    return same


@part
def _search_between(world, b, own, menu):
    """Search the levels between two that have different walks, until there are none. Returns MADE or OVERFLOW."""
    own.waiting[0, 0] = 0
    own.waiting[0, 1] = own.level.size - 1
    count = 1
    while count > 0:
        count -= 1
        low, high = own.waiting[count, 0], own.waiting[count, 1]
        if high - low < 2 or _same_walk(menu, b, low, high):
            continue
        middle = (low + high) // 2
        if _search_level(world, b, middle, own, menu) == OVERFLOW:
            return OVERFLOW
        own.waiting[count, 0], own.waiting[count, 1] = low, middle
        own.waiting[count + 1, 0], own.waiting[count + 1, 1] = middle, high
        count += 2
    return MADE


@part
def _offer(menu, b):
    """Offer each walk once, at its lowest level."""
    for k in range(menu.steps.shape[1]):
        menu.mask[b, k] = menu.steps[b, k] > 0
        for before in range(k):
            if menu.mask[b, k] and menu.mask[b, before] and _same_walk(menu, b, before, k):
                menu.mask[b, k] = False


@part
def fill_menu(world, b, own, menu):
    """Make the menu of the request that environment b is at; past its horizon nothing but reject is offered.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``MenuScratch`` of the world's tables.
        menu: ``Menu`` of the world's environments.

    Returns:
        MADE, or OVERFLOW (-1) if the scratch must grow.
    """
    for k in range(own.level.size):
        menu.steps[b, k] = 0
        menu.mask[b, k] = False
    menu.mask[b, own.level.size] = True
    if world.env[b].done == 1:
        return MADE
    unproved = own.search.unproved
    row = b if b < unproved.size else 0  # without a limit there is one count, of nothing
    before = unproved[row]
    outcome = _search_levels(world, b, own, menu)
    # A menu counts once, however many of its searches were stopped, and not before it is made.
    unproved[row] = before if outcome == OVERFLOW else min(unproved[row], before + 1)
    if outcome == MADE:
        _offer(menu, b)
    return outcome


@part
def _search_levels(world, b, own, menu):
    """The walks of all levels. Returns MADE or OVERFLOW."""
    last = own.level.size - 1
    steps = _search_cheapest(world, b, own, menu)
    if steps == OVERFLOW:
        return OVERFLOW
    if steps > 0 and last > 0:
        if _search_level(world, b, last, own, menu) == OVERFLOW:
            return OVERFLOW
        if _search_between(world, b, own, menu) == OVERFLOW:
            return OVERFLOW
    for k in range(own.level.size):
        menu.rise[b, k] = own.rise[k]
    return MADE


@kernel
def fill_menus(world, rows, own, menu):
    """``fill_menu`` for the environments ``rows`` int64 [R]; how many were done before ``own`` was too small."""
    for done in range(rows.size):
        if fill_menu(world, rows[done], own, menu) == OVERFLOW:
            return done
    return rows.size
