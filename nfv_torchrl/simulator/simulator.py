"""The simulator: B independent networks, stepped together by the compiled kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from nfv_torchrl.codec import count_vms, link_resource, split_vm, vm_resource
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.limits import Sizes, check_memory, environment_parts, table_parts, times
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import kernels
from nfv_torchrl.simulator.reasons import NO_REASON
from nfv_torchrl.simulator.state import OUTCOME, World, clear_log, grow_pools, new_arrivals, new_log, new_world, widen
from nfv_torchrl.simulator.tables import Rules, Tables, build_tables


def scenario_rules(scenario: Scenario) -> Rules:
    """The step rules that ``scenario`` asks for."""
    return Rules(
        colocation=scenario.colocation,
        feasible_mask=scenario.mask == "feasible",
        admission_control=scenario.admission_control,
        max_steps=scenario.max_steps,
        distinct=scenario.placement == "distinct",
        free_ends=scenario.free_ends,
        shared_steps=scenario.step_budget == "slot",
        switches=scenario.placing_after_chain == "forwards",
        open_pairs=scenario.open_pairs,
    )


def count_services(scenario: Scenario) -> int:
    """The paper's K services, as the observation tells them apart: types, or pairs of a type and its endpoints."""
    pairs = scenario.endpoint_pairs
    return len(scenario.catalogue.types) if pairs is None else pairs.shape[0] * pairs.shape[1]


