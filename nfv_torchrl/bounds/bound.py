"""Upper bounds on how many requests any method can accept, from a linear programme. Proofs are in docs/bounds.md.

``hindsight_bound`` knows the whole workload, lifetimes included; ``blind_bound`` bounds what a method that does not see
lifetimes can expect. Both let a request in by fractions and embed nothing: they only ask that, in every slot, what
the accepted requests take fits into all VMs together and, for sets of nodes, through the links that leave the set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nfv_torchrl.bounds.moments import Moments, surely_there
from nfv_torchrl.bounds.occupancy import Columns, Occupancy, expected_price, maximise_value, price_of_stay
from nfv_torchrl.bounds.relaxations import candidate_cuts, crossed, fitting, least_cost, least_delay
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.units import LEDGER_UNITS, to_ledger
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE

CUTS_PER_ROUND = 4
MAX_ROUNDS = 8
VIOLATION = 1e-6
"""Share of a cut's capacity by which it must be exceeded to join the programme."""


@dataclass(frozen=True)
class Bound:
    """What a bound says about one workload.

    Attributes:
        kind: ``hindsight`` or ``blind``.
        accepted: no method accepts more (``blind``: no method accepts more in expectation). Requests of the warm-up
            are left out, as they are of AAR.
        arrived: requests that count.
        aar: ``accepted / arrived``; nan if none arrived.
        accepted_by_service: the mix of types at the programme's optimum, float64 [K]; not a bound for each type.
        cuts: sets of nodes whose links turned out to be scarce; all links together count as one more.
    """

    kind: str
    accepted: float
    arrived: int
    aar: float
    accepted_by_service: np.ndarray
    cuts: int


def hindsight_bound(scenario: Scenario, workload: Workload, failures: FailureTimeline | None = None) -> Bound:
    """The most requests of ``workload`` that any method could accept, even knowing all of it, lifetimes too.

    Args:
        scenario: network, services, horizon, warm-up and colocation rule.
        workload: all requests.
        failures: what fails when; needed if the scenario has failures.

    Raises:
        ScenarioError: the scenario has failures and ``failures`` was not given.
    """
    relaxation = _Relaxation(scenario, workload, failures)
    accepted = relaxation.solve().bound
    # A method accepts a whole number of requests.
    return relaxation.bound("hindsight", float(math.floor(accepted * (1 + 1e-12) + 1e-9)))


def blind_bound(
    scenario: Scenario,
    workload: Workload,
    failures: FailureTimeline | None = None,
    *,
    mean_lifetime: float | None = None,
) -> Bound:
    """The most requests that a method which does not see lifetimes can accept in expectation, given the arrivals.

    Lifetimes are taken as exponential and independent of all else; those in ``workload`` are not read. A single run
    may end above this bound by luck; the mean over many draws of the lifetimes does not.

    Args:
        scenario: as for ``hindsight_bound``.
        workload: all requests.
        failures: as for ``hindsight_bound``.
        mean_lifetime: s; by default the scenario's, and those of its services, or that of a file of laws.

    Raises:
        ScenarioError: the workload comes from a file that does not say the law of lifetimes, and ``mean_lifetime`` was
            not given; or as for ``hindsight_bound``.
    """
    relaxation = _Relaxation(scenario, workload, failures, _known_mean(scenario, mean_lifetime))
    return relaxation.bound("blind", relaxation.solve().bound)


def blind_bound_applies(scenario: Scenario) -> bool:
    """Whether methods do not see lifetimes, and these are drawn: the bound needs to know from what."""
    known = scenario.workload_path is None or scenario.file_mean_lifetime is not None
    return known and not scenario.observe_lifetime


def lifetime_luck(
    scenario: Scenario,
    workload: Workload,
    accepted: np.ndarray,
    failures: FailureTimeline | None = None,
    *,
    mean_lifetime: float | None = None,
) -> float:
    """Requests a run accepted thanks to the lifetimes it happened to meet: 0 in expectation, negative if unlucky.

    For a method that does not see lifetimes, ``accepted.sum() - lifetime_luck(...)`` (over the requests after the
    warm-up) has the expectation of the number accepted, varies less from run to run, and is at most
    ``blind_bound(...).accepted`` in every single run. So compare it, not the raw number, with that bound.

    Args:
        accepted: bool [R], which requests of ``workload`` the run accepted.

    Other arguments and errors as for ``blind_bound``.
    """
    relaxation = _Relaxation(scenario, workload, failures, _known_mean(scenario, mean_lifetime))
    return relaxation.luck(workload, np.asarray(accepted, dtype=bool))


