"""Integer programmes for one request, or for all requests of one slot, solved by HiGHS. For small networks.

Two forms (docs/bounds.md compares them): ``walk`` chooses among the walks an agent can make, ``problem`` is the
paper's optimisation problem, eq. (main_prob), where placements are free and any path may join successive functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, OptimizeResult, milp
from scipy.sparse import coo_array, csr_array

from nfv_torchrl.codec import encode_action, split_vm
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.search.layered_graph import Form, LayeredGraph, Request, layered_graph
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

__all__ = ["Embedding", "MilpPlanner", "Request", "embed_request", "embed_slot"]

_INFEASIBLE = 2  # status of scipy.optimize.milp


class Embedding(NamedTuple):
    """Where the functions of a request run and how its traffic flows.

    ``steps``: (node, vm, function or None) of every hop and placement, in order; the same node as before = no link
    used. ``placements``: (node, vm) of every function. ``cost`` in $, eq. (main_problem); ``delay`` in ms.
    """

    steps: tuple[tuple[int, int, int | None], ...]
    placements: tuple[tuple[int, int], ...]
    cost: float
    delay: float

    def actions(self, max_vms: int) -> np.ndarray:
        """The walk as actions int64 [J], with V = ``max_vms``. Only form ``walk`` keeps to the mask."""
        return np.array([encode_action(n, v, f is not None, max_vms) for n, v, f in self.steps], dtype=np.int64)


class MilpPlanner(Planner):
    """``milp``: the integer programme as a planner. For small networks."""

    def plan(self, world: World, b: int, plan: np.ndarray) -> int:
        """Plan one request; see ``Planner``."""
        embedding = embed_request(world, b)
        if embedding is None:
            return 0
        actions = embedding.actions(world.tables.vm_capacity.shape[2])
        plan[: actions.size] = actions
        return int(actions.size)


def embed_request(world: World, b: int, form: Form = "walk") -> Embedding | None:
    """The cheapest embedding of the request that environment b is at, on what is offered now; None if there is none."""
    return embed_slot(world, b, [Request.of(world, b)], form)[0]


def embed_slot(world: World, b: int, requests: Sequence[Request], form: Form = "walk") -> list[Embedding | None]:
    """Embed the requests of one slot together: as many as possible, and those at the least total cost.

    Args:
        world: the simulator's world.
        b: environment on whose network they are embedded.
        requests: any requests.
        form: ``walk`` or ``problem``.

    Returns:
        One entry per request, None for those left out.
    """
    if not requests:
        return []
    if world.rules.shared_steps and len(requests) > 1:
        raise ScenarioError("milp: requests of a slot are planned together with step_budget=request only")
    programme = _Programme(world, b, requests, form)
    # A single request needs no count first: it is accepted or the programme is infeasible.
    return programme.cheapest(1 if len(requests) == 1 else programme.most_accepted())


class _Programme:
    """Variables: one per arc of every request's layered graph (0 or 1), then one per request (1 = accepted).

    Capacity rows are divided by the greatest common divisor of what requests ask for, so they hold exactly: whole
    numbers small enough for the solver's tolerance not to matter.
    """

    def __init__(self, world: World, b: int, requests: Sequence[Request], form: Form) -> None:
        tables, ledger = world.tables, world.ledger
        self.tables, self.rules, self.form = tables, world.rules, form
        self.most_steps = float(world.env["most_steps"][b] if self.rules.shared_steps else self.rules.max_steps)
        self.requests = list(requests)
        self.graphs = [layered_graph(world, b, request, form) for request in requests]
        sizes = [graph.tail.size for graph in self.graphs]
        self.first = np.r_[0, np.cumsum(sizes)].astype(np.int64)  # first variable of each request
        self.num_vars = int(self.first[-1]) + len(self.requests)
        self.accept = np.arange(self.first[-1], self.num_vars)
        self.budgets = np.array([tables.tolerable_delay[r.profile] + DELAY_TOLERANCE for r in requests])
        self.rows = [
            *self._conservation(),
            *(
                row
                for kind in range(tables.load.shape[2])
                for row in self._capacity(ledger.vm_offered[b, :, :, kind].ravel(), "vm", kind)
            ),
            *self._capacity(ledger.link_offered[b], "link"),
            *self._budgets(),
            *(self._meetings() if self.rules.distinct else []),
        ]

    def most_accepted(self) -> int:
        objective = np.zeros(self.num_vars)
        objective[self.accept] = -1.0
        result = self._solve(objective, at_least=0)
        return 0 if result is None else round(-result.fun)

    def cheapest(self, accepted: int) -> list[Embedding | None]:
        """The least-cost embeddings of ``accepted`` requests in all."""
        objective = np.r_[np.concatenate([graph.cost for graph in self.graphs]), np.zeros(len(self.requests))]
        while accepted > 0:
            result = self._solve(objective, at_least=accepted)
            if result is None:  # what the solver's tolerance let through has been cut off
                accepted -= 1
                continue
            paths = self._paths(np.rint(result.x).astype(np.int64))
            if not self._cut_off_late(paths):
                return [self._embedding(index, path) for index, path in enumerate(paths)]
        return [None] * len(self.requests)

    def _cut_off_late(self, paths: list[list[int] | None]) -> bool:
        """Forbid every path that is over its delay budget by the solver's tolerance; True if there was one."""
        late = False
        for index, path in enumerate(paths):
            if path is None or self.graphs[index].delay[path].sum() <= self.budgets[index]:
                continue
            columns = self.first[index] + np.array(path)
            row = self._matrix(np.zeros_like(columns), columns, np.ones(columns.size), 1)
            self.rows.append(LinearConstraint(row, -np.inf, columns.size - 1.0))
            late = True
        return late

    def _solve(self, objective: np.ndarray, at_least: int) -> OptimizeResult | None:
        result = milp(
            objective,
            integrality=np.ones(self.num_vars),
            bounds=Bounds(0.0, 1.0),
            constraints=[*self.rows, self._number(at_least)],
            options={"mip_rel_gap": 0.0},
        )
        if result.status == _INFEASIBLE:
            return None
        if result.x is None or result.status != 0:
            raise ScenarioError(f"HiGHS gave up: {result.message}; try fewer requests or a smaller network")
        return result

    def _matrix(self, rows: np.ndarray, columns: np.ndarray, values: np.ndarray, count: int) -> csr_array:
        return coo_array((values, (rows, columns)), shape=(count, self.num_vars)).tocsr()

    def _conservation(self) -> list[LinearConstraint]:
        """What flows out of a state minus what flows in: +a at the source, -a at the sink, a = acceptance."""
        out = []
        for index, graph in enumerate(self.graphs):
            variables = self.first[index] + np.arange(graph.tail.size)
            ends = np.array([graph.source, graph.sink])
            accept = np.full(2, self.accept[index])
            rows = np.r_[graph.tail, graph.head, ends]
            columns = np.r_[variables, variables, accept]
            values = np.r_[np.ones(graph.tail.size), -np.ones(graph.tail.size), -1.0, 1.0]
            out.append(LinearConstraint(self._matrix(rows, columns, values, graph.num_states), 0.0, 0.0))
        return out

    def _capacity(self, offered: np.ndarray, resource: str, kind: int = 0) -> list[LinearConstraint]:
        """One row per VM (of one kind of resources) or link: all that the requests put on it, repeated use too."""
        columns = np.concatenate([self.first[i] + np.flatnonzero(getattr(g, resource) >= 0) for i, g in self._each()])
        if columns.size == 0:
            return []
        rows = np.concatenate([getattr(g, resource)[getattr(g, resource) >= 0] for _, g in self._each()])
        demand = np.concatenate([self._demand(i, g, resource, kind) for i, g in self._each()])
        unit = int(np.gcd.reduce(demand)) or 1
        matrix = self._matrix(rows, columns, (demand // unit).astype(np.float64), offered.size)
        room = np.minimum(offered // unit, matrix.sum(axis=1).astype(np.int64))
        used = np.unique(rows)
        return [LinearConstraint(matrix[used], -np.inf, room[used].astype(np.float64))]

    def _each(self) -> list[tuple[int, LayeredGraph]]:
        return list(enumerate(self.graphs))

    def _demand(self, index: int, graph: LayeredGraph, resource: str, kind: int) -> np.ndarray:
        """Ledger units, int64, that each arc on a VM (or link) takes from it."""
        profile = self.requests[index].profile
        if resource == "vm":
            return self.tables.load_units[profile, graph.function[graph.vm >= 0], kind]
        return self.tables.rate_units[profile, graph.segment[graph.link >= 0]]

    def _meetings(self) -> list[LinearConstraint]:
        """Per request and node: at most one function."""
        out = []
        for index, graph in self._each():
            placing = np.flatnonzero(graph.vm >= 0)
            if placing.size:
                matrix = self._matrix(
                    graph.node[placing], self.first[index] + placing, np.ones(placing.size), int(graph.node.max()) + 1
                )
                out.append(LinearConstraint(matrix, -np.inf, 1.0))
        return out

    def _budgets(self) -> list[LinearConstraint]:
        """Per request: the tolerable delay, and for walks the number of steps."""
        out = []
        if np.isfinite(self.budgets).any():
            out.append(self._sums([graph.delay for graph in self.graphs], self.budgets))
        if self.form == "walk":
            steps = [graph.steps.astype(np.float64) for graph in self.graphs]
            out.append(self._sums(steps, np.full(len(self.graphs), self.most_steps)))
        return out

    def _sums(self, weights: list[np.ndarray], limits: np.ndarray) -> LinearConstraint:
        rows = np.repeat(np.arange(len(self.graphs)), np.diff(self.first))
        columns = np.arange(self.first[-1])
        matrix = self._matrix(rows, columns, np.concatenate(weights), len(self.graphs))
        return LinearConstraint(matrix, -np.inf, limits)

    def _number(self, at_least: int) -> LinearConstraint:
        rows = np.zeros(self.accept.size, dtype=np.int64)
        matrix = self._matrix(rows, self.accept, np.ones(self.accept.size), 1)
        return LinearConstraint(matrix, float(at_least), np.inf)

    def _paths(self, values: np.ndarray) -> list[list[int] | None]:
        """The arcs of every accepted request's path, in order."""
        paths: list[list[int] | None] = []
        for index, graph in self._each():
            used = np.flatnonzero(values[self.first[index] : self.first[index + 1]])
            paths.append(_path(graph, used) if values[self.accept[index]] else None)
        return paths

    def _embedding(self, index: int, path: list[int] | None) -> Embedding | None:
        return None if path is None else _embedding(self.graphs[index], path, self.tables.vm_capacity.shape[2])


def _embedding(graph: LayeredGraph, path: list[int], max_vms: int) -> Embedding:
    """Turn a path of the layered graph into hops and placements."""
    steps: list[tuple[int, int, int | None]] = []
    for arc in path:
        vm, function = int(graph.vm[arc]), int(graph.function[arc])
        here = (int(graph.node[arc]), split_vm(vm, max_vms)[1], function)
        if function < 0:
            if graph.link[arc] >= 0:
                steps.append((here[0], 0, None))  # forwarding names a VM too, the first will do
        elif graph.steps[arc] == 0:
            steps[-1] = here  # placed by the hop that came here
        else:
            steps.append(here)
    return Embedding(
        steps=tuple(steps),
        placements=tuple((node, vm) for node, vm, function in steps if function is not None),
        cost=float(graph.cost[path].sum()),
        delay=float(graph.delay[path].sum()),
    )


def _path(graph: LayeredGraph, used: np.ndarray) -> list[int]:
    """A simple source-sink path among the arcs in use.

    Loops, attached to the path or not, cost something and are left out: an optimum has none unless prices are 0.
    """
    leaving: dict[int, list[int]] = {}
    for arc in used:
        leaving.setdefault(int(graph.tail[arc]), []).append(int(arc))
    came_by: dict[int, int] = {graph.source: -1}
    queue = [graph.source]
    for state in queue:  # grows while it is read: breadth first
        for arc in leaving.get(state, []):
            head = int(graph.head[arc])
            if head not in came_by:
                came_by[head] = arc
                queue.append(head)
    path: list[int] = []
    state = graph.sink
    while state != graph.source:
        path.append(came_by[state])
        state = int(graph.tail[path[-1]])
    return path[::-1]
