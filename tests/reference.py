"""A slow, obvious simulator to hold the compiled one against: dictionaries, whole numbers, no arrays, no shared code.

It follows Algorithm 3 of the paper line by line for a single network. Amounts are whole bit/s and cycles/s, delays are
in ms and costs in $. Read it to learn what the model is; do not read the compiled simulator while changing it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction

TOLERANCE_MS = 1e-9

LINK_CAPACITY = "link_capacity"
VM_CAPACITY = "vm_capacity"
DELAY = "delay"
STEP_LIMIT = "step_limit"
NO_FEASIBLE_ACTION = "no_feasible_action"
REJECTED_BY_POLICY = "rejected_by_policy"
INVALID_ACTION = "invalid_action"


def units(*factors) -> int:
    """The product of decimal numbers in Mbit/s or Mcycles/s, as whole bit/s or cycles/s."""
    product = Fraction(10**6)
    for factor in factors:
        product *= Fraction(repr(float(factor)))
    return round(product)


def decode(action: int, vms: int) -> tuple[int, int, bool]:
    """(node, VM, place?) of an action that is not ``reject``."""
    node, rest = divmod(action, 2 * vms)
    return node, rest // 2, rest % 2 == 1


@dataclass
class Service:
    """One profile, such as a service type: what each function of its chain takes of each kind of resources."""

    kind: int  # the type it counts as
    rates: list[float]  # Mbit/s, of each segment
    rate_units: list[int]
    loads: list[list[float]]  # Mcycles/s or the unit of the kind, in the order of the chain
    load_units: list[list[int]]
    work: list[float]  # Mcycles/s that set the processing delay
    own_delay: list[float]  # ms beside it
    tolerable_delay: float  # ms


@dataclass
class Request:
    """One arrival, and what it holds while it runs."""

    index: int
    slot: int
    service: int  # its profile
    ingress: int | None  # None: free
    egress: int | None
    departure: int
    time: float  # s, when it arrives
    leaves: float  # s, before all that arrive then or later
    vm_use: dict = field(default_factory=dict)  # (node, vm, kind) -> whole units
    link_use: dict = field(default_factory=dict)  # (tail, head), of a shared link tail < head -> bit/s
    cost: float = 0.0
    steps: list = field(default_factory=list)  # [node, vm, function index or None]
    interrupted_at: int | None = None


class ReferenceSimulator:
    """One network, one workload, one action a step.

    ``timeline`` is a failure timeline (``slot``, ``resource``, ``up``, in the order applied) or None.
    """

    def __init__(self, scenario, workload, timeline=None):
        self.scenario = scenario
        self._read_substrate(scenario.substrate)
        self._read_catalogue(scenario.catalogue, workload.own)
        self.requests = [self._read_request(workload, index) for index in range(len(workload.slot))]
        self.events: dict[int, list[tuple[int, bool]]] = {}
        if timeline is not None:
            for slot, resource, up in zip(timeline.slot, timeline.resource, timeline.up, strict=True):
                self.events.setdefault(int(slot), []).append((int(resource), bool(up)))
        # What is reserved now, by running requests and by the walk under way.
        self.vm_reserved = dict.fromkeys(self.vm_capacity, 0)
        self.link_reserved = dict.fromkeys(self.link_capacity, 0)
        self.failed: set = set()  # (node, VM), and links by the names of their directions
        self.steps_of_service: dict[float, int] = {}  # taken in this slot, where services share J
        self.running: list[Request] = []
        self.interrupted: list[Request] = []
        self.slot = 0
        self.cursor = 0
        self.done = False
        self._begin_walk()
        self._open_slot()
        # Phi_t of the slots that passed before the first request came.
        self.slots_closed_at_start = self._advance()

    # ---- what does not change -------------------------------------------------------------------------------------

    def _read_substrate(self, substrate) -> None:
        self.nodes = len(substrate.vm_count)
        self.vms = len(substrate.vm_capacity[0])
        self.kinds = len(substrate.resources)
        self.machines = [(node, vm) for node in range(self.nodes) for vm in range(int(substrate.vm_count[node]))]
        self.vm_capacity, self.vm_speed, self.vm_unit_cost = {}, {}, {}
        for node, vm in self.machines:
            self.vm_speed[node, vm] = float(substrate.vm_capacity[node][vm])
            for kind in range(self.kinds):
                first = kind == 0
                capacity = substrate.vm_capacity[node][vm] if first else substrate.extra_capacity[node][vm][kind - 1]
                cost = substrate.vm_unit_cost[node][vm] if first else substrate.extra_unit_cost[node][vm][kind - 1]
                self.vm_capacity[node, vm, kind] = units(capacity)
                self.vm_unit_cost[node, vm, kind] = float(cost)
        self.link_between, self.link_capacity, self.link_speed = {}, {}, {}
        self.link_delay, self.link_unit_cost, self.directions = {}, {}, []
        full = substrate.back_capacity is not None
        for link, (u, v) in enumerate(substrate.links.tolist()):
            capacities = {(u, v): substrate.link_capacity[link]}
            if full:
                capacities[v, u] = substrate.back_capacity[link]
            self.directions.append(list(capacities))
            for name, capacity in capacities.items():
                self.link_capacity[name] = units(capacity)
                self.link_speed[name] = float(capacity)
                self.link_delay[name] = float(substrate.link_delay[link])
                self.link_unit_cost[name] = float(substrate.link_unit_cost[link])
            self.link_between[u, v], self.link_between[v, u] = (u, v), (v, u) if full else (u, v)

    def _read_catalogue(self, catalogue, own) -> None:
        self.types = catalogue.types
        self.services = [self._read_service(place, kind, catalogue) for place, kind in enumerate(catalogue.types)]
        for row in range(0 if own is None else len(own.service)):
            self.services.append(self._read_profile(own, row))
        self.longest_chain = max(1, *(len(service.loads) for service in self.services))
        self.delay_to = [self._shortest_delays(service) for service in range(len(self.services))]

    def _read_service(self, place: int, kind, catalogue) -> Service:
        rates = [_mean(kind.rate)] * (len(kind.chain) + 1) if kind.rates is None else list(kind.rates)
        loads, load_units, work, own_delay = [], [], [], []
        for name, rate in zip(kind.chain, rates, strict=False):
            needs = catalogue.vnfs[name]
            needs = needs if isinstance(needs, dict) else {catalogue.resources[0].name: needs}
            factors = [
                (needs.get(each.name, 0.0), rate if each.scales_with_rate else 1.0) for each in catalogue.resources
            ]
            loads.append([requirement * factor for requirement, factor in factors])
            load_units.append([units(*pair) for pair in factors])
            derived = "delay" not in needs and catalogue.resources[0].scales_with_rate
            work.append(loads[-1][0] if derived else 0.0)
            own_delay.append(needs.get("delay", 0.0))
        limit = math.inf if kind.tolerable_delay is None else _mean(kind.tolerable_delay)
        return Service(place, rates, [units(rate) for rate in rates], loads, load_units, work, own_delay, limit)

    def _read_profile(self, own, row: int) -> Service:
        length = int(own.chain_length[row])
        rates = own.rate[row, : length + 1].tolist()
        loads = own.amount[row, :length].tolist()
        return Service(
            kind=int(own.service[row]),
            rates=rates,
            rate_units=[units(rate) for rate in rates],
            loads=loads,
            load_units=[[units(amount) for amount in amounts] for amounts in loads],
            work=own.work[row, :length].tolist(),
            own_delay=own.fixed_delay[row, :length].tolist(),
            tolerable_delay=float(own.tolerable_delay[row]),
        )

    def _read_request(self, workload, index: int) -> Request:
        slot = int(workload.slot[index])
        ingress, egress = int(workload.ingress[index]), int(workload.egress[index])
        departure = slot + max(1, math.ceil(workload.lifetime[index]))
        time, leaves = float(slot), float(departure)
        if workload.time is not None:
            time = float(workload.time[index])
            leaves = max(time + float(workload.lifetime[index]), math.nextafter(time, math.inf))
            departure = max(slot + 1, math.ceil(leaves))
        return Request(
            index=index,
            slot=slot,
            service=int(workload.profile[index]),
            ingress=None if ingress == -1 else ingress,
            egress=None if egress == -1 else egress,
            departure=departure,
            time=time,
            leaves=leaves,
        )

    def hop_delay(self, rate: float, link) -> float:
        """Propagation and transmission of one hop, ms."""
        return self.link_delay[link] + 1000.0 * rate / self.link_speed[link]

    def _shortest_delays(self, service: int) -> dict[tuple[int, int], float]:
        """Least sum of hop delays between any two nodes at a profile's least rate (Floyd and Warshall)."""
        least = min(self.services[service].rates)
        everywhere = range(self.nodes)
        best = {(a, b): 0.0 if a == b else math.inf for a in everywhere for b in everywhere}
        for (a, b), link in self.link_between.items():
            best[a, b] = self.hop_delay(least, link)
        for middle in everywhere:
            for a in everywhere:
                for b in everywhere:
                    best[a, b] = min(best[a, b], best[a, middle] + best[middle, b])
        return best

    # ---- what is available ----------------------------------------------------------------------------------------

    def vm_available(self, node: int, vm: int, kind: int = 0) -> int:
        """Whole units of a kind (cycles/s of the first) that VM ``vm`` of ``node`` offers now."""
        if (node, vm) in self.failed:
            return 0
        return self.vm_capacity[node, vm, kind] - self.vm_reserved[node, vm, kind]

    def link_available(self, link) -> int:
        """bit/s that ``link`` offers now."""
        if ("link", link) in self.failed:
            return 0
        return self.link_capacity[link] - self.link_reserved[link]

    def _what_fails(self, resource: int) -> list:
        """A VM, or both directions of a link, by the number of a failure timeline."""
        if resource < self.nodes * self.vms:
            return [divmod(resource, self.vms)]
        return [("link", name) for name in self.directions[resource - self.nodes * self.vms]]

    # ---- slots ----------------------------------------------------------------------------------------------------

    def _open_slot(self) -> None:
        """Departures, then the slot's repairs and failures."""
        self.steps_of_service = {}
        for request in list(self.running):
            if request.departure <= self.slot:
                self._release(request)
        for resource, up in self.events.get(self.slot, []):
            if up:
                self.failed -= set(self._what_fails(resource))
            else:
                self.failed |= set(self._what_fails(resource))
                self._interrupt_users_of(set(self._what_fails(resource)))

    def _interrupt_users_of(self, resources: set) -> None:
        for request in list(self.running):
            used = {(node, vm) for node, vm, _ in request.vm_use} | {("link", link) for link in request.link_use}
            if used & resources:
                request.interrupted_at = self.slot
                self.interrupted.append(request)
                self._release(request)

    def _release(self, request: Request) -> None:
        self.running.remove(request)
        self._give_back(request)

    def _give_back(self, request: Request) -> None:
        for key, amount in request.vm_use.items():
            self.vm_reserved[key] -= amount
        for link, amount in request.link_use.items():
            self.link_reserved[link] -= amount

    @property
    def running_cost(self) -> float:
        """Sum of phi over the requests running now, $."""
        return math.fsum(request.cost for request in self.running)

    def _advance(self) -> list[float]:
        """Go on to the next request, closing slots on the way; to the end of the horizon if there is none."""
        closed = []
        while not self.done and (self.cursor == len(self.requests) or self.requests[self.cursor].slot > self.slot):
            closed.append(self.running_cost)
            self.slot += 1
            self.done = self.slot == self.scenario.horizon
            if not self.done:
                self._open_slot()
        if self.request is not None:
            for request in list(self.running):
                if request.leaves <= self.request.time:
                    self._release(request)
        self._begin_walk()
        return closed

    # ---- the walk of one request ----------------------------------------------------------------------------------

    @property
    def request(self) -> Request | None:
        """The request to be answered, None at the end of the horizon."""
        return None if self.done or self.cursor == len(self.requests) else self.requests[self.cursor]

    def _begin_walk(self) -> None:
        self.current_node = self.request.ingress if self.request else 0  # None: off the network
        self.stands_on = []
        self.function_index = 0
        self.elapsed = 0.0
        self.step_count = 0
        self.hops = 0
        self.last_vm = 0

    @property
    def reject(self) -> int:
        """The action that refuses a request."""
        return 2 * self.nodes * self.vms

    def is_adjacent_action(self, action: int) -> bool:
        """Is ``action`` in A_p, the paper's possible actions? (``reject`` aside.)"""
        if self.request is None or not 0 <= action < self.reject:
            return False
        node, vm, place = decode(action, self.vms)
        here = self.current_node
        there = any(machine == (node, vm) for machine in self.machines)
        place = place and not self._switches()
        # A node without VMs is named with VM 0, by a step that only forwards.
        if not there and (place or vm > 0 or any(machine[0] == node for machine in self.machines)):
            return False
        if node >= self.nodes or (place and self.all_placed()):
            return False
        distinct = self.scenario.placement == "distinct"
        if place and distinct and node in self.stands_on:
            return False
        if here is None:
            return place
        if node == here:
            return place and (here == self.request.egress or self.scenario.colocation or distinct)
        if here == self.request.egress and not distinct:
            return False
        return (here, node) in self.link_between

    def all_placed(self) -> bool:
        """Are all functions of the chain placed?"""
        return self.function_index == len(self.services[self.request.service].loads)

    def _switches(self) -> bool:
        """Does an action that places count as one that forwards now (Algorithm 3, the branch after i_f < F_k)?"""
        return self.all_placed() and self.scenario.placing_after_chain == "forwards"

    def steps_left(self) -> int:
        """Steps that the walk may take in all: J, less what its service took in this slot where services share J."""
        if self.scenario.step_budget == "request":
            return self.scenario.max_steps
        return self.scenario.max_steps - self.steps_of_service.get(self._service_share(), 0)

    def _step_parts(self, action: int):
        """What an action in A_p takes of VMs and of links, by name in whole units; its delay in ms, its cost in $."""
        node, vm, place = decode(action, self.vms)
        place = place and not self._switches()
        service = self.services[self.request.service]
        place_here = self.function_index
        delay = cost = 0.0
        vm_use, link_use = {}, {}
        if self.current_node is not None and node != self.current_node:
            link = self.link_between[self.current_node, node]
            rate = service.rates[place_here]
            link_use[link] = service.rate_units[place_here]
            delay += self.hop_delay(rate, link)
            cost += self.link_unit_cost[link] * rate
        if place:
            delay += service.own_delay[place_here] + 1000.0 * service.work[place_here] / self.vm_speed[node, vm]
            for kind in range(self.kinds):
                vm_use[node, vm, kind] = service.load_units[place_here][kind]
                cost += self.vm_unit_cost[node, vm, kind] * service.loads[place_here][kind]
        return vm_use, link_use, delay, cost

    def failed_check(self, action: int) -> str | None:
        """The first check of Algorithm 3 that an action in A_p fails, None if it passes them all."""
        vm_use, link_use, delay, _ = self._step_parts(action)
        if any(self.link_available(link) < rate for link, rate in link_use.items()):
            return LINK_CAPACITY
        if any(self.vm_available(*name) < load for name, load in vm_use.items()):
            return VM_CAPACITY
        if self.elapsed + delay > self.services[self.request.service].tolerable_delay + TOLERANCE_MS:
            return DELAY
        if self.step_count + 1 > self.steps_left():
            return STEP_LIMIT
        return None

    def _egress_within_reach(self, action: int) -> bool:
        """Could the egress still be reached in time after ``action``, were every link free and processing instant?"""
        node, _, _ = decode(action, self.vms)
        delay = self._step_parts(action)[2]
        free = self.request.egress is None
        still_to_go = 0.0 if free else self.delay_to[self.request.service][node, self.request.egress]
        budget = self.services[self.request.service].tolerable_delay
        return self.elapsed + delay + still_to_go <= budget + TOLERANCE_MS

    def is_feasible_action(self, action: int) -> bool:
        """Is ``action`` in A_p, passes every check, and leaves time to reach the egress?"""
        if not self.is_adjacent_action(action):
            return False
        return self.failed_check(action) is None and self._egress_within_reach(action)

    def is_offered(self, action: int) -> bool:
        """Is ``action`` in the mask? (``reject`` aside.)"""
        if self.scenario.mask == "adjacency":
            return self.is_adjacent_action(action)
        return self.is_feasible_action(action)

    def mask(self) -> list[bool]:
        """One flag for each action, ``reject`` last. Length 2*N*V + 1."""
        offered = [self.is_offered(action) for action in range(self.reject)]
        return [*offered, self.scenario.admission_control or not any(offered)]

    def step(self, action: int) -> dict:
        """Take ``action`` and say what came of it.

        ``request_cost``, ``delay`` and ``hops`` (links used) are those of an accepted request, 0 otherwise;
        ``slots_closed`` has Phi_t of each slot that ended, in order.
        """
        if self.done:
            raise RuntimeError("the horizon has ended")
        request = self.request
        reason = self._refusal(action)
        step_cost = 0.0
        if reason is None:
            step_cost = self._reserve(action)
        accepted = reason is None and self.is_complete()
        result = {
            "passed": reason is None,
            "reason": reason,
            "request_done": accepted or reason is not None,
            "accepted": accepted,
            "step_cost": step_cost,
            "request_cost": request.cost if accepted else 0.0,
            "delay": self.elapsed if accepted else 0.0,
            "hops": self.hops if accepted else 0,
            "lost_steps": self.step_count if reason is not None else 0,
            "lost_cost": request.cost if reason is not None else 0.0,
            "slots_closed": [],
        }
        if accepted:
            self.running.append(request)
        if reason is not None:
            self._give_back(request)
        if result["request_done"]:
            service = self._service_share()
            self.steps_of_service[service] = self.steps_of_service.get(service, 0) + self.step_count
            self.cursor += 1
            result["slots_closed"] = self._advance()
        result["done"] = self.done
        return result

    def is_complete(self) -> bool:
        """Has the walk placed its chain, and come to the egress if that is not free?"""
        chain = self.services[self.request.service].loads
        return self.function_index == len(chain) and self.request.egress in (None, self.current_node)

    def _refusal(self, action: int) -> str | None:
        if action == self.reject:
            if not any(self.mask()[:-1]):
                return NO_FEASIBLE_ACTION
            return REJECTED_BY_POLICY if self.scenario.admission_control else INVALID_ACTION
        if not self.is_offered(action):
            return INVALID_ACTION
        return self.failed_check(action)

    def _reserve(self, action: int) -> float:
        """Take what ``action`` needs, move on, and return the step's cost."""
        request = self.request
        node, vm, _ = decode(action, self.vms)
        vm_use, link_use, delay, cost = self._step_parts(action)
        place = bool(vm_use)
        for link, rate in link_use.items():
            self.link_reserved[link] += rate
            request.link_use[link] = request.link_use.get(link, 0) + rate
            self.hops += 1
        for name, load in vm_use.items():
            self.vm_reserved[name] += load
            request.vm_use[name] = request.vm_use.get(name, 0) + load
        request.steps.append([node, vm, self.function_index if place else None])
        request.cost += cost
        self.function_index += place
        self.stands_on = [*self.stands_on, node] if place else self.stands_on
        self.current_node = node
        self.last_vm = vm
        self.elapsed += delay
        self.step_count += 1
        return cost

    # ---- what a method sees ---------------------------------------------------------------------------------------

    def observation(self) -> list[float]:
        """The paper's P_i: used shares of VMs and links, then five numbers about the walk, all in [0, 1].

        Where the service does not tell them, the ends of the request follow.
        """
        shares = []
        for node in range(self.nodes):
            for vm in range(self.vms):
                for kind in range(self.kinds):
                    if (node, vm) in self.machines:
                        capacity = self.vm_capacity[node, vm, kind]
                        shares.append(used_share(capacity, self.vm_available(node, vm, kind)))
                    else:
                        shares.append(0.0)
        for link, capacity in self.link_capacity.items():
            shares.append(used_share(capacity, self.link_available(link)))
        if self.request is None:
            return shares + [0.0] * 5
        numbers = [
            *shares,
            self._service_share(),
            share(-1 if self.current_node is None else self.current_node, self.nodes - 1),
            share(self.last_vm, self.vms - 1),
            share(self.function_index, self.longest_chain),
            share(self.elapsed, self.services[self.request.service].tolerable_delay),
        ]
        if self.scenario.endpoints == "uniform" or any(kind.ingress or kind.egress for kind in self.types):
            ends = (self.request.ingress, self.request.egress)
            numbers += [share(-1 if end is None else end, self.nodes - 1) for end in ends]
        return numbers

    def _service_share(self) -> float:
        """Index of the service among the K services of the scenario, scaled to [0, 1]."""
        kind = self.services[self.request.service].kind
        if self.scenario.endpoints == "uniform":
            return share(kind, len(self.scenario.catalogue.types) - 1)
        pairs = [[(int(a), int(b)) for a, b in of_kind] for of_kind in self.scenario.endpoint_pairs]
        each = len(pairs[0])
        endpoints = (self.request.ingress, self.request.egress)
        if None in endpoints:
            return share(kind * each, len(pairs) * each - 1)  # on no pair, so it reads as the first of its service
        if endpoints not in pairs[kind]:
            return 1.0  # a workload file may hold pairs of its own
        return share(kind * each + pairs[kind].index(endpoints), len(pairs) * each - 1)


