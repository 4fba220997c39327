"""Replays the decisions of a run slot by slot and checks every one against the rules and the capacities left."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from nfv_torchrl.evaluation.audit.files import ANY, FREE, PAPER_KINDS, Request, RunFiles, is_index, is_number
from nfv_torchrl.evaluation.audit.rejections import REASONS, Contradiction, Rejections
from nfv_torchrl.evaluation.audit.rules import STATED_DELAY_TOLERANCE, Progress, Resource, may_name, rule_broken

COST_TOLERANCE = 1e-9
"""Relative: costs are sums of the same products, in another order at most."""

DECISION_KEYS = {
    "slot", "service", "ingress", "egress", "lifetime", "accepted", "reason", "steps", "delay_ms", "cost",
    "tried", "interrupted_at",
}  # fmt: skip


class Event(NamedTuple):
    """A line of the failure timeline."""

    resource: Resource
    repaired: bool


class ReplayedWalk(NamedTuple):
    """What an accepted request uses, as recomputed from its steps: whole units, $, ms, links."""

    uses: list[tuple[tuple[Resource, int], int]]  # by resource and kind
    cost: float
    delay: float
    hops: int


@dataclass
class Answer:
    """One request as replayed."""

    request: Request
    accepted: bool
    reason: str | None
    walk: ReplayedWalk
    interrupted_at: int | None = None
    left_in: int | None = None  # slot within which it left before another came

    @property
    def end(self) -> int:
        """First slot after whose last arrival it no longer runs."""
        if self.interrupted_at is not None:
            return self.interrupted_at
        return self.request.departure if self.left_in is None else self.left_in


@dataclass
class Replayed:
    """All answers, and for each slot the cycles/s and bit/s in use after its arrivals."""

    answers: list[Answer] = field(default_factory=list)
    vm_used: list[tuple[int, ...]] = field(default_factory=list)  # of each kind
    link_used: list[int] = field(default_factory=list)


NOTHING = ReplayedWalk([], 0.0, 0.0, 0)


def replay(files: RunFiles) -> Replayed | None:
    """Replay the run; what is wrong goes to ``files.problems``. None when requests and answers do not pair up."""
    if len(files.decisions) != len(files.workload):
        _report_unpaired(files)
        return None
    return _Replay(files).run()


def _report_unpaired(files: RunFiles) -> None:
    decided, asked = len(files.decisions), len(files.workload)
    files.problems.add(f"decisions.jsonl answers {decided} requests, workload.csv has {asked}")
    for line, (decision, request) in enumerate(zip(files.decisions, files.workload, strict=False), start=1):
        if decision is not None and _identity(decision) != _asked_for(request):
            files.problems.add(f"{_where(line)}: not the request of workload.csv line {line + 1}; none, or twice?")
            return
    line = min(decided, asked) + 1
    files.problems.add(f"{_where(line)}: " + ("no such request in workload.csv" if decided > asked else "missing"))


def _where(line: int) -> str:
    return f"decisions.jsonl line {line}"


def _identity(decision: dict[str, Any]) -> tuple[Any, ...]:
    """As a row of the workload has it; what only equals a number of it (true, 1.0) comes back as text."""
    slot, service, ingress, egress, lifetime = (decision.get(key) for key in Request._fields[:5])
    slot, ingress, egress = (value if is_index(value) else str(value) for value in (slot, ingress, egress))
    return slot, service, ingress, egress, lifetime if is_number(lifetime) else str(lifetime)


def _asked_for(request: Request) -> tuple[Any, ...]:
    """The same of a request, an end that is free by its word."""
    ends = (ANY if end == FREE else end for end in (request.ingress, request.egress))
    return request.slot, request.service, *ends, request.lifetime


class _Replay:
    """The books of the run: what is free, who uses what, who leaves when."""

    def __init__(self, files: RunFiles) -> None:
        self.files = files
        self.problems = files.problems
        self.free: dict[tuple[Resource, int], int] = {
            (("vm", node, index), kind): units
            for node, here in enumerate(files.vms)
            for index, vm in enumerate(here)
            for kind, units in enumerate(vm.units)
        }
        self.free |= {(("link", *ends), 0): link.units for ends, link in files.links.items()}
        self.kinds = len(files.scenario.get("resources") or PAPER_KINDS)
        self.down: set[Resource] = set()
        self.users: dict[Resource, set[int]] = defaultdict(set)
        self.leaving: dict[int, list[int]] = defaultdict(list)
        self.in_use: dict[tuple[str, int], int] = defaultdict(int)
        self.rejections = Rejections(files, self._left)
        self.done = Replayed()

    def run(self) -> Replayed:
        events = self._timeline()
        requests = enumerate(zip(self.files.workload, self.files.decisions, strict=True))
        upcoming = next(requests, None)
        for slot in range(self.files.scenario["horizon"]):
            for index in self.leaving.pop(slot, ()):
                if self.done.answers[index].interrupted_at is None and self.done.answers[index].left_in is None:
                    self._give_back(index)
            for event in events.get(slot, ()):
                self._apply(slot, event)
            while upcoming is not None and upcoming[1][0].slot == slot:
                if upcoming[1][0].time is not None:
                    self._let_go(slot, upcoming[1][0].time)
                self._answer(upcoming[0], *upcoming[1])
                upcoming = next(requests, None)
            self.done.vm_used.append(tuple(self.in_use["vm", kind] for kind in range(self.kinds)))
            self.done.link_used.append(self.in_use["link", 0])
        self._check_interruptions()
        return self.done

    def _let_go(self, slot: int, time: float) -> None:
        """Those who leave in ``slot`` by ``time`` leave before what comes then."""
        for index in self.leaving.get(slot + 1, ()):
            answer = self.done.answers[index]
            if answer.left_in is None and answer.interrupted_at is None and answer.request.leaves <= time:
                answer.left_in = slot
                self._give_back(index)

    def _left(self, resource: Resource, kind: int) -> int:
        """Whole units that are free, 0 if the resource has failed."""
        return 0 if resource in self.down else self.free[resource, kind]

    # Failures

    def _timeline(self) -> dict[int, list[Event]]:
        """The failure timeline by slot; in each slot the repairs come before the failures."""
        events: dict[int, list[Event]] = defaultdict(list)
        last = (0, False)
        for number, entry in enumerate(self.files.scenario["failure_timeline"], start=1):
            where = f"scenario.json failure_timeline entry {number}"
            resource = self._resource(entry)
            slot, kind = entry.get("slot"), entry.get("event")
            if resource is None or not is_index(slot) or kind not in ("repair", "failure"):
                self.problems.add(f"{where}: {entry} is no repair or failure of a VM or link of the network")
                continue
            place = (slot, kind == "failure")
            if place < last or slot >= self.files.scenario["horizon"]:
                self.problems.add(f"{where}: slot {slot} is out of order or beyond the horizon")
            last = max(last, place)
            events[slot].append(Event(resource, kind == "repair"))
        return events

    def _resource(self, entry: dict[str, Any]) -> Resource | None:
        for kind in ("vm", "link"):
            pair = entry.get(kind)
            if isinstance(pair, list) and len(pair) == 2 and all(map(is_index, pair)):
                resource = (kind, *(sorted(pair) if kind == "link" else pair))
                return resource if (resource, 0) in self.free else None
        return None

    def _apply(self, slot: int, event: Event) -> None:
        if event.repaired != (event.resource in self.down):
            state = "working" if event.repaired else "failed"
            what = f"{_name(event.resource)} is {state} already"
            self.problems.add(f"scenario.json failure_timeline: slot {slot}: {what}")
        kind, first, second = event.resource
        # With full duplex a link fails in both directions.
        directions = [event.resource, *([(kind, second, first)] if kind == "link" and self.files.full_duplex else [])]
        if event.repaired:
            self.down.difference_update(directions)
            return
        self.down.update(directions)
        for index in sorted({index for direction in directions for index in self.users[direction]}):
            self.done.answers[index].interrupted_at = slot
            self._give_back(index)

    def _check_interruptions(self) -> None:
        for index, (answer, decision) in enumerate(zip(self.done.answers, self.files.decisions, strict=True)):
            stated = None if decision is None else decision.get("interrupted_at")
            if decision is not None and (stated != answer.interrupted_at or isinstance(stated, (bool, float))):
                self.problems.add(
                    f"{_where(index + 1)}: interrupted_at is {stated}, by the failure timeline it is "
                    f"{answer.interrupted_at}"
                )

    # The books

    def _take(self, where: str, place: tuple[Resource, int], amount: int) -> None:
        resource, kind = place
        if resource in self.down:
            self.problems.add(f"{where}: uses {_name(resource)}, which has failed")
        elif self.free[place] < amount:
            self.problems.add(
                f"{where}: exceeds the capacity of {_name(resource)}: needs {amount / 1e6:g}, "
                f"{self.free[place] / 1e6:g} is left"
            )
        self.free[place] -= amount
        self.in_use[resource[0], kind] += amount

    def _give_back(self, index: int) -> None:
        for (resource, kind), amount in self.done.answers[index].walk.uses:
            self.free[resource, kind] += amount
            self.in_use[resource[0], kind] -= amount
            self.users[resource].discard(index)

    # The answers

    def _answer(self, index: int, request: Request, decision: dict[str, Any] | None) -> None:
        where = f"{_where(index + 1)} (slot {request.slot})"
        answer = Answer(request, False, None, NOTHING)
        self.done.answers.append(answer)
        if decision is None:
            return
        if decision.keys() != DECISION_KEYS:
            self.problems.add(f"{where}: missing or unknown keys {sorted(decision.keys() ^ DECISION_KEYS)}")
            return
        if _identity(decision) != _asked_for(request):
            self.problems.add(f"{where}: {_identity(decision)} is not the request of workload.csv line {index + 2}")
        answer.accepted, answer.reason = decision["accepted"] is True, decision["reason"]
        if not answer.accepted:
            self._check_rejected(where, request, decision)
            self.rejections.steps.count(request, decision)
            return
        if answer.reason is not None:
            self.problems.add(f"{where}: accepted, yet with the reason {answer.reason!r}")
        if decision["tried"] is not None:
            self.problems.add(f"{where}: accepted, yet tried is not null")
        answer.walk = self._walk(where, request, decision["steps"])
        self.rejections.steps.count(request, decision)
        self._check_stated(where, request, decision, answer.walk)
        for (resource, _), _ in answer.walk.uses:
            self.users[resource].add(index)
        self.leaving[request.departure].append(index)

    def _check_rejected(self, where: str, request: Request, decision: dict[str, Any]) -> None:
        reason = decision["reason"]
        if decision["accepted"] is not False:
            self.problems.add(f"{where}: accepted is neither true nor false")
        if reason not in REASONS:
            self.problems.add(f"{where}: rejected with the unknown reason {reason!r}")
        else:
            self._check_reason(where, request, decision)
        if decision["steps"] != []:
            self.problems.add(f"{where}: rejected, yet has steps")
        for key in ("delay_ms", "cost"):
            if decision[key] is not None:
                self.problems.add(f"{where}: rejected, yet {key} is {decision[key]}")

    def _check_reason(self, where: str, request: Request, decision: dict[str, Any]) -> None:
        try:
            possible = self.rejections.reasons(request, decision["tried"])
        except Contradiction as error:
            self.problems.add(f"{where}: tried {error}")
            return
        if decision["reason"] not in possible:
            self.problems.add(
                f"{where}: rejected for {decision['reason']}, what it tried gives {' or '.join(possible)}"
            )

    def _check_stated(self, where: str, request: Request, decision: dict[str, Any], walk: ReplayedWalk) -> None:
        cost, delay = decision["cost"], decision["delay_ms"]
        if not is_number(cost) or not math.isclose(cost, walk.cost, rel_tol=COST_TOLERANCE, abs_tol=1e-12):
            self.problems.add(f"{where}: the cost is {cost}, the steps cost {walk.cost!r}")
        if not is_number(delay) or abs(delay - walk.delay) > STATED_DELAY_TOLERANCE:
            self.problems.add(f"{where}: the delay is {delay} ms, the steps take {walk.delay!r} ms")
        tolerable = self.files.asked(request).tolerable_delay
        if walk.delay > tolerable + STATED_DELAY_TOLERANCE:
            self.problems.add(f"{where}: the steps take {walk.delay!r} ms, {tolerable:g} ms are tolerable")

    def _walk(self, where: str, request: Request, steps: Any) -> ReplayedWalk:
        """Follow the steps, reserve what they use, and recompute cost and delay; stops where they make no sense."""
        service = self.files.asked(request)
        at = Progress(request.ingress, 0)
        uses: list[tuple[tuple[Resource, int], int]] = []
        cost = delay = 0.0
        hops = 0
        for number, step in self._well_formed(where, request, steps):
            here = f"{where} step {number}"
            to, index, function = step
            problem = rule_broken(self.files, request, at, step)
            if problem:
                self.problems.add(f"{here}: {problem}")
            if at.node not in (to, FREE):
                found = self.files.link_between(at.node, to)
                if found is None:
                    break
                ends, link = found
                segment = min(at.placed, len(service.load))
                hops += 1
                cost += link.unit_cost * service.rate[segment]
                delay += link.delay + 1000 * service.rate[segment] / link.capacity
                uses.append(((("link", *ends), 0), service.rate_units[segment]))
                self._take(here, *uses[-1])
            if function is not None and function < len(service.load):
                vm = self.files.vms[to][index]
                cost += sum(price * amount for price, amount in zip(vm.unit_cost, service.load[function], strict=True))
                delay += service.own_delay[function] + 1000 * service.work[function] / vm.capacity[0]
                for kind, amount in enumerate(service.load_units[function]):
                    uses.append(((("vm", to, index), kind), amount))
                    self._take(here, *uses[-1])
                at = Progress(to, at.placed + 1, at.stands_on | {to})
            if at.node != to:
                at = Progress(to, at.placed, at.stands_on)
        if request.egress != FREE and at.node != request.egress:
            self.problems.add(f"{where}: the walk ends on node {at.node}, not on the egress {request.egress}")
        if at.placed != len(service.load):
            self.problems.add(f"{where}: {at.placed} of {len(service.load)} functions are placed")
        return ReplayedWalk(uses, cost, delay, hops)

    def _well_formed(self, where: str, request: Request, steps: Any) -> Iterator[tuple[int, list[Any]]]:
        """The steps with their numbers from 1, up to the first that names no VM of the network."""
        most = self.rejections.steps.left(request)
        if not isinstance(steps, list):
            self.problems.add(f"{where}: steps is not a list")
            return
        if len(steps) > most:
            self.problems.add(f"{where}: {len(steps)} steps, {most} are allowed")
        for number, step in enumerate(steps, start=1):
            if not (
                isinstance(step, list)
                and len(step) == 3
                and is_index(step[0])
                and is_index(step[1])
                and (step[2] is None or (is_index(step[2]) and step[2] >= 0))
            ):
                self.problems.add(f"{where} step {number}: {step} is not [node, vm, function or null]")
                return
            if not may_name(self.files, step):
                self.problems.add(f"{where} step {number}: node {step[0]} has no VM {step[1]}")
                return
            yield number, step


def _name(resource: Resource) -> str:
    kind, a, b = resource
    return f"VM {b} of node {a}" if kind == "vm" else f"link {a}-{b}"
