"""The graph behind both integer programmes: nodes of the network x functions placed so far.

A walk that carries a request from its ingress to its egress and places its chain on the way is a path through this
graph: a link arc stays in a layer, a placement arc leads one layer up. Link arcs of different layers are different
arcs, so a walk may cross a link many times while a path through the graph crosses each arc once.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from nfv_torchrl.codec import vm_resource
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.steps import fits, link_cost, link_delay, vm_cost, vm_delay
from nfv_torchrl.simulator.tables import Rules

Form = Literal["walk", "problem"]
"""``walk``: what an agent can do. ``problem``: the paper's optimisation problem, eq. (main_prob)."""


class Request(NamedTuple):
    """Profile (of a service its index) and end nodes of one request, -1 where an end is free."""

    profile: int
    ingress: int
    egress: int

    @classmethod
    def of(cls, world: World, b: int) -> Request:
        """The request that environment b is at."""
        return cls(*(int(world.env[name][b]) for name in cls._fields))


class LayeredGraph(NamedTuple):
    """Arcs of one request's layered graph, A of them. States are numbered 0 .. ``num_states`` - 1."""

    num_states: int
    source: int
    sink: int
    tail: np.ndarray  # int64 [A], state
    head: np.ndarray  # int64 [A], state
    node: np.ndarray  # int64 [A], the network node where the arc ends
    link: np.ndarray  # int64 [A], -1 if no link is crossed
    segment: np.ndarray  # int64 [A], functions placed when a link is crossed, -1 if none is
    vm: np.ndarray  # int64 [A], number of the VM (``codec.vm_resource``), -1 if nothing is placed
    function: np.ndarray  # int64 [A], -1 if nothing is placed
    steps: np.ndarray  # int64 [A], actions the arc stands for
    cost: np.ndarray  # float64 [A], $
    delay: np.ndarray  # float64 [A], ms


class _Arc(NamedTuple):
    tail: int
    head: int
    node: int
    link: int = -1
    segment: int = -1
    vm: int = -1
    function: int = -1
    steps: int = 0


def layered_graph(world: World, b: int, request: Request, form: Form) -> LayeredGraph:
    """Build the graph of one request on what the network of environment b offers now.

    Args:
        world: the simulator's world.
        b: environment.
        request: any request, be it the one that the environment is at or not.
        form: with ``"walk"`` every source-sink path is a walk the mask allows (and every such walk without useless
            loops is a path); with ``"problem"`` placements and routing are free and the rules of a step do not matter.

    Arcs whose link or VM cannot carry the request even once are left out.

    Raises:
        ScenarioError: ``form`` is unknown.
    """
    builder = _Builder(world, b, request)
    if form == "walk":
        builder.add_walk_arcs(world.rules)
    elif form == "problem":
        builder.add_problem_arcs()
    else:
        raise ScenarioError(f"unknown form {form!r}; it is 'walk' or 'problem'")
    return builder.finish()