def _known_mean(scenario: Scenario, mean_lifetime: float | None) -> np.ndarray:
    """Mean lifetime of each service, s, float64 [K]."""
    if mean_lifetime is not None:
        return np.full(len(scenario.catalogue.types), mean_lifetime)
    if scenario.workload_path is None:
        return scenario.mean_lifetimes
    if scenario.file_mean_lifetime is None:
        raise ScenarioError(
            f"{scenario.workload_path}: the lifetime-blind bound needs the law of the lifetimes; "
            "pass mean_lifetime if they are exponential, or use the hindsight bound"
        )
    return np.full(len(scenario.catalogue.types), scenario.file_mean_lifetime)


def hindsight_least_cost(
    scenario: Scenario, workload: Workload, accepted: float, failures: FailureTimeline | None = None
) -> float:
    """The least cost in $ (sum of phi, eq. main_problem) of any method that accepts ``accepted`` requests.

    Every request is charged its cheapest embedding with delay and capacities ignored, so this is far from tight under
    load.

    Raises:
        ScenarioError: not even the relaxation can accept so many; or as for ``hindsight_bound``.
    """
    relaxation = _Relaxation(scenario, workload, failures)
    if accepted > relaxation.rows.size:
        raise ScenarioError(f"{accepted:g} requests cannot be accepted; at most {relaxation.rows.size} can")
    return relaxation.least_cost(accepted)


