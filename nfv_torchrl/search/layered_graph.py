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
from nfv_torchrl.simulator.steps import fits, link_cost, vm_cost, vm_delay

Form = Literal["walk", "problem"]
"""``walk``: what an agent can do. ``problem``: the paper's optimisation problem, eq. (main_prob)."""


class Request(NamedTuple):
    """Type index and end nodes of one request."""

    service: int
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
        ScenarioError: ingress and egress are the same node, or ``form`` is unknown.
    """
    if request.ingress == request.egress:
        raise ScenarioError(f"a request needs two different end nodes; both are node {request.ingress}")
    builder = _Builder(world, b, request)
    if form == "walk":
        builder.add_walk_arcs(world.rules.colocation)
    elif form == "problem":
        builder.add_problem_arcs()
    else:
        raise ScenarioError(f"unknown form {form!r}; it is 'walk' or 'problem'")
    return builder.finish()


class _Builder:
    """Collects arcs. A state is (functions placed, node, moved): ``moved`` = has just come over a link.

    The flag is needed by the walk alone: only a hop may carry a placement with it (one function a hop, one action).
    """

    def __init__(self, world: World, b: int, request: Request) -> None:
        tables, net = world.tables, int(world.env["net"][b])
        self.tables, self.net, self.request = tables, net, request
        self.nodes = int(tables.num_nodes[net])
        self.chain = int(tables.chain_length[request.service])
        self.loads = tables.load_units[request.service, : self.chain]
        self.arcs: list[_Arc] = []
        self.max_vms = tables.vm_capacity.shape[2]
        self.vm_offered, link_offered = world.ledger.vm_offered[b], world.ledger.link_offered[b]
        links = range(int(tables.num_links[net]))
        self.links = [link for link in links if fits(link_offered[link], tables.rate_units[request.service])]

    def state(self, placed: int, node: int, moved: bool = False) -> int:
        return (placed * self.nodes + node) * 2 + int(moved)

    def add_walk_arcs(self, colocation: bool) -> None:
        egress = self.request.egress
        for placed in range(self.chain + 1):
            for tail, head, link in self.directed_links():
                if tail != egress:  # once at the egress, a walk stays there
                    self.arcs.append(
                        _Arc(self.state(placed, tail), self.state(placed, head, True), head, link, steps=1)
                    )
            for node in range(self.nodes):
                arrived, resting = self.state(placed, node, True), self.state(placed, node)
                self.arcs.append(_Arc(arrived, resting, node))  # forward only
                self.add_placements(arrived, placed, node, steps=0)  # the hop has counted as the step
                if colocation or node == egress:
                    self.add_placements(resting, placed, node, steps=1)

    def add_problem_arcs(self) -> None:
        for placed in range(self.chain + 1):
            for tail, head, link in self.directed_links():
                self.arcs.append(_Arc(self.state(placed, tail), self.state(placed, head), head, link, steps=1))
            for node in range(self.nodes):
                self.add_placements(self.state(placed, node), placed, node, steps=1)

    def directed_links(self) -> list[tuple[int, int, int]]:
        ends = self.tables.link_ends[self.net]
        there = [(int(ends[link, 0]), int(ends[link, 1]), link) for link in self.links]
        return there + [(v, u, link) for u, v, link in there]

    def add_placements(self, tail: int, placed: int, node: int, steps: int) -> None:
        if placed == self.chain:
            return
        for v in range(int(self.tables.vm_count[self.net, node])):
            if fits(self.vm_offered[node, v], self.loads[placed]):
                head = self.state(placed + 1, node)
                self.arcs.append(
                    _Arc(tail, head, node, vm=vm_resource(node, v, self.max_vms), function=placed, steps=steps)
                )

    def finish(self) -> LayeredGraph:
        columns = np.array(self.arcs, dtype=np.int64).reshape(-1, len(_Arc._fields)).T
        arcs = _Arc(*columns)  # type: ignore[arg-type]
        cost, delay = self.charges(arcs)
        return LayeredGraph(
            num_states=2 * self.nodes * (self.chain + 1),
            source=self.state(0, self.request.ingress),
            sink=self.state(self.chain, self.request.egress),
            **arcs._asdict(),
            cost=cost,
            delay=delay,
        )

    def charges(self, arcs: _Arc) -> tuple[np.ndarray, np.ndarray]:
        """Cost float64 [A] in $ and delay float64 [A] in ms of every arc."""
        tables, net, service = self.tables, self.net, self.request.service
        cost = np.zeros(len(self.arcs))
        delay = np.zeros(len(self.arcs))
        crossing, placing = np.asarray(arcs.link) >= 0, np.asarray(arcs.vm) >= 0
        link, vm = np.asarray(arcs.link)[crossing], np.asarray(arcs.vm)[placing]
        load = tables.load[service, np.asarray(arcs.function)[placing]]
        cost[crossing] = link_cost(tables.link_unit_cost[net, link], tables.rate[service])
        delay[crossing] = tables.hop_delay[net, service, link]
        cost[placing] = vm_cost(tables.vm_unit_cost[net].ravel()[vm], load)
        delay[placing] = vm_delay(load, tables.vm_speed[net].ravel()[vm])
        return cost, delay
