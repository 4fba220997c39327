"""``learned_prices``: the exact search of each request at prices that a network sets, and a learned refusal.

The same small functions price every VM and every link from what can be seen of it, of the network as a whole and of
the request; the label search of ``myopic_optimal`` then finds the cheapest walk at unit cost plus price, and a third
function says whether that walk is worth having. With all three at zero this is ``myopic_optimal``, so learning starts
there. The functions see shares and ratios only, so one set of weights serves networks of any size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.columns import columns
from nfv_torchrl.planners.base import ExactPlanner, over_rows
from nfv_torchrl.scenario.units import LEDGER_UNITS
from nfv_torchrl.search.cheapest import Scratch, grow_scratch, plan_cheapest
from nfv_torchrl.search.playing import FINISHED, NO_ROOM, has_room, play_plan
from nfv_torchrl.search.walks import OVERFLOW, Prices
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import inlined, kernel, part
from nfv_torchrl.simulator.slots import used_vm_share
from nfv_torchrl.simulator.tables import Tables


class VmFeatures(NamedTuple):
    """What the price of a VM is a function of."""

    used: int  # share of the VM that is used now
    used_pow4: int
    used_pow16: int
    short: int  # r / (r + free), r the reference load: near 1 when less than a usual request is left
    tight: int  # d / (d + free), d the load of this request's largest function
    node_used: int  # used share of all VMs of the node
    network_used: int  # used share of all VMs
    dear: int  # unit cost over the network's mean, less 1
    load: int  # log of the chain's load over the reference load, halved
    lifetime: int  # log of the lifetime over the mean lifetime; 0 where lifetimes are hidden
    colocation: int  # 1 where functions may share a node


VM = columns(VmFeatures)
VM_FEATURES = VmFeatures._fields


class LinkFeatures(NamedTuple):
    """What the price of a link is a function of."""

    used: int
    used_pow4: int
    used_pow16: int
    tight: int  # rate / (rate + free)
    network_used: int  # used share of all links
    load: int
    lifetime: int


LINK = columns(LinkFeatures)
LINK_FEATURES = LinkFeatures._fields


class AdmitFeatures(NamedTuple):
    """What the refusal of a request is a function of."""

    priced: int  # log of the walk's priced cost over that of the reference load at the price unit, over 3
    true: int  # the same of its true cost
    tightest: int  # largest d / (d + free) over the VMs of the walk, free being what it leaves there
    network_used: int
    network_used_pow4: int
    links_used: int  # used share of all links
    load: int
    lifetime: int
    colocation: int


ADMIT = columns(AdmitFeatures)
ADMIT_FEATURES = AdmitFeatures._fields
MOST_FEATURES = max(len(VM_FEATURES), len(LINK_FEATURES), len(ADMIT_FEATURES))
LEAST_RATIO = 1e-9
"""Of the load of a chain to a usual one's, for chains that take next to nothing."""
LONGEST = 20.0
"""Lifetimes are seen up to this multiple of their mean, and from one 400th of it."""


class Head(NamedTuple):
    """f(x) = linear . (x, 1) + sum over h of out[h] tanh(hidden[h] . (x, 1))."""

    linear: np.ndarray  # float64 [F + 1]
    hidden: np.ndarray  # float64 [H, F + 1]
    out: np.ndarray  # float64 [H]


class PriceWeights(NamedTuple):
    """The three functions.

    A VM or link costs max(0, f) price units times its used share above its unit cost: an empty one costs what it costs.
    A price unit is ``unit`` times the mean unit cost of the network's VMs. A request with f > 1 is refused: weights
    near zero refuse hardly anything.
    """

    vm: Head
    link: Head
    admit: Head
    unit: float


class Measures(NamedTuple):
    """What the functions measure with, fixed during a run.

    Of several kinds of resources, each has its own numbers; what is said of a request is said of the kind of which its
    chain takes the largest share of what usual chains take.
    """

    reference_load: np.ndarray  # float64 [R], r, Mcycles/s: mean over profiles of the load of their chain
    reference_units: np.ndarray  # float64 [R], the same in ledger units
    mean_cost: np.ndarray  # float64 [S, R], $ per Mcycles/s: mean unit cost of VMs
    chain_load: np.ndarray  # float64 [P, R], Mcycles/s
    largest_units: np.ndarray  # int64 [P, R], ledger units of the largest function


class LearnedScratch(NamedTuple):
    """Scratch memory of the planner, one for each thread."""

    weights: PriceWeights
    measures: Measures
    search: Scratch
    x: np.ndarray  # float64 [MOST_FEATURES]
    request: np.ndarray  # float64 [2]: what all three functions see of the request in hand


class RequestFeatures(NamedTuple):
    """What all three functions see of the request in hand."""

    load: int
    lifetime: int


REQUEST = columns(RequestFeatures)


