"""Which reason the model gives for a rejection, from the steps that the request tried and the capacities left then."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from nfv_torchrl.evaluation.audit.budgets import Steps
from nfv_torchrl.evaluation.audit.files import FREE, Link, Request, RunFiles, is_index
from nfv_torchrl.evaluation.audit.rules import STATED_DELAY_TOLERANCE, Progress, Resource, may_name, rule_broken

REASONS = (
    "link_capacity", "vm_capacity", "delay", "step_limit", "no_feasible_action", "rejected_by_policy", "invalid_action",
)  # fmt: skip
REJECT, NO_ACTION = "reject", "no action"
"""The last entry of ``tried`` where it is no step."""


class Contradiction(Exception):
    """The steps tried cannot have been answered like this at all; says why."""


@dataclass
class _State:
    """A walk under way: ``taken`` is its own use of each resource, whole units."""

    request: Request
    node: int
    budget: float  # ms
    placed: int = 0
    elapsed: float = 0.0
    steps: int = 0
    taken: dict[tuple[Resource, int], int] = field(default_factory=dict)  # by resource and kind
    stands_on: frozenset[int] = frozenset()

    @property
    def progress(self) -> Progress:
        """Where it is, for the rules."""
        return Progress(self.node, self.placed, self.stands_on)


class Rejections:
    """Answers ``reasons`` for one run.

    Args:
        files: the run.
        left: whole units of a resource of a kind (0 for links) that are free now, 0 if it has failed.
    """

    def __init__(self, files: RunFiles, left: Callable[[Resource, int], int]) -> None:
        self.files, self.left = files, left
        self.neighbours: list[list[int]] = [[] for _ in files.vms]
        for a, b in files.links:
            self.neighbours[a].append(b)
            self.neighbours[b].append(a)
        self.neighbours = [sorted(set(around)) for around in self.neighbours]
        self._to_egress: dict[tuple[float, int], list[float]] = {}
        self.steps = Steps(files)

    def reasons(self, request: Request, tried: Any) -> list[str]:
        """All reasons that fit, sorted: one, or two where a delay lies within rounding of the limit.

        Raises:
            Contradiction: ``tried`` is malformed, goes on after a step that ends a request, or ends with one that
                does not.
        """
        if not isinstance(tried, list) or not tried:
            raise Contradiction(f"is {tried!r}, not the steps up to the one that was refused")
        found, problems = set(), []
        tolerable = self.files.asked(request).tolerable_delay
        for slack in (-STATED_DELAY_TOLERANCE, STATED_DELAY_TOLERANCE):
            try:
                found.add(self._reason(_State(request, request.ingress, tolerable + slack), tried))
            except Contradiction as error:
                problems.append(error)
        if not found:
            raise problems[0]
        return sorted(found)

    def _reason(self, state: _State, tried: list[Any]) -> str:
        for number, step in enumerate(tried, start=1):
            if self._arrived(state):
                raise Contradiction(f"step {number} comes after the walk has ended at the egress")
            reason = self._answer(state, number, step)
            if reason is not None:
                if number < len(tried):
                    raise Contradiction(f"step {number} is refused ({reason}), yet more steps follow")
                return reason
            self._advance(state, step)
        raise Contradiction("passes every check to its last step, which refuses nothing")

    def _arrived(self, state: _State) -> bool:
        chain = self.files.asked(state.request).load
        ended = state.node == state.request.egress or (state.request.egress == FREE and state.node != FREE)
        return ended and state.placed == len(chain)

    def _answer(self, state: _State, number: int, step: Any) -> str | None:
        """The reason that an entry of ``tried`` is refused for, None if it passes."""
        if step == REJECT:
            return self._why_rejected(state)
        if step == NO_ACTION:
            return "invalid_action"
        if not (isinstance(step, list) and len(step) == 3 and is_index(step[0]) and is_index(step[1])):
            raise Contradiction(f"step {number}, {step!r}, is no step")
        if step[2] is not None and not (is_index(step[2]) and step[2] == state.placed):
            raise Contradiction(f"step {number} places function {step[2]!r}, it is at function {state.placed}")
        if not self._possible(state, step):
            return "invalid_action"
        return self._check(state, step)

    def _why_rejected(self, state: _State) -> str:
        if not any(self._possible(state, step) for step in self._steps_from(state)):
            return "no_feasible_action"
        return "rejected_by_policy" if self.files.scenario["admission_control"] else "invalid_action"

    def _steps_from(self, state: _State) -> Iterator[list[Any]]:
        nodes = range(len(self.files.vms)) if state.node == FREE else (state.node, *self.neighbours[state.node])
        for node in nodes:
            for vm in range(max(len(self.files.vms[node]), 1)):
                yield [node, vm, None]
                yield [node, vm, state.placed]

    def _possible(self, state: _State, step: list[Any]) -> bool:
        """Whether the mask of the run allows a step."""
        if not may_name(self.files, step) or rule_broken(self.files, state.request, state.progress, step):
            return False
        if self.files.scenario["mask"] == "adjacency":
            return True
        after = state.elapsed + self._delay(state, step)
        if state.request.egress != FREE:
            after += self._delay_to_egress(state.request)[step[0]]
        return self._check(state, step) is None and after <= state.budget

    def _check(self, state: _State, step: list[Any]) -> str | None:
        """The checks of Algorithm 3 in their order, against what is left, the walk's own use included."""
        for (resource, kind), amount in self._uses(state, step):
            if self.left(resource, kind) - state.taken.get((resource, kind), 0) < amount:
                return f"{resource[0]}_capacity"
        if state.elapsed + self._delay(state, step) > state.budget:
            return "delay"
        return "step_limit" if state.steps + 1 > self.steps.left(state.request) else None

    def _uses(self, state: _State, step: list[Any]) -> Iterator[tuple[tuple[Resource, int], int]]:
        node, vm, function = step
        service = self.files.asked(state.request)
        link = self._link(state, node)
        if link is not None:
            yield (("link", *link[0]), 0), service.rate_units[state.placed]
        if function is not None:
            for kind, amount in enumerate(service.load_units[function]):
                yield (("vm", node, vm), kind), amount

    def _link(self, state: _State, node: int) -> tuple[tuple[int, int], Link] | None:
        """The link that a step to ``node`` uses, None if it uses none."""
        return None if state.node in (node, FREE) else self.files.link_between(state.node, node)

    def _delay(self, state: _State, step: list[Any]) -> float:
        node, vm, function = step
        service, delay = self.files.asked(state.request), 0.0
        link = self._link(state, node)
        if link is not None:
            delay += link[1].delay + 1000 * service.rate[state.placed] / link[1].capacity
        if function is not None:
            work = 1000 * service.work[function] / self.files.vms[node][vm].capacity[0]
            delay += service.own_delay[function] + work
        return delay

    def _advance(self, state: _State, step: list[Any]) -> None:
        state.elapsed += self._delay(state, step)
        for resource, amount in self._uses(state, step):
            state.taken[resource] = state.taken.get(resource, 0) + amount
        if step[2] is not None:
            state.stands_on |= {step[0]}
        state.node = step[0]
        state.placed += step[2] is not None
        state.steps += 1

    def _delay_to_egress(self, request: Request) -> list[float]:
        """ms from each node to the egress over links alone at the least rate, capacities ignored (Dijkstra)."""
        key = (min(self.files.asked(request).rate), request.egress)
        if key not in self._to_egress:
            self._to_egress[key] = self._shortest(*key)
        return self._to_egress[key]

    def _shortest(self, rate: float, egress: int) -> list[float]:
        best = [math.inf] * len(self.files.vms)
        best[egress] = 0.0
        waiting = [(0.0, egress)]
        while waiting:
            so_far, node = heapq.heappop(waiting)
            for there in self.neighbours[node] if so_far <= best[node] else ():
                _, link = self.files.link_between(there, node)  # type: ignore[misc]  # neighbours have one
                delay = so_far + link.delay + 1000 * rate / link.capacity
                if delay < best[there]:
                    best[there] = delay
                    heapq.heappush(waiting, (delay, there))
        return best