class _Relaxation:
    """One workload's programme. A class is a (profile, ingress, egress); requests of a class differ in time alone."""

    def __init__(
        self,
        scenario: Scenario,
        workload: Workload,
        failures: FailureTimeline | None,
        mean_lifetimes: np.ndarray | None = None,
    ) -> None:
        if failures is None and not scenario.failures.off:
            raise ScenarioError("the scenario has failures: pass the run's failure timeline to the bound")
        self.scenario, self.failures = scenario, failures or FailureTimeline.empty()
        counts = workload.slot >= scenario.warmup
        self.arrived = int(counts.sum())
        requests = np.stack([workload.profile, workload.ingress, workload.egress])[:, counts]
        self.classes, kind = np.unique(requests, axis=1, return_inverse=True)
        kind = kind.ravel()  # one NumPy release returns it as a row
        possible = self._possible()[kind]
        self.rows = np.flatnonzero(counts)[possible]  # requests of the workload that are in the programme
        self.kind, blind = kind[possible], mean_lifetimes is not None
        self.moments = self._moments(workload, blind)
        arrives = workload.time if blind and workload.time is not None else workload.slot
        self.start = self.moments.at(arrives[self.rows])
        means = np.zeros(1) if mean_lifetimes is None else np.unique(mean_lifetimes)
        service = workload.service[self.rows]
        of_service = np.zeros(self.rows.size) if mean_lifetimes is None else mean_lifetimes[service]
        self.law = np.searchsorted(means, of_service)  # of each request, int64 [R]
        last = self.moments.count
        self.keep = self.moments.keeping(means) if blind else np.ones((1, last))
        self.until = np.full(self.rows.size, last)
        if not blind:
            self.until = self.moments.until(self.start, surely_there(workload)[self.rows])
        self.active: list[int] = []  # rows of self.cuts in the programme
        self.fraction = np.zeros(self.kind.size)  # of each request, at the optimum
        profiles = scenario.profiles
        loads = to_ledger(profiles.amount).sum(axis=1) / LEDGER_UNITS
        self.class_load = loads[self.classes[0]].T  # [kinds, C]
        segments = np.arange(profiles.rate.shape[1]) <= profiles.chain_length[:, None]
        least_rate = np.where(segments, profiles.rate, np.inf).min(axis=1)
        self.class_rate = (to_ledger(least_rate) / LEDGER_UNITS)[self.classes[0]]
        self.class_between = self._between()
        self._place_cuts()

    def _possible(self) -> np.ndarray:
        """Classes, bool [C], that fit into the empty network within their tolerable delay."""
        possible = np.zeros(self.classes.shape[1], dtype=bool)
        for profile in np.unique(self.classes[0]):
            mine = self.classes[0] == profile
            tolerable = self.scenario.profiles.tolerable_delay[profile]
            if np.isinf(tolerable):
                possible[mine] = fitting(self.scenario, int(profile)).any(axis=(1, 2)).all()
                continue
            delay = least_delay(self.scenario, int(profile))[self.classes[1, mine], self.classes[2, mine]]
            # Sums taken in another order may differ by more than the simulator's tolerance, never by 1e-6 ms.
            possible[mine] = delay <= tolerable + DELAY_TOLERANCE + 1e-6
        return possible

    def _moments(self, workload: Workload, blind: bool) -> Moments:
        """Slots. If lifetimes are not known and requests come from a file or within slots: the arrivals, since what is
        there only gets less from one to the next."""
        if not blind or (workload.time is None and self.scenario.workload_path is None):
            return Moments.of_slots(self.scenario.horizon, self.failures)
        arrives = workload.slot if workload.time is None else workload.time
        return Moments.of_arrivals(arrives[self.rows].astype(np.float64), self.failures)

    def _between(self) -> np.ndarray:
        """Mbit/s that a request of each class takes of links between its functions at least, float64 [C].

        Where no two of them share a node, or each comes with a hop, a segment between two has one hop or more.
        """
        profiles, placement = self.scenario.profiles, self.scenario.placement_rule
        inner = np.arange(1, profiles.rate.shape[1]) < profiles.chain_length[:, None]
        between = (to_ledger(profiles.rate[:, 1:]) / LEDGER_UNITS * inner).sum(axis=1)[self.classes[0]]
        apart = np.full(len(between), placement == "distinct") | ((placement == "walk") & (self.classes[2] < 0))
        return np.where(apart, between, 0.0)

    def _place_cuts(self) -> None:
        substrate, horizon = self.scenario.substrate, self.scenario.horizon
        vm_units = to_ledger(substrate.capacity_by_kind).reshape(-1, len(self.class_load))
        pools = [(units.sum() + self._failed(units, 0).sum(axis=0)) / LEDGER_UNITS for units in vm_units.T]
        self.pools = np.stack([np.broadcast_to(pool, (horizon,))[self.moments.slots] for pool in pools])  # [kinds, T]
        sets, (u, v) = candidate_cuts(substrate), substrate.links.T
        if substrate.full_duplex:  # what leaves a set and what enters it share nothing
            sets = np.concatenate([sets, ~sets])
        self.cuts = sets
        ends = self.classes[1:] if substrate.full_duplex else np.sort(self.classes[1:], axis=0)
        self.pairs, self.class_pair = np.unique(ends, axis=1, return_inverse=True)
        self.class_pair = self.class_pair.ravel()
        self.crosses = self._crossing()  # [M, P]
        everywhere = np.ones((1, len(u)))  # the last row: all links together
        links_of = np.vstack([crossed(sets, substrate.links), everywhere])  # [M + 1, L]
        self.cut_capacity = self._over_cuts(links_of, substrate.link_capacity, len(vm_units))
        if substrate.back_capacity is not None:
            there, back = (np.vstack([sets[:, a] & ~sets[:, b], everywhere]) for a, b in ((u, v), (v, u)))
            self.cut_capacity = self._over_cuts(there, substrate.link_capacity, len(vm_units))
            self.cut_capacity = self.cut_capacity + self._over_cuts(back, substrate.back_capacity, len(vm_units))

    def _over_cuts(self, links_of: np.ndarray, capacity: np.ndarray, first: int) -> np.ndarray:
        """Capacity of sets of links float64 [M, L] over time, Mbit/s, [M, T]; ``first``: number of link 0."""
        units = to_ledger(capacity)
        offered = (units[:, None] + self._failed(units, first)) / LEDGER_UNITS
        return np.broadcast_to(links_of @ offered, (len(links_of), self.scenario.horizon))[:, self.moments.slots]

    def _crossing(self) -> np.ndarray:
        """Which pairs of ends have to cross which cuts, bool [M, P]; a request with a free end has to cross none."""
        ingress, egress = self.pairs
        crosses = self.cuts[:, ingress] & ~self.cuts[:, egress]
        if not self.scenario.substrate.full_duplex:
            crosses = crossed(self.cuts, self.pairs.T)
        return crosses & (ingress >= 0) & (egress >= 0)

    def _failed(self, units: np.ndarray, first: int) -> np.ndarray:
        """What failures take from each resource, int64 [resources, T] (or [resources, 1] if nothing fails), <= 0."""
        events = self.failures
        if not len(events):
            return np.zeros((units.size, 1), dtype=np.int64)
        change = np.zeros((units.size, self.scenario.horizon), dtype=np.int64)
        mine = (events.resource >= first) & (events.resource < first + units.size)
        resource, up = events.resource[mine] - first, events.up[mine]
        np.add.at(change, (resource, events.slot[mine]), np.where(up, units[resource], -units[resource]))
        return np.cumsum(change, axis=1)

    def solve(self, value: np.ndarray | None = None, at_least: float | None = None) -> Occupancy:
        """Solve with the pool of VMs alone, then add the cuts that the solution violates, and again.

        ``value`` float64 [C] is what a request of each class is worth, 1 by default.
        """
        value = np.ones(self.classes.shape[1]) if value is None else value
        best: Occupancy | None = None
        for _ in range(MAX_ROUNDS):
            columns, capacity, column_of = self._programme(value)
            solution = maximise_value(columns, capacity, self.keep, at_least)
            # Every round's bound holds; each is at most the one before, but for the solver's tolerance.
            if best is None or at_least is not None or solution.bound < best.bound:
                best = solution
            self.fraction = (solution.accepted / np.maximum(columns.size, 1.0))[column_of]
            if not self._activate_violated():
                break
        assert best is not None
        return best

    def _programme(self, value: np.ndarray) -> tuple[Columns, np.ndarray, np.ndarray]:
        """Groups of requests alike to the programme, capacity float64 [K, T], and each request's group."""
        demand = self._demand(len(self.active))
        looks, look_of = np.unique(np.vstack([demand, value]), axis=1, return_inverse=True)
        keys = np.stack([look_of.ravel()[self.kind], self.start, self.until, self.law])
        groups, column_of, count = np.unique(keys, axis=1, return_inverse=True, return_counts=True)
        look = looks[:, groups[0]]
        columns = Columns(groups[1], groups[2], count.astype(np.float64), look[:-1], look[-1], groups[3])
        return columns, np.vstack([self.pools, self.cut_capacity[self.active]]), column_of.ravel()

    def _demand(self, cuts: int) -> np.ndarray:
        """What a request of each class takes of the pools and the first ``cuts`` active cuts, float64 [R + cuts, C]."""
        last = len(self.crosses)
        over = [
            self.class_between if cut == last else self.crosses[cut, self.class_pair] * self.class_rate
            for cut in self.active[:cuts]
        ]
        return np.vstack([self.class_load, *over])

    def luck(self, workload: Workload, accepted: np.ndarray) -> float:
        """Expected less actual price of the stays of the accepted requests, at the prices that prove the bound."""
        prices = self.solve().prices
        until = self.moments.until(self.start, self.moments.at(workload.leaves[self.rows]))
        ahead = np.stack([expected_price(prices, keep) for keep in self.keep])  # [M, K, T]
        spared = ahead[self.law, :, self.start].T - price_of_stay(prices, self.start, until)
        demand = self._demand(len(prices) - len(self.class_load))[:, self.kind]
        return float((demand * spared).sum(axis=0)[accepted[self.rows]].sum())

    def _activate_violated(self) -> bool:
        """Add the cuts that the present solution exceeds by most; False if there is none."""
        pair, kind = self.class_pair[self.kind], self.kind
        over_pairs = self._taken(pair, self.fraction * self.class_rate[kind], self.pairs.shape[1])
        over_all = self._taken(np.zeros_like(kind), self.fraction * self.class_between[kind], 1)
        used = np.vstack([self.crosses.astype(np.float64) @ over_pairs, over_all])
        excess = (used - self.cut_capacity).max(axis=1) / np.maximum(self.cut_capacity.max(axis=1), 1e-9)
        worst = [int(row) for row in np.argsort(-excess) if excess[row] > VIOLATION and int(row) not in self.active]
        self.active += worst[:CUTS_PER_ROUND]
        return bool(worst)

    def _taken(self, group: np.ndarray, amount: np.ndarray, groups: int) -> np.ndarray:
        """What requests take over time if each takes ``amount`` float64 [R], by ``group`` int64 [R]: [groups, T]."""
        last = self.moments.count
        flow = np.zeros((len(self.keep), groups, last))  # by law
        np.add.at(flow, (self.law, group, self.start), amount)
        leaves = self.until < last
        np.add.at(flow, (self.law[leaves], group[leaves], self.until[leaves]), -amount[leaves])
        for t in range(1, last):
            flow[:, :, t] += self.keep[:, t, None] * flow[:, :, t - 1]
        return flow.sum(axis=0)

    def bound(self, kind: str, accepted: float) -> Bound:
        """Wrap up after ``solve``."""
        accepted = min(accepted, float(self.kind.size))
        services = self.scenario.profiles.service[self.classes[0, self.kind]]
        return Bound(
            kind=kind,
            accepted=accepted,
            arrived=self.arrived,
            aar=accepted / self.arrived if self.arrived else math.nan,
            accepted_by_service=np.bincount(services, self.fraction, len(self.scenario.catalogue.types)),
            cuts=len(self.active),
        )

    def least_cost(self, accepted: float) -> float:
        """Lagrangian bound: requests earn the price of the count less their cost, so many prices are due."""
        cost = np.zeros(self.classes.shape[1])
        for profile in np.unique(self.classes[0]):
            mine = self.classes[0] == profile
            cost[mine] = least_cost(self.scenario, int(profile))[self.classes[1, mine], self.classes[2, mine]]
        cost[~np.isfinite(cost)] = 0.0  # impossible classes are in no group
        solution = self.solve(-cost, at_least=accepted)
        return max(solution.count_price * accepted - solution.bound, 0.0)