class Simulator:
    """B networks that serve their own requests, one request at a time and one step of its walk at a time.

    Args:
        scenarios: one scenario, or several that share services, horizon and rules but not the substrate.
        batch_size: B. Environment b lives in ``scenarios[b % len(scenarios)]``.
        one_hot: append one-hot request features to the flat observation.
        record: keep every answer (``world.log``), for decision files.
        threads: threads that split the batch; results do not depend on it.

    Attributes:
        world: all arrays (see ``simulator/state.py``). ``world.outcome`` float64 [B, len(OUTCOME)] says what the last
            step brought, ``world.seen`` what a controller sees now.

    Raises:
        ScenarioError: the scenarios do not fit together.
    """

    def __init__(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int,
        *,
        one_hot: bool = False,
        record: bool = False,
        threads: int = 1,
    ) -> None:
        self.scenarios = (scenarios,) if isinstance(scenarios, Scenario) else tuple(scenarios)
        if batch_size < 1:
            raise ScenarioError(f"batch_size is {batch_size}; a simulator needs at least one environment")
        self._check_together()
        self.batch_size = batch_size
        self.threads = max(1, min(threads, batch_size))
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        first = self.scenarios[0]
        self._check_size(record)
        net = np.arange(batch_size) % len(self.scenarios)
        tables = build_tables([s.substrate for s in self.scenarios], first.profiles)
        # Where the service of some network's requests does not tell their ends, all networks show these.
        rules = scenario_rules(first)._replace(open_pairs=any(scenario.open_pairs for scenario in self.scenarios))
        self.world: World = new_world(tables, rules, net, first.horizon, first.warmup, one_hot, record)
        self._service_shares = [_service_shares(scenario) for scenario in self.scenarios]
        self._share_steps()
        self.world.env["done"] = 1
        for b in range(batch_size):
            scenario = self.scenario(b)
            self.world.mean_lifetime[b] = scenario.usual_lifetime if scenario.observe_lifetime else 0.0
        self._grow_until_roomy()

    def _share_steps(self) -> None:
        """Counters for the steps of each service in a slot, where services share them."""
        if not self.world.rules.shared_steps:
            return
        services = np.array([count_services(self.scenario(b)) for b in range(self.batch_size)])
        self.world.env["services"] = services
        spent = np.zeros((self.batch_size, services.max()), np.int32)
        self.world = self.world._replace(walk=self.world.walk._replace(spent=spent))

    def _check_size(self, record: bool) -> None:
        """Refuse a batch that would not fit into memory, with what its tables take."""
        largest = Sizes(*(max(sizes) for sizes in zip(*(s.sizes for s in self.scenarios), strict=True)))
        check_memory(
            times(environment_parts(largest, record=record), self.batch_size, "environments"),
            times(table_parts(largest), len(self.scenarios), "networks"),
        )

    def _check_together(self) -> None:
        if not self.scenarios:
            raise ScenarioError("a simulator needs at least one scenario; none was given")
        first = self.scenarios[0]
        for other in self.scenarios[1:]:
            for name in ("horizon", "warmup", "catalogue"):
                if getattr(other, name) != getattr(first, name):
                    raise ScenarioError(f"scenarios of one batch must share {name}; {other.name} differs")
            if not other.profiles.same_as(first.profiles):
                raise ScenarioError(f"scenarios of one batch must share the requests' profiles; {other.name} differs")
            if scenario_rules(other)._replace(open_pairs=first.open_pairs) != scenario_rules(first):
                raise ScenarioError(f"scenarios of one batch must share the rules of a step; {other.name} differs")

    @property
    def tables(self) -> Tables:
        """Substrates and services as padded arrays."""
        return self.world.tables

    @property
    def num_actions(self) -> int:
        """Actions with ``reject``, the last one: 2 N V + 1."""
        return self.world.seen.mask.shape[1]

    @property
    def outcome(self) -> dict[str, np.ndarray]:
        """The columns of ``world.outcome`` by name, views float64 [B]."""
        return dict(zip(OUTCOME._fields, self.world.outcome.T, strict=True))

    def scenario(self, b: int) -> Scenario:
        """The scenario of environment b."""
        return self.scenarios[b % len(self.scenarios)]

    def start(self, b: int, workload: Workload, timeline: FailureTimeline | None = None) -> None:
        """Begin the horizon of environment b on an empty network.

        Args:
            workload: its requests; none at all is a horizon that is over at once.
            timeline: failures and repairs, none by default.
        """
        self.load_arrivals(b, workload, timeline)
        if self.world.log.enabled:
            clear_log(self.world.log, b)
        kernels.start_env(self.world, b)
        self.make_room_for(b)
        self.clear_outcome(b)

    def clear_outcome(self, b: int) -> None:
        """Forget what the last step of environment b brought."""
        self.world.outcome[b] = 0.0
        self.world.outcome[b, OUTCOME.reason] = NO_REASON

    def make_room_for(self, b: int) -> None:
        """Enlarge the pools if environment b runs low, after steps that were not made by ``step``."""
        self.make_room(*self._room(b))

    def step(self, actions: np.ndarray) -> None:
        """One step of every environment; one past its horizon stays there.

        Args:
            actions: int64 [B]. What is no action at all answers the request with ``invalid_action``.

        Raises:
            ValueError: another shape than [B].
        """
        # Kernels are compiled for contiguous int64 arrays and do not check bounds.
        actions = np.ascontiguousarray(actions, np.int64)
        if actions.shape != (self.batch_size,):
            raise ValueError(
                f"actions have shape {list(actions.shape)}; one index for each of [{self.batch_size}] is needed"
            )
        self.make_room(*self._over_environments(kernels.step_range, actions))

    def answer(self, plans: np.ndarray, lengths: np.ndarray) -> None:
        """Answer the request in hand of every environment, whose walk has not begun; one past its horizon stays there.

        Args:
            plans: int64 [B, J], actions of each; where the request is not over with them, it is rejected.
            lengths: int64 [B], how many there are.
        """
        self.make_room(*self._over_environments(kernels.answer_range, plans, lengths))

    def _over_environments(self, kernel: Callable[..., tuple[int, int, int]], *arguments: np.ndarray) -> tuple:
        """``kernel`` on all environments, shared out among the threads; the least room left in any of them."""
        if self._pool is None:
            return kernel(self.world, *arguments, 0, self.batch_size)
        bounds = np.linspace(0, self.batch_size, self.threads + 1).astype(int).tolist()
        waiting = [
            self._pool.submit(kernel, self.world, *arguments, first, last) for first, last in pairwise(bounds[1:])
        ]
        rooms = [kernel(self.world, *arguments, bounds[0], bounds[1])]
        rooms += [future.result() for future in waiting]
        return tuple(min(values) for values in zip(*rooms, strict=True))

    def make_room(self, records: int, entries: int, places: int) -> None:
        """Enlarge what the next step could fill: it may end one walk, of at most J steps and 2 J reservations.

        A rejected walk leaves one action more in the log, the one that was refused.
        """
        steps = self.world.rules.max_steps
        if records < 1:
            self.world = grow_pools(self.world, ["record"])
        if entries < 2 * steps:
            self.world = grow_pools(self.world, ["entry"])
        log = self.world.log
        if log.enabled and places <= steps:
            have = log.action.shape[1]
            self.world = self.world._replace(log=log._replace(action=widen(log.action, have + max(have, steps + 1))))

    def _room(self, b: int) -> tuple[int, int, int]:
        """Free records, reservations and log places of environment b."""
        e = self.world.env[b]
        places = self.world.log.action.shape[1] - e["log_length"]
        return int(e["free_records"]), int(e["free_entries"]), int(places)

    def _grow_until_roomy(self) -> None:
        while self.world.running.entry_next.shape[1] < 4 * self.world.rules.max_steps:
            self.world = grow_pools(self.world, ["entry"])

    def load_arrivals(self, b: int, workload: Workload, timeline: FailureTimeline | None) -> None:
        """Write the requests and failures of environment b's horizon without starting it."""
        scenario = self.scenario(b)
        workload.check_fits(len(scenario.catalogue.types), scenario.substrate.num_nodes, scenario.horizon)
        workload.check_profiles(self.scenarios[0].profiles)
        if workload.free_ends and not self.world.rules.free_ends:
            raise ScenarioError(
                "workload: has free ends, which no service of this scenario has; see services.NAME.ingress"
            )
        if timeline is not None:
            timeline.check_fits(scenario.substrate)
        requests = len(workload.slot)
        happens = _no_events() if timeline is None else self._padded_events(b, timeline)
        events = len(happens[0])
        self._widen_arrivals(requests, events)
        if workload.time is not None:
            self._keep_times()
        arrivals, env = self.world.arrivals, self.world.env
        arrivals.slot[b, :requests] = workload.slot
        arrivals.profile[b, :requests] = workload.profile
        arrivals.ingress[b, :requests] = workload.ingress
        arrivals.egress[b, :requests] = workload.egress
        arrivals.lifetime[b, :requests] = np.minimum(workload.lifetime, np.finfo(np.float32).max)
        # Departures past the horizon are all alike; clipping keeps them within int32.
        arrivals.departure[b, :requests] = np.minimum(workload.departure, self.world.env["horizon"][b])
        if arrivals.time.shape[1] and workload.time is not None:
            arrivals.time[b, :requests], arrivals.leaves[b, :requests] = workload.time, workload.leaves
        elif arrivals.time.shape[1]:
            arrivals.time[b, :requests], arrivals.leaves[b, :requests] = workload.slot, np.inf  # none within a slot
        shares = self._service_shares[b % len(self.scenarios)]
        # A request with a free end is on no pair of nodes, so it reads as the first of its service.
        free, first = (workload.ingress < 0) | (workload.egress < 0), (0, 0)
        if scenario.endpoint_pairs is not None:
            first = scenario.endpoint_pairs[workload.service, 0].T
        ends = (np.where(free, one, end) for one, end in zip(first, (workload.ingress, workload.egress), strict=True))
        arrivals.service_share[b, :requests] = shares[(workload.service, *ends)]
        env["num_requests"][b], env["num_events"][b] = requests, events
        arrivals.event_slot[b, :events], arrivals.event_resource[b, :events], arrivals.event_up[b, :events] = happens

    def _padded_events(self, b: int, timeline: FailureTimeline) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slot, resource and whether it is a repair, with resources numbered by the batch's padded sizes.

        With full duplex a link fails and is repaired in both directions.
        """
        own_nodes, own_vms = self.scenario(b).substrate.vm_capacity.shape
        _, nodes, vms, _ = self.world.ledger.vm_offered.shape
        first_link = count_vms(own_nodes, own_vms)
        slot, resource, up = timeline.slot, timeline.resource, timeline.up
        link, back = resource - first_link, np.zeros(len(resource), np.int64)
        if self.tables.full_duplex:
            times = np.where(link >= 0, 2, 1)
            slot, resource, up, link = (np.repeat(column, times) for column in (slot, resource, up, link))
            back = np.arange(len(link)) - np.repeat(np.cumsum(times) - times, times)
            link = 2 * link + back
        as_vm = vm_resource(*split_vm(resource, own_vms), vms)
        return slot, np.where(resource >= first_link, link_resource(link, nodes, vms), as_vm), up

    def _keep_times(self) -> None:
        """Make room for times within slots, where some environment's requests have them. None had any so far."""
        arrivals = self.world.arrivals
        if arrivals.time.shape[1] == 0:
            # Other environments go on as they did: nothing leaves within a slot.
            leaves = np.full(arrivals.slot.shape, np.inf)
            arrivals = arrivals._replace(time=arrivals.slot.astype(np.float64), leaves=leaves)
            self.world = self.world._replace(arrivals=arrivals)

    def _widen_arrivals(self, requests: int, events: int) -> None:
        arrivals = self.world.arrivals
        have = arrivals.slot.shape[1]
        if requests > have:
            # A little more than asked: other horizons of the same workload differ by some requests.
            requests += requests // 16
            arrivals = type(arrivals)(
                **{
                    name: array if name.startswith("event_") or not array.shape[1] else widen(array, requests)
                    for name, array in arrivals._asdict().items()
                }
            )
            if self.world.log.enabled:
                self.world = self.world._replace(log=_wider_log(self.world.log, self.batch_size, requests))
        if events > arrivals.event_slot.shape[1]:
            wide = new_arrivals(self.batch_size, 1, 2 * events)
            for name in ("event_slot", "event_resource", "event_up"):
                have_events = getattr(arrivals, name)
                getattr(wide, name)[:, : have_events.shape[1]] = have_events
            arrivals = arrivals._replace(
                event_slot=wide.event_slot, event_resource=wide.event_resource, event_up=wide.event_up
            )
        self.world = self.world._replace(arrivals=arrivals)

    def memory_bytes(self) -> int:
        """Bytes of all arrays that grow with B."""
        groups: Iterable = (self.world.ledger, self.world.arrivals, self.world.running, self.world.walk)
        arrays = [array for group in groups for array in group]
        arrays += [self.world.seen.mask, self.world.seen.valid, self.world.seen.flat, self.world.outcome]
        return sum(array.nbytes for array in arrays)