class _Builder:
    """Collects arcs. A state is (functions placed, node, moved): ``moved`` = has just come over a link.

    The flag is needed by the walk alone: only a hop may carry a placement with it (one function a hop, one action). Two
    states more stand for being off the network, before a free ingress is chosen and after a free egress.
    """

    def __init__(self, world: World, b: int, request: Request) -> None:
        tables, net = world.tables, int(world.env["net"][b])
        self.tables, self.net, self.request = tables, net, request
        self.nodes = int(tables.num_nodes[net])
        self.chain = int(tables.chain_length[request.profile])
        self.loads = tables.load_units[request.profile, : self.chain]
        self.arcs: list[_Arc] = []
        self.max_vms = tables.vm_capacity.shape[2]
        self.vm_offered, self.link_offered = world.ledger.vm_offered[b], world.ledger.link_offered[b]
        self.before = 2 * self.nodes * (self.chain + 1)
        self.after = self.before + 1

    def state(self, placed: int, node: int, moved: bool = False) -> int:
        return (placed * self.nodes + node) * 2 + int(moved)

    def add_walk_arcs(self, rules: Rules) -> None:
        egress = self.request.egress
        self.add_ends()
        for placed in range(self.chain + 1):
            for tail, head, link in self.directed_links(placed):
                # Once at the egress, a walk stays there; it may pass through where functions must not meet.
                if tail != egress or (rules.distinct and placed < self.chain):
                    self.arcs.append(
                        _Arc(self.state(placed, tail), self.state(placed, head, True), head, link, placed, steps=1)
                    )
            for node in range(self.nodes):
                arrived, resting = self.state(placed, node, True), self.state(placed, node)
                self.arcs.append(_Arc(arrived, resting, node))  # forward only
                self.add_placements(arrived, placed, node, steps=0)  # the hop has counted as the step
                if rules.colocation or rules.distinct or node == egress:
                    self.add_placements(resting, placed, node, steps=1)

    def add_problem_arcs(self) -> None:
        self.add_ends()
        for placed in range(self.chain + 1):
            for tail, head, link in self.directed_links(placed):
                self.arcs.append(_Arc(self.state(placed, tail), self.state(placed, head), head, link, placed, steps=1))
            for node in range(self.nodes):
                self.add_placements(self.state(placed, node), placed, node, steps=1)

    def add_ends(self) -> None:
        """Onto the network where the first function stands, and off it with the last one, where ends are free."""
        for node in range(self.nodes):
            if self.request.ingress < 0:
                self.add_placements(self.before, 0, node, steps=1)
            if self.request.egress < 0:
                self.arcs.append(_Arc(self.state(self.chain, node), self.after, node))

    def directed_links(self, segment: int) -> list[tuple[int, int, int]]:
        """Tail, head and link of every direction that can carry a segment."""
        ends, units = self.tables.link_ends[self.net], self.tables.rate_units[self.request.profile, segment]
        links = [link for link in range(int(self.tables.num_links[self.net])) if fits(self.link_offered[link], units)]
        there = [(int(ends[link, 0]), int(ends[link, 1]), link) for link in links]
        return there if self.tables.full_duplex else there + [(v, u, link) for u, v, link in there]

    def add_placements(self, tail: int, placed: int, node: int, steps: int) -> None:
        if placed == self.chain:
            return
        for v in range(int(self.tables.vm_count[self.net, node])):
            if fits(self.vm_offered[node, v], self.loads[placed]).all():
                head = self.state(placed + 1, node)
                self.arcs.append(
                    _Arc(tail, head, node, vm=vm_resource(node, v, self.max_vms), function=placed, steps=steps)
                )

    def finish(self) -> LayeredGraph:
        columns = np.array(self.arcs, dtype=np.int64).reshape(-1, len(_Arc._fields)).T
        arcs = _Arc(*columns)  # type: ignore[arg-type]
        cost, delay = self.charges(arcs)
        return LayeredGraph(
            num_states=self.after + 1,
            source=self.before if self.request.ingress < 0 else self.state(0, self.request.ingress),
            sink=self.after if self.request.egress < 0 else self.state(self.chain, self.request.egress),
            **arcs._asdict(),
            cost=cost,
            delay=delay,
        )

    def charges(self, arcs: _Arc) -> tuple[np.ndarray, np.ndarray]:
        """Cost float64 [A] in $ and delay float64 [A] in ms of every arc."""
        tables, net, profile = self.tables, self.net, self.request.profile
        cost = np.zeros(len(self.arcs))
        delay = np.zeros(len(self.arcs))
        crossing, placing = np.asarray(arcs.link) >= 0, np.asarray(arcs.vm) >= 0
        link, vm = np.asarray(arcs.link)[crossing], np.asarray(arcs.vm)[placing]
        rate = tables.rate[profile, np.asarray(arcs.segment)[crossing]]
        function = np.asarray(arcs.function)[placing]
        cost[crossing] = link_cost(tables.link_unit_cost[net, link], rate)
        delay[crossing] = link_delay(tables.link_delay[net, link], rate, tables.link_speed[net, link])
        unit_cost = tables.vm_unit_cost[net].reshape(-1, tables.load.shape[2])[vm]
        cost[placing] = vm_cost(unit_cost, tables.load[profile, function]).sum(axis=1)
        work = vm_delay(tables.work[profile, function], tables.vm_speed[net].ravel()[vm])
        delay[placing] = tables.fixed_delay[profile, function] + work
        return cost, delay