def measures_of(tables: Tables) -> Measures:
    """``Measures`` of networks and services."""
    chain = tables.load.sum(axis=1)
    counts = tables.vm_count.sum(axis=1)
    return Measures(
        reference_load=np.maximum([column.mean() for column in chain.T], 1 / LEDGER_UNITS),
        reference_units=np.maximum([column.mean() for column in tables.load_units.sum(axis=1).T], 1.0),
        mean_cost=tables.vm_unit_cost.sum(axis=(1, 2)) / np.maximum(counts, 1)[:, None],
        chain_load=chain,
        largest_units=tables.load_units.max(axis=1),
    )


@inlined
def _value(head, x):
    features = head.linear.size - 1
    total = head.linear[features]
    for k in range(features):
        total += head.linear[k] * x[k]
    for h in range(head.out.size):
        inner = head.hidden[h, features]
        for k in range(features):
            inner += head.hidden[h, k] * x[k]
        total += head.out[h] * np.tanh(inner)
    return total


@inlined
def _powers(x, at, used):
    """Fill the used share and its powers; ``at``: the columns of a VM or of a link."""
    x[at.used] = used
    square = used * used
    x[at.used_pow4] = square * square
    fourth = x[at.used_pow4] * x[at.used_pow4]
    x[at.used_pow16] = fourth * fourth


@part
def _describe_request(world, b, own):
    """Fill the features of the request itself."""
    e, measures = world.env[b], own.measures
    ratio = measures.chain_load[e.profile, 0] / measures.reference_load[0]
    for kind in range(1, measures.reference_load.size):
        ratio = max(ratio, measures.chain_load[e.profile, kind] / measures.reference_load[kind])
    own.request[REQUEST.load] = 0.5 * np.log(max(ratio, LEAST_RATIO))
    own.request[REQUEST.lifetime] = 0.0
    mean = world.mean_lifetime[b]
    if mean > 0.0:
        own.request[REQUEST.lifetime] = np.log(min(max(e.lifetime / mean, 0.05 / LONGEST), LONGEST))


@part
def _price_vms(world, b, own, vm_price):
    """Fill ``vm_price`` [N, V, R], $ per Mcycles/s or unit of the kind."""
    tables, e = world.tables, world.env[b]
    for kind in range(tables.vm_capacity.shape[3]):
        for node in range(tables.num_nodes[e.net]):
            _price_node(world, b, own, node, kind, vm_price)


@part
def _price_node(world, b, own, node, kind, vm_price):
    """The prices of one kind on the VMs of ``node``."""
    tables, e, measures, x = world.tables, world.env[b], own.measures, own.x
    offered = world.ledger.vm_offered
    net = e.net
    largest = measures.largest_units[e.profile, kind]
    network_used = world.ledger.vm_used[b, kind] / tables.vm_total[net, kind]
    free, total = np.int64(0), np.int64(0)
    for vm in range(tables.vm_count[net, node]):
        free += offered[b, node, vm, kind]
        total += tables.vm_capacity[net, node, vm, kind]
    for vm in range(tables.vm_count[net, node]):
        here = offered[b, node, vm, kind]
        _powers(x, VM, 1.0 - here / tables.vm_capacity[net, node, vm, kind])
        x[VM.short] = measures.reference_units[kind] / (measures.reference_units[kind] + here)
        x[VM.tight] = largest / max(largest + here, 1)
        x[VM.node_used] = 1.0 - free / total
        x[VM.network_used] = network_used
        x[VM.dear] = tables.vm_unit_cost[net, node, vm, kind] / measures.mean_cost[net, kind] - 1.0
        x[VM.load] = own.request[REQUEST.load]
        x[VM.lifetime] = own.request[REQUEST.lifetime]
        x[VM.colocation] = 1.0 if world.rules.colocation else 0.0
        rise = x[VM.used] * max(_value(own.weights.vm, x), 0.0) * own.weights.unit * measures.mean_cost[net, kind]
        vm_price[node, vm, kind] = tables.vm_unit_cost[net, node, vm, kind] + rise


@part
def _price_links(world, b, own, link_price):
    """Fill ``link_price`` [L], $ per Mbit/s."""
    tables, e, x = world.tables, world.env[b], own.x
    offered = world.ledger.link_offered
    net = e.net
    rate = np.int64(0)
    for segment in range(tables.chain_length[e.profile] + 1):
        rate = max(rate, tables.rate_units[e.profile, segment])
    network_used = e.link_used / tables.link_total[net]
    for link in range(tables.num_links[net]):
        here = offered[b, link]
        _powers(x, LINK, 1.0 - here / tables.link_capacity[net, link])
        x[LINK.tight] = rate / max(rate + here, 1)
        x[LINK.network_used] = network_used
        x[LINK.load] = own.request[REQUEST.load]
        x[LINK.lifetime] = own.request[REQUEST.lifetime]
        rise = x[LINK.used] * max(_value(own.weights.link, x), 0.0) * own.weights.unit * own.measures.mean_cost[net, 0]
        link_price[link] = tables.link_unit_cost[net, link] + rise


