"""Menus of a batch of environments, with what a policy sees of them, in arrays that are allocated once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nfv_torchrl.observations.menu import MenuView, describe_menus, describes_asked, make_menu_view
from nfv_torchrl.observations.menu_layout import MenuShape
from nfv_torchrl.planners.base import check_labels
from nfv_torchrl.planners.menu import (
    LEVELS,
    STEEPNESS,
    Menu,
    MenuScratch,
    check_levels,
    fill_menus,
    grow_menu_scratch,
    make_menu,
    make_menu_scratch,
)
from nfv_torchrl.search.cheapest import make_scratch
from nfv_torchrl.search.labels import NO_LIMIT
from nfv_torchrl.settings.values import AboveOne, Count, NotNegative, parse
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import Tables


class Offers(NamedTuple):
    """The menus of B environments and what a policy sees of them, as compiled code takes them."""

    menu: Menu
    flat: np.ndarray  # float32 [B, P]
    shape: MenuShape  # how that is laid out


class Menus:
    """Makes and describes the menus of the requests that environments are at.

    Args:
        levels: p of each walk, in mean unit costs of the network's VMs, rising from 0.
        steepness: M, how late prices rise.
        per_stay: bid prices that a stay of the mean lifetime is charged where lifetimes are seen, in proportion to the
            stay; None: half of one for coming, and half in proportion, as in training.
        labels: limit on the search at each level, see ``ExactPlanner``: what goes beyond it is not proved the cheapest
            at that level. None: no limit.
        most_nodes: networks of more nodes are described to the policy as having so many; None: as they are. A policy
            that was trained on networks of at most so many has learned nothing of what more nodes mean.

    Attributes:
        menu: the walks, after ``make``.
        flat: what a policy sees of them, float32 [B, P].
        layout: how that is laid out.
        unproved: with ``labels``, how many menus of each environment had a search that was stopped, int64 [B]; else
            None.

    Raises:
        ScenarioError: levels that do not rise from 0, labels or most_nodes < 1, or per_stay < 0.
    """

    menu: Menu
    flat: np.ndarray
    own: MenuScratch
    layout: MenuShape
    view: MenuView
    unproved: np.ndarray | None = None

    def __init__(
        self,
        levels: Sequence[NotNegative] = LEVELS,
        steepness: AboveOne = STEEPNESS,
        per_stay: NotNegative | None = None,
        labels: Count | None = None,
        most_nodes: Count | None = None,
    ) -> None:
        self.level, self.steepness, self.labels = check_levels(levels), float(steepness), check_labels(labels)
        self._per_stay = parse(per_stay, NotNegative | None, "per_stay")
        self.most_nodes = parse(most_nodes, Count | None, "most_nodes")
        self._tables: Tables | None = None

    def shape(self, world: World) -> MenuShape:
        """How ``flat`` is laid out where menus are made in ``world``."""
        return MenuShape.of(world.tables.services, len(self.level), describes_asked(world))

    @property
    def offers(self) -> Offers:
        """What was made last, for compiled code."""
        return Offers(self.menu, self.flat, self.layout)

    def prepare(self, world: World) -> None:
        """Allocate what the environments of ``world`` need, unless that is done already."""
        batch, layout = len(world.env), self.shape(world)
        same = self._tables is world.tables and self.layout == layout and len(self.flat) == batch
        if same and self.menu.action.shape[2] == world.rules.max_steps:
            return
        self._tables, self.layout = world.tables, layout
        self.unproved = None if self.labels is None else np.zeros(batch, np.int64)
        search = make_scratch(world.tables, allowed=self.labels or NO_LIMIT, unproved=self.unproved)
        self.own = make_menu_scratch(world.tables, self.level, self.steepness, search)
        self.view = make_menu_view(world, self._per_stay, self.most_nodes)
        self.menu = make_menu(world.rules, batch, len(self.level))
        self.flat = np.zeros((batch, layout.size), np.float32)

    def make(self, world: World, rows: np.ndarray) -> None:
        """Make and describe the menus of the environments ``rows`` int64 [R]."""
        left = rows
        while True:
            done = fill_menus(world, left, self.own, self.menu)
            if done == left.size:
                break
            left = left[done:]
            self.own = grow_menu_scratch(world.tables, self.own)
        describe_menus(world, rows, self.view, self.menu, self.flat)