def _mean(value) -> float:
    """A number; of an interval, from which requests draw what their own profiles say, the middle."""
    return sum(value) / 2 if isinstance(value, tuple) else value


def used_share(capacity: int, available: int) -> float:
    """floor(I * (capacity - available) / capacity) / I with I = 1000."""
    return (1000 * (capacity - available) // capacity) / 1000


def share(value: float, largest: float) -> float:
    """``value`` scaled to [0, 1]; 0 where there is only one value."""
    return value / largest if largest else 0.0


def cheapest_walk(simulator: ReferenceSimulator) -> tuple[float, list[int]] | None:
    """Cost and actions of the cheapest way to embed the request that waits, by trying every walk; None if none fits.

    Slow beyond a handful of nodes. Of walks with the same cost the shortest is kept, then the first in the order of
    actions. Whatever the scenario's mask, no walk is kept that fails a check.
    """
    best: tuple[float, list[int]] | None = None
    request = simulator.request

    def extend(actions: list[int]) -> None:
        nonlocal best
        if best is not None:
            tie = abs(request.cost - best[0]) <= 1e-9
            if (tie and len(actions) >= len(best[1])) or (not tie and request.cost > best[0]):
                return
        if simulator.is_complete():
            best = (request.cost, actions)
            return
        for action in range(simulator.reject):
            if simulator.is_feasible_action(action):
                before = _remember(simulator)
                simulator._reserve(action)
                extend([*actions, action])
                _recall(simulator, before)

    extend([])
    return best


_WALK = ("current_node", "function_index", "elapsed", "step_count", "hops", "last_vm", "stands_on")


def _remember(simulator: ReferenceSimulator) -> tuple:
    request = simulator.request
    books = (simulator.vm_reserved, simulator.link_reserved, request.vm_use, request.link_use)
    walk = {name: getattr(simulator, name) for name in _WALK}
    return walk, request.cost, list(request.steps), [dict(book) for book in books]


def _recall(simulator: ReferenceSimulator, before: tuple) -> None:
    walk, cost, steps, books = before
    request = simulator.request
    for name, value in walk.items():
        setattr(simulator, name, value)
    request.cost, request.steps = cost, steps
    simulator.vm_reserved, simulator.link_reserved, request.vm_use, request.link_use = books