@part
def _tightest(world, b, measures, steps, plan):
    """Largest d / (d + free) over the VMs that the plan uses: d of the largest function, free what the plan leaves."""
    tables, e = world.tables, world.env[b]
    vms = world.ledger.vm_offered.shape[2]
    worst = 0.0
    function = 0
    for k in range(steps):
        node, vm, places = decode_action(plan[k], vms)
        if not places:
            continue
        for kind in range(tables.load_units.shape[2]):
            largest = measures.largest_units[e.profile, kind]
            free = world.ledger.vm_offered[b, node, vm, kind] - tables.load_units[e.profile, function, kind]
            worst = max(worst, largest / max(largest + max(free, 0), 1))
        function += 1
    return worst


@part
def _refuses(world, b, own, steps, plan):
    """Whether the walk just found is not worth having."""
    tables, e, measures = world.tables, world.env[b], own.measures
    x, result = own.x, own.search.result
    unit = own.weights.unit * measures.mean_cost[e.net, 0] * measures.reference_load[0]
    used = used_vm_share(world, b)
    x[ADMIT.priced] = np.log(result[0] / unit + 1e-9) / 3.0
    x[ADMIT.true] = np.log(result[1] / unit + 1e-9) / 3.0
    x[ADMIT.tightest] = _tightest(world, b, measures, steps, plan)
    x[ADMIT.network_used] = used
    x[ADMIT.network_used_pow4] = used * used * used * used
    x[ADMIT.links_used] = e.link_used / tables.link_total[e.net]
    x[ADMIT.load] = own.request[REQUEST.load]
    x[ADMIT.lifetime] = own.request[REQUEST.lifetime]
    x[ADMIT.colocation] = 1.0 if world.rules.colocation else 0.0
    return _value(own.weights.admit, x) > 1.0


@part
def plan_learned(world, b, own, plan):
    """Plan the request of environment b.

    Args:
        world: the simulator's ``World``; only read.
        b: environment.
        own: ``LearnedScratch`` of the world's tables.
        plan: receives the actions, int64 [max_steps].

    Returns:
        Number of actions, 0 if infeasible or refused, OVERFLOW (-1) if the scratch must grow.
    """
    prices = Prices(own.search.vm_price, own.search.link_price)
    _describe_request(world, b, own)
    _price_vms(world, b, own, prices.vm)
    _price_links(world, b, own, prices.link)
    steps = plan_cheapest(world, b, prices, own.search, plan)
    if steps > 0 and _refuses(world, b, own, steps, plan):
        return 0
    return steps


@kernel
def play_learned(world, b, own, plan, costs):
    """Answer the requests of environment b by ``plan_learned`` to the end of its horizon.

    ``costs`` float64 [R] receives what each cost ($), NaN if it was not accepted. Returns FINISHED, NO_ROOM if the
    simulator's pools run low, or OVERFLOW if the scratch must grow; call again to go on.
    """
    e = world.env[b]
    while e.done == 0:
        if not has_room(world, b):
            return NO_ROOM
        steps = plan_learned(world, b, own, plan)
        if steps == OVERFLOW:
            return OVERFLOW
        request = e.cursor
        costs[request] = play_plan(world, b, steps, plan)
    return FINISHED


class LearnedPrices(ExactPlanner):
    """Plans requests, or plays whole horizons in one compiled call.

    Args:
        weights: of the three functions, such as ``PriceNetwork.weights()``.
        labels: limit on the search for one request, see ``ExactPlanner``. None: no limit.

    Raises:
        ScenarioError: labels < 1.
    """

    own: LearnedScratch
    kernel = over_rows(plan_learned)

    def __init__(self, weights: PriceWeights, *, labels: int | None = None) -> None:
        super().__init__(labels)
        self.weights = weights

    def make(self, tables: Tables) -> LearnedScratch:
        """See ``CompiledPlanner``."""
        scratch = np.zeros(MOST_FEATURES), np.zeros(len(REQUEST))
        return LearnedScratch(self.weights, measures_of(tables), self.make_search(tables), *scratch)

    def grow(self, tables: Tables) -> LearnedScratch:
        """See ``CompiledPlanner``."""
        return self.own._replace(search=grow_scratch(tables, self.own.search))

    def play(self, simulator: Simulator, b: int, costs: np.ndarray) -> None:
        """Answer all requests of environment b, compiled; ``costs`` as in ``play_learned``."""
        self.prepare(simulator.world)
        plan = np.zeros(simulator.world.rules.max_steps, np.int64)
        while (outcome := play_learned(simulator.world, b, self.own, plan, costs)) != FINISHED:
            if outcome == NO_ROOM:
                simulator.make_room_for(b)
            else:
                self.own = self.grow(simulator.tables)
