"""What it takes to finish the request in hand from where its walk is, on what the network offers now.

Worked out when a request comes: lower bounds on cost, raised cost and delay from every (functions placed, node), and
two exact walks, the cheapest one and the cheapest at raised prices (those of ``priced``). They are kept while the
request lasts. The bounds stay valid, because during a walk the network changes only by what the walk itself takes. A
plan stays the best there is while the walk follows it. A walk that leaves one of the two goes on with the other; where
it leaves both, what is left is searched anew.

All of it follows from the state alone: where nothing is kept (after a checkpoint was loaded, say), the steps so far are
gone through again on the books as they were when the request came.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.menu import STEEPNESS
from nfv_torchrl.planners.priced import PriceRule, raise_prices
from nfv_torchrl.search.cheapest import Scratch, cheapest_walk, cheapest_walk_within, grow_scratch, make_scratch
from nfv_torchrl.search.packing import Packing, fill_packed_cost, make_packing
from nfv_torchrl.search.togo import ToGo, fill_delay_to_go
from nfv_torchrl.search.walks import (
    OVERFLOW,
    Prices,
    Problem,
    encode_walk,
    make_problem,
    unit_costs,
    walk_totals,
)
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.steps import Step, find_link, hop_delay, link_cost, vm_cost, vm_delay
from nfv_torchrl.simulator.tables import Rules, Tables

WAYS = 2
CHEAP, SPARE = 0, 1
"""The two ways to finish: at unit costs, and at raised prices, which spares what is nearly used up."""
NOWHERE = -1
LOOKED = 0
"""What ``look_from`` returns, else OVERFLOW."""


class Kept(NamedTuple):
    """What is known of the request of each of B environments."""

    steps: np.ndarray  # int64 [B], steps of the walk that were gone through, -1: nothing is known
    cursor: np.ndarray  # int64 [B], number of the request
    sign: np.ndarray  # float64 [B, 2], lifetime of the request and running cost before it, which tell requests apart
    path: np.ndarray  # int64 [B, J], those steps
    node: np.ndarray  # int64 [B], where they lead
    placed: np.ndarray  # int64 [B], functions placed by them
    elapsed: np.ndarray  # float64 [B], ms
    spent: np.ndarray  # float64 [B, 2], $, what they cost by way
    least: np.ndarray  # float64 [B], $, least cost of the request when it came; inf: there was no walk
    value: np.ndarray  # float64 [B, 2, F + 1, N], $, bounds on the rest by way
    delay: np.ndarray  # float64 [B, F + 1, N], ms
    vm_price: np.ndarray  # float64 [B, N, V, R], raised
    link_price: np.ndarray  # float64 [B, L]
    plan: np.ndarray  # int64 [B, 2, J], actions of the exact walks
    begins: np.ndarray  # int64 [B, 2], step of the walk that their first action is
    length: np.ndarray  # int64 [B, 2], how many actions; 0: there is none
    total: np.ndarray  # float64 [B, 2, 2], $, whole walk along a plan (first index) by prices; inf: there is none


class Ahead(NamedTuple):
    """``Kept``, and what looking ahead works in; one for each thread."""

    kept: Kept
    exact: bool  # whether exact walks are searched
    price: float  # p of the raised prices, in mean unit costs of the network's VMs
    steepness: float  # M
    mean_cost: np.ndarray  # float64 [S], $ per Mcycles/s, of the first kind of resources
    search: Scratch
    packing: Packing
    vm_offered: np.ndarray  # int64 [N, V, R], offers on the way
    link_offered: np.ndarray  # int64 [L]


def check_ahead(rules: Rules) -> None:
    """Refuse rules by which the rest of a walk depends on more than where it is.

    Raises:
        ScenarioError: functions of a request must not share nodes.
    """
    if rules.distinct:
        raise ScenarioError(
            "network: looking ahead does not know placement=distinct, where the rest of a walk depends on all nodes "
            "used so far; use preset=mlp or network=candidate"
        )


def make_ahead(world: World, *, exact: bool, price: float, steepness: float) -> Ahead:
    """``Ahead`` for the environments of ``world``, nothing known yet.

    Raises:
        ScenarioError: see ``check_ahead``.
    """
    check_ahead(world.rules)
    tables, batch, most = world.tables, len(world.env), world.rules.max_steps
    _, nodes, vms, kinds = tables.vm_capacity.shape
    links, functions = tables.link_capacity.shape[1], tables.load.shape[1]
    kept = Kept(
        steps=np.full(batch, NOWHERE),
        cursor=np.zeros(batch, np.int64),
        sign=np.zeros((batch, 2)),
        path=np.zeros((batch, most), np.int64),
        node=np.zeros(batch, np.int64),
        placed=np.zeros(batch, np.int64),
        elapsed=np.zeros(batch),
        spent=np.zeros((batch, WAYS)),
        least=np.full(batch, np.inf),
        value=np.zeros((batch, WAYS, functions + 1, nodes)),
        delay=np.zeros((batch, functions + 1, nodes)),
        vm_price=np.zeros((batch, nodes, vms, kinds)),
        link_price=np.zeros((batch, links)),
        plan=np.zeros((batch, WAYS, most), np.int64),
        begins=np.zeros((batch, WAYS), np.int64),
        length=np.zeros((batch, WAYS), np.int64),
        total=np.full((batch, WAYS, WAYS), np.inf),
    )
    return Ahead(
        kept=kept,
        exact=bool(exact),
        price=float(price),
        steepness=float(steepness),
        mean_cost=tables.vm_unit_cost[..., 0].sum(axis=(1, 2)) / np.maximum(tables.vm_count.sum(axis=1), 1),
        search=make_scratch(tables),
        packing=make_packing(functions, vms, kinds),
        vm_offered=np.zeros((nodes, vms, kinds), np.int64),
        link_offered=np.zeros(links, np.int64),
    )


class Looking:
    """Keeps ``Ahead`` up to date with the environments of a simulator.

    Args:
        exact: search exact walks; False: bounds alone.
        price: p of the raised prices, in mean unit costs of the network's VMs.
        steepness: M, how late they rise.

    Attributes:
        ahead: what is known, after ``look``.
    """

    ahead: Ahead

    def __init__(self, *, exact: bool, price: float, steepness: float = STEEPNESS) -> None:
        self.exact, self.price, self.steepness = exact, price, steepness
        self._tables: Tables | None = None
        self._env: np.ndarray | None = None

    def look(self, world: World) -> Ahead:
        """Look ahead from where the walks are now.

        Raises:
            ScenarioError: see ``check_ahead``.
        """
        self.prepare(world)
        done = 0
        while True:
            done = look_ahead(world, done, self.ahead)
            if done == len(world.env):
                return self.ahead
            self.grow(world)

    def prepare(self, world: World) -> None:
        """Make ``ahead`` for these environments, unless it is theirs already.

        Raises:
            ScenarioError: see ``check_ahead``.
        """
        # Loading a state makes new records of the environments: what was known of those before is not true of them.
        if self._tables is not world.tables or self._env is not world.env:
            self.ahead = make_ahead(world, exact=self.exact, price=self.price, steepness=self.steepness)
            self._tables, self._env = world.tables, world.env

    def grow(self, world: World) -> None:
        """Give the searches more memory."""
        self.ahead = self.ahead._replace(search=grow_scratch(world.tables, self.ahead.search))


@kernel
def look_ahead(world, first, own):
    """Bring what is known of the requests in hand up to date, from environment ``first`` on.

    Returns:
        The environment at which the scratch became too small, or B.
    """
    for b in range(first, world.env.shape[0]):
        if world.env[b].done == 0 and look_from(world, b, own) == OVERFLOW:
            return b
    return world.env.shape[0]


@part
def look_from(world, b, own):
    """The same for one environment, not past its horizon; LOOKED, or OVERFLOW where the scratch is too small."""
    found = _look(world, b, own)
    if found == OVERFLOW:
        own.kept.steps[b] = NOWHERE
    return found


@part
def _look(world, b, own):
    kept, search = own.kept, False
    if not _is_known(world, b, kept):
        _begin(world, b, own)
        search = True
    while True:
        if search:
            for way in range(WAYS):
                if _plan(world, b, own, way) == OVERFLOW:
                    return OVERFLOW
        if kept.steps[b] == 0:
            kept.least[b] = kept.total[b, CHEAP, CHEAP] if own.exact else _least_bound(world, b, own)
        if kept.steps[b] == world.env[b].steps:
            return LOOKED
        search = _go_on(world, b, own)


@part
def _is_known(world, b, kept):
    """Whether what is kept is of this request and of a walk that has gone on since."""
    e = world.env[b]
    if e.steps == 0 or kept.steps[b] == NOWHERE or kept.cursor[b] != e.cursor or kept.steps[b] > e.steps:
        return False
    same = kept.sign[b, 0] == e.lifetime and kept.sign[b, 1] == e.running_cost
    for k in range(kept.steps[b]):
        same = same and kept.path[b, k] == world.walk.action[b, k]
    return same


@part
def _set_offers(world, b, own, steps):
    """What VMs and links offered after the first ``steps`` steps of the walk, into ``own``."""
    tables, ledger, e = world.tables, world.ledger, world.env[b]
    nodes, vms, kinds = own.vm_offered.shape
    for node in range(nodes):
        for vm in range(vms):
            for kind in range(kinds):
                own.vm_offered[node, vm, kind] = ledger.vm_offered[b, node, vm, kind]
    for link in range(own.link_offered.size):
        own.link_offered[link] = ledger.link_offered[b, link]
    here, placed = e.ingress, 0
    for k in range(e.steps):
        node, vm, places = decode_action(np.int64(world.walk.action[b, k]), vms)
        places = places and placed < tables.chain_length[e.profile]
        if k >= steps:
            if here >= 0 and here != node:
                own.link_offered[find_link(tables, e.net, here, node)] += tables.rate_units[e.profile, placed]
            if places:
                for kind in range(kinds):
                    own.vm_offered[node, vm, kind] += tables.load_units[e.profile, placed, kind]
        placed += places
        here = node


@part
def _prices(world, b, own, way):
    """``Prices`` of a way."""
    if way == CHEAP:
        return unit_costs(world, b)
    return Prices(own.kept.vm_price[b], own.kept.link_price[b])


@part
def _begin(world, b, own):
    """Bounds of a request that has just come."""
    kept, e = own.kept, world.env[b]
    kept.steps[b] = 0
    kept.cursor[b] = e.cursor
    kept.sign[b, 0], kept.sign[b, 1] = e.lifetime, e.running_cost
    kept.node[b], kept.placed[b], kept.elapsed[b] = e.ingress, 0, 0.0
    kept.spent[b, :] = 0.0
    _set_offers(world, b, own, 0)
    rule = PriceRule(own.price * own.mean_cost[e.net], own.steepness, np.inf)
    raise_prices(world.tables, e.net, rule, (own.vm_offered, own.link_offered), _prices(world, b, own, SPARE))
    for way in range(WAYS):
        problem = _rest_of(world, b, own, way)
        fill_packed_cost(problem, _into(own, kept.value[b, way]), own.packing)
        if way == CHEAP:
            fill_delay_to_go(problem, _into(own, kept.delay[b]))


@part
def _into(own, value):
    """Scratch for bounds that are written to ``value``."""
    some = own.search.cost
    return ToGo(
        value,
        some.node,
        some.link,
        some.places,
        some.link_weight,
        some.place_weight,
        some.place_vm,
        some.barred,
        some.entering,
        some.queue,
        some.queued,
    )


@part
def _least_bound(world, b, own):
    """The bound on the cost of a request that has just come, $."""
    value, e = own.kept.value[b, CHEAP], world.env[b]
    if e.ingress >= 0:
        return value[0, e.ingress]
    least = np.inf  # a free ingress: the first function stands anywhere, and costs nothing in this bound
    for node in range(world.tables.num_nodes[e.net]):
        least = min(least, value[1, node])
    return least


@part
def _rest_of(world, b, own, way):
    """What is left of the request, as a request: from where the walk is, with the functions that are not placed."""
    kept = own.kept
    whole = make_problem(world, b, _prices(world, b, own, way))
    placed = kept.placed[b]
    return Problem(
        whole.net,
        whole.nodes,
        whole.links,
        whole.functions - placed,
        whole.kinds,
        kept.node[b],
        whole.egress,
        whole.colocation,
        whole.distinct,
        whole.full_duplex,
        whole.one_rate,
        whole.budget - kept.elapsed[b],
        whole.max_steps - kept.steps[b],
        whole.rate[placed:],
        whole.rate_units[placed:],
        whole.load[placed:],
        whole.load_units[placed:],
        whole.work[placed:],
        whole.fixed_delay[placed:],
        whole.degree,
        whole.neighbour,
        whole.neighbour_link,
        whole.vm_count,
        whole.vm_speed,
        whole.link_delay,
        whole.link_speed,
        whole.delay_to,
        own.vm_offered,
        own.link_offered,
        whole.vm_price,
        whole.link_price,
    )


@part
def _plan(world, b, own, way):
    """Search the exact walk of a way from where the walk is; ``own`` holds the offers there."""
    kept = own.kept
    kept.begins[b, way] = kept.steps[b]
    kept.length[b, way] = 0
    kept.total[b, way, :] = np.inf
    if not own.exact or (way == SPARE and kept.length[b, CHEAP] == 0):  # no walk is none at any prices
        return LOOKED
    problem = _rest_of(world, b, own, way)
    if way == CHEAP and kept.steps[b] == 0:  # as myopic_optimal searches it, so that of equal walks it is the same
        steps = cheapest_walk(problem, own.search)
    else:
        bounds = kept.value[b, way, kept.placed[b] :]
        steps = cheapest_walk_within(problem, own.search, bounds, kept.delay[b, kept.placed[b] :])
    if steps == OVERFLOW:
        return OVERFLOW
    kept.length[b, way] = steps
    if steps > 0:
        encode_walk(own.search.walk, steps, problem.vm_offered.shape[1], kept.plan[b, way])
        for by in range(WAYS):
            rest = walk_totals(problem, _prices(world, b, own, by), own.search.walk, steps)[0]
            kept.total[b, way, by] = kept.spent[b, by] + rest
    return LOOKED


@part
def _go_on(world, b, own):
    """Go through the next step of the walk; whether it has left both plans, so that they have to be searched anew."""
    kept = own.kept
    at = kept.steps[b]
    action = np.int64(world.walk.action[b, at])
    step = step_of(world, b, kept, action)
    for by in range(WAYS):
        kept.spent[b, by] += price_of(world, b, own, step, by)
    kept.elapsed[b] += delay_of(world, b, kept, step)
    kept.path[b, at] = action
    kept.node[b] = step.node
    kept.placed[b] += step.places
    kept.steps[b] = at + 1
    on_cheap, on_spare = next_action(kept, b, CHEAP, at) == action, next_action(kept, b, SPARE, at) == action
    if on_cheap != on_spare:  # there is only one plan left, which is as good as any while the walk follows it
        _copy_plan(kept, b, CHEAP if on_cheap else SPARE, SPARE if on_cheap else CHEAP)
    # What cannot be finished now cannot be finished later either.
    if on_cheap or on_spare or kept.length[b, CHEAP] == 0:
        return False
    _set_offers(world, b, own, at + 1)
    return True


@part
def _copy_plan(kept, b, one, other):
    """Make the plan of way ``one`` that of way ``other``, too."""
    kept.begins[b, other], kept.length[b, other] = kept.begins[b, one], kept.length[b, one]
    for k in range(kept.length[b, one]):
        kept.plan[b, other, k] = kept.plan[b, one, k]
    for by in range(WAYS):
        kept.total[b, other, by] = kept.total[b, one, by]


@part
def next_action(kept, b, way, at):
    """What the plan of a way does as step ``at`` of the walk, -1 if there is no plan."""
    k = at - kept.begins[b, way]
    return kept.plan[b, way, k] if 0 <= k < kept.length[b, way] else np.int64(NOWHERE)


@part
def step_of(world, b, kept, action):
    """An action other than reject as a ``Step`` from where the walk is."""
    tables, e = world.tables, world.env[b]
    node, vm, places = decode_action(action, world.ledger.vm_offered.shape[2])
    here = kept.node[b]
    link = np.int64(-1) if node == here or here < 0 else find_link(tables, e.net, here, node)
    # With ``switches`` an action that places may come when nothing is left to place: it forwards then.
    return Step(link, node, vm, places and kept.placed[b] < tables.chain_length[e.profile])


@part
def price_of(world, b, own, step, by):
    """$ of the next step of the walk, at the prices of a way."""
    tables, placed, profile = world.tables, own.kept.placed[b], world.env[b].profile
    prices = _prices(world, b, own, by)
    cost = 0.0
    if step.link >= 0:
        cost += link_cost(prices.link[step.link], tables.rate[profile, placed])
    if step.places:
        for kind in range(tables.load.shape[2]):
            cost += vm_cost(prices.vm[step.node, step.vm, kind], tables.load[profile, placed, kind])
    return cost


@part
def delay_of(world, b, kept, step):
    """Delay of the same step, ms."""
    tables, placed, e = world.tables, kept.placed[b], world.env[b]
    delay = 0.0
    if step.link >= 0:
        delay = hop_delay(tables, e.net, e.profile, placed, step.link)
    if step.places:
        work = vm_delay(tables.work[e.profile, placed], tables.vm_speed[e.net, step.node, step.vm])
        delay += tables.fixed_delay[e.profile, placed] + work
    return delay
