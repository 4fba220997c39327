"""Menus of a batch of environments, with what a policy sees of them, in arrays that are allocated once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.observations.menu import MenuShape, MenuView, describe_menus, make_menu_view
from nfv_torchrl.planners.base import refuse_free_ends
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
from nfv_torchrl.settings.values import AboveOne, NotNegative
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import Tables


def check_requests(world: World) -> None:
    """Refuse worlds whose requests menus do not describe.

    Raises:
        ScenarioError: requests with a free end, with demands of their own, or that take nothing of the first kind of
            resources or of a link.
    """
    refuse_free_ends(world, "menu")
    tables = world.tables
    if world.seen.demand:
        raise ScenarioError("menu: describes requests by their service, and some of these bring demands of their own")
    if (tables.load[:, :, 0].sum(axis=1) == 0).any() or (tables.rate.max(axis=1) == 0).any():
        raise ScenarioError("menu: a service takes nothing of the first kind of resources, or has no rate; change it")


class Menus:
    """Makes and describes the menus of the requests that environments are at.

    Args:
        levels: p of each walk, in mean unit costs of the network's VMs, rising from 0.
        steepness: M, how late prices rise.
        per_stay: bid prices that a stay of the mean lifetime is charged where lifetimes are seen, in proportion to the
            stay; None: half of one for coming, and half in proportion, as in training.

    Attributes:
        menu: the walks, after ``make``.
        flat: what a policy sees of them, float32 [B, P], see ``MenuShape``.

    Raises:
        ScenarioError: levels that do not rise from 0.
    """

    menu: Menu
    flat: np.ndarray
    own: MenuScratch
    view: MenuView

    def __init__(
        self,
        levels: Sequence[NotNegative] = LEVELS,
        steepness: AboveOne = STEEPNESS,
        per_stay: NotNegative | None = None,
    ) -> None:
        self.level, self.steepness = check_levels(levels), float(steepness)
        self._per_stay = per_stay
        self._tables: Tables | None = None

    def shape(self, tables: Tables) -> MenuShape:
        """How ``flat`` is laid out."""
        return MenuShape.of(tables.services, len(self.level))

    def prepare(self, world: World) -> None:
        """Allocate what the environments of ``world`` need, unless that is done already.

        Raises:
            ScenarioError: requests that menus do not describe.
        """
        check_requests(world)
        batch = len(world.env)
        if self._tables is not world.tables:
            self._tables = world.tables
            self.own = make_menu_scratch(world.tables, self.level, self.steepness)
            self.view = make_menu_view(world.tables, self._per_stay)
        elif len(self.flat) == batch and self.menu.action.shape[2] == world.rules.max_steps:
            return
        self.menu = make_menu(world.rules, batch, len(self.level))
        self.flat = np.zeros((batch, self.shape(world.tables).size), np.float32)

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
