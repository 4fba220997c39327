"""What every planner offers to the code that runs it, and how a compiled kernel becomes one."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Any, ClassVar

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.search.cheapest import Scratch, make_scratch
from nfv_torchrl.search.labels import NO_LIMIT
from nfv_torchrl.search.walks import OVERFLOW
from nfv_torchrl.simulator.compiled import kernel
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import Tables


class Planner:
    """Answers requests with whole embeddings, or refuses them.

    A planner of your own overrides one of two methods: ``plan`` answers one request, ``plan_rows`` those of many
    environments at once. Both see the whole world of the simulator (``nfv_torchrl.simulator.state``) and must not write
    to it: ``world.env`` has each environment's request in hand (``service``, ``ingress``, ``egress``, ...) and the
    row ``net`` of its network in ``world.tables``; ``world.ledger`` has what VMs and links offer now, in whole cycles/s
    (or millionths of the unit of a kind) and bit/s. Actions are those of ``nfv_torchrl.codec``.

    A planner is used by one thread at a time.

    Attributes:
        unproved: of a planner that may stop a search: how many requests of each environment it answered, since
            somebody set the counts to zero, without knowing that the answer is the best one, int64 [B]. None: of any
            other.
    """

    unproved: np.ndarray | None = None

    def prepare(self, world: World) -> None:
        """Called before a run. Allocate memory here. Does nothing by default."""

    def plan(self, world: World, b: int, plan: np.ndarray) -> int:
        """Plan the request that environment ``b`` is at.

        Args:
            world: only read.
            b: environment.
            plan: receives the actions, int64 [max_steps].

        Returns:
            Number of actions, 0 if the planner has no embedding for the request.
        """
        raise NotImplementedError(f"{type(self).__name__} has neither plan nor plan_rows")

    def plan_rows(self, world: World, rows: np.ndarray, plans: np.ndarray, lengths: np.ndarray) -> None:
        """Plan the requests that the environments ``rows`` are at, by ``plan``, one after the other.

        Args:
            world: only read.
            rows: environments, int64 [R].
            plans: receives the actions, int64 [B, max_steps]; other rows stay.
            lengths: receives the number of actions, 0 where there is no embedding, int64 [B]; other rows stay.
        """
        for b in rows.tolist():
            lengths[b] = self.plan(world, b, plans[b])


def refuse_free_ends(world: World, planner: str) -> None:
    """For planners that need both ends of a request.

    Raises:
        ScenarioError: the scenario has requests with a free ingress or egress.
    """
    if world.rules.free_ends:
        raise ScenarioError(
            f"{planner}: plans requests whose ingress and egress are both given, and this scenario has free ones; use "
            "greedy, tabu, myopic_optimal, priced, milp or a policy"
        )


def _plan_rows(world, rows, own, plans, lengths):
    """How many of ``rows`` were answered before ``own`` was too small."""
    for done in range(rows.size):
        b = rows[done]
        lengths[b] = plan_one(world, b, own, plans[b])  # type: ignore[name-defined]  # noqa: F821
        if lengths[b] == OVERFLOW:
            return done
    return rows.size


def over_rows(plan_one: Callable[..., int]) -> Any:
    """A compiled loop over the kernel ``plan_one(world, b, own, plan) -> number of actions or OVERFLOW``.

    The loop is compiled as if it stood beside that kernel: Numba keeps compiled code by the file and the name of a
    function, and it is stale when that file, or one that it imports from, changes.
    """
    one = getattr(plan_one, "py_func", plan_one)  # itself where Numba is switched off
    name = f"{one.__name__}_rows"
    code = _plan_rows.__code__.replace(co_filename=one.__code__.co_filename, co_name=name, co_qualname=name)
    return kernel(FunctionType(code, {**one.__globals__, "plan_one": plan_one, "OVERFLOW": OVERFLOW}, name))


class CompiledPlanner(Planner):
    """A planner whose kernel works in arrays of its own, which grow when the kernel asks for it.

    Subclasses give ``kernel`` (made by ``over_rows``), ``make`` and ``grow``.

    Attributes:
        own: what the kernel gets as its own, settings and scratch arrays; None before the first plan.
    """

    kernel: ClassVar[Callable[..., int]]

    def __init__(self) -> None:
        self.own: Any = None
        self._tables: Tables | None = None

    def prepare(self, world: World) -> None:
        """Allocate what planning on the networks of ``world`` needs, unless that is done already."""
        if self._tables is not world.tables:
            self._tables, self.own = world.tables, self.make(world.tables)

    def plan_rows(self, world: World, rows: np.ndarray, plans: np.ndarray, lengths: np.ndarray) -> None:
        """See ``Planner``."""
        self.prepare(world)
        while True:
            done = type(self).kernel(world, rows, self.own, plans, lengths)
            if done == rows.size:
                return
            rows = rows[done:]
            self.own = self.grow(world.tables)

    def make(self, tables: Tables) -> Any:
        """What the kernel needs to plan on these tables."""
        raise NotImplementedError

    def grow(self, tables: Tables) -> Any:
        """The same with more memory."""
        raise NotImplementedError


def check_labels(labels: int | None) -> int | None:
    """``labels`` of ``ExactPlanner`` as it is.

    Raises:
        ScenarioError: it is below 1.
    """
    if labels is not None and labels < 1:
        raise ScenarioError(f"labels is {labels}; give at least 1, or None for no limit")
    return None if labels is None else int(labels)


class ExactPlanner(CompiledPlanner):
    """A planner by the exact search, which may be given a limit on its work.

    Args:
        labels: walks ("labels") that the searches of one request may keep, in all; None: as many as there is memory
            for. A request that needs more is answered by the walk of a narrow search, which extends only the cheapest
            few walks to each node, or else by the greedy rule for free ends, or else it is rejected. Such an answer is
            feasible but not proved optimal. Results count it as ``unproved``, unless it costs no more than the bound
            that the search had reached. It stops before a walk is extended, so that it may use a few labels more.

    Raises:
        ScenarioError: labels < 1.
    """

    def __init__(self, labels: int | None) -> None:
        super().__init__()
        self.labels = check_labels(labels)

    def prepare(self, world: World) -> None:
        """See ``CompiledPlanner``."""
        if self.labels is not None and (self.unproved is None or self.unproved.size != world.env.size):
            self.unproved, self._tables = np.zeros(world.env.size, np.int64), None
        super().prepare(world)

    def make_search(self, tables: Tables) -> Scratch:
        """Scratch of the search on these tables."""
        return make_scratch(tables, allowed=NO_LIMIT if self.labels is None else self.labels, unproved=self.unproved)