def _no_events() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.bool_)


def _wider_log(log, batch: int, requests: int):
    """A decision log for ``requests`` requests that keeps what ``log`` holds."""
    wide = new_log(batch, requests, True)
    columns = log.reason.shape[1]
    for name in ("reason", "delay", "cost", "hops", "interrupted_at"):
        getattr(wide, name)[:, :columns] = getattr(log, name)
    wide.start[:, : columns + 1] = log.start
    return wide._replace(action=widen(log.action, wide.action.shape[1]))


def _service_shares(scenario: Scenario) -> np.ndarray:
    """Service index scaled to [0, 1] by (type, ingress, egress), float32 [K, N, N].

    With catalogue endpoints a service is a (type, pair); a request on a pair that is not in the catalogue reads 1, like
    the last service. With uniform endpoints a service is a type.
    """
    types, nodes = len(scenario.catalogue.types), scenario.substrate.num_nodes
    if scenario.endpoint_pairs is None:
        shares = np.arange(types) / max(types - 1, 1)
        return np.broadcast_to(shares[:, None, None], (types, nodes, nodes)).astype(np.float32)
    pairs = scenario.endpoint_pairs
    table = np.ones((types, nodes, nodes), np.float32)
    index = np.arange(pairs.shape[0] * pairs.shape[1]).reshape(pairs.shape[:2])
    for service in range(types):
        ingress, egress = pairs[service].T
        table[service, ingress, egress] = index[service] / max(index.size - 1, 1)
    return table
