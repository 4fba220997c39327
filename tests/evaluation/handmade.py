"""Runs on the network of ``toy.py``, made by a slow first-fit in plain Python apart from all code it serves to test."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import toy

from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.workload import Workload

Step = tuple[int, int, int | None]  # node, VM, function or None
NO_REASON, REJECTED_BY_POLICY, INVALID_ACTION = -1, 5, 6
REJECT = -1
LONGEST_WALK = 6


class FirstFit:
    """Accepts a request on the first walk, in the order tried, that fits; steps through the slots of a workload."""

    def __init__(self, scenario: Scenario, workload: Workload, timeline: FailureTimeline) -> None:
        self.scenario, self.workload, self.timeline = scenario, workload, timeline
        net = scenario.substrate
        self.link_of = {tuple(ends): k for k, ends in enumerate(net.links.tolist())}
        self.link_of |= {(v, u): k for (u, v), k in self.link_of.items()}
        self.free = {("vm", n, v): net.vm_capacity[n, v] for n in range(4) for v in range(net.vm_count[n])}
        self.free |= {("link", k): x for k, x in enumerate(net.link_capacity)}
        self.down: set[tuple] = set()
        self.running: dict[int, list[tuple[tuple, float]]] = {}
        self.interrupted: dict[int, int] = {}

    def walks(self, node: int, egress: int, placed: int, chain: int, so_far: list[Step]) -> Iterator[list[Step]]:
        """All walks of at most LONGEST_WALK steps, places before forwards, near VMs before far ones."""
        if node == egress and placed == chain:
            yield so_far
            return
        if len(so_far) == LONGEST_WALK:
            return
        stay = placed < chain and (node == egress or self.scenario.colocation)
        beside = [] if node == egress else [n for n in range(4) if (node, n) in self.link_of]
        for there in [node] * stay + beside:
            vms = range(int(self.scenario.substrate.vm_count[there]))
            options = [(there, vm, placed) for vm in vms if placed < chain]
            options += [(there, 0, None)] if there != node else []
            for step in options:
                yield from self.walks(there, egress, placed + (step[2] is not None), chain, [*so_far, step])

    def uses(self, ingress: int, service: int, walk: list[Step]) -> tuple[list, float, float, int]:
        """(resource, amount) of each step, cost, delay, links used."""
        net, catalogue = self.scenario.substrate, self.scenario.catalogue
        rate = float(catalogue.rate[service])
        uses, cost, delay, hops, node = [], 0.0, 0.0, 0, ingress
        for there, vm, function in walk:
            if there != node:
                k = self.link_of[node, there]
                uses.append((("link", k), rate))
                cost += net.link_unit_cost[k] * rate
                delay += net.link_delay[k] + 1000 * rate / net.link_capacity[k]
                hops += 1
            if function is not None:
                load = float(catalogue.load[service, function])
                uses.append((("vm", there, vm), load))
                cost += net.vm_unit_cost[there, vm] * load
                delay += 1000 * load / net.vm_capacity[there, vm]
            node = there
        return uses, cost, delay, hops

    def fits(self, uses: list) -> bool:
        want: dict[tuple, float] = {}
        for resource, amount in uses:
            want[resource] = want.get(resource, 0) + amount
        return all(resource not in self.down and self.free[resource] >= x for resource, x in want.items())

    def give_back(self, row: int) -> None:
        for resource, amount in self.running.pop(row):
            self.free[resource] += amount

    def begin_slot(self, slot: int) -> None:
        for row in [row for row in self.running if self.workload.departure[row] <= slot]:
            self.give_back(row)
        for at, index, up in zip(self.timeline.slot, self.timeline.resource, self.timeline.up, strict=True):
            if at == slot:
                links = int(index) - toy.NODES * toy.VMS
                name = ("link", links) if links >= 0 else ("vm", *divmod(int(index), toy.VMS))
                self.down = self.down - {name} if up else self.down | {name}
                for row in [row for row, uses in self.running.items() if not up and name in dict(uses)]:
                    self.give_back(row)
                    self.interrupted[row] = slot

    def run(
        self,
        method: str = "first_fit",
        seed: int = 0,
        refuse: frozenset[int] = frozenset(),
        walks: dict[int, list[Step]] | None = None,
    ) -> RunRecord:
        """Answer every request; the rows in ``refuse`` are refused by policy, those in ``walks`` walk so unchecked."""
        forced = walks or {}
        size = len(self.workload)
        # Whoever takes ``reject`` refuses where that is allowed; elsewhere it is no valid action while others are.
        refusal = REJECTED_BY_POLICY if self.scenario.admission_control else INVALID_ACTION
        accepted, reason = np.zeros(size, bool), np.full(size, refusal, np.int8)
        delay_ms, cost, hops = np.full(size, math.nan), np.full(size, math.nan), np.zeros(size, np.int64)
        steps: list[list[Step]] = [[(REJECT, 0, None)] for _ in range(size)]
        for slot in range(self.scenario.horizon):
            self.begin_slot(slot)
            for row in np.flatnonzero(self.workload.slot == slot).tolist():
                if row in refuse:
                    continue
                service, ingress = int(self.workload.service[row]), int(self.workload.ingress[row])
                chain = int(self.scenario.catalogue.chain_length[service])
                tried = self.walks(ingress, int(self.workload.egress[row]), 0, chain, [])
                for walk in [forced[row]] if row in forced else tried:
                    uses, price, time, links = self.uses(ingress, service, walk)
                    in_time = time <= self.scenario.catalogue.tolerable_delay[service]
                    if row in forced or (in_time and self.fits(uses)):
                        for resource, amount in uses:
                            self.free[resource] -= amount
                        self.running[row] = uses
                        accepted[row], reason[row], steps[row] = True, NO_REASON, walk
                        delay_ms[row], cost[row], hops[row] = time, price, links
                        break
        flat = [step for walk in steps for step in walk]
        return RunRecord(
            method=method, workload_seed=seed, scenario=self.scenario, workload=self.workload, timeline=self.timeline,
            accepted=accepted, reason=reason, delay_ms=delay_ms, cost=cost, hops=hops,
            interrupted_at=np.array([self.interrupted.get(row, -1) for row in range(size)], np.int64),
            step_offsets=np.cumsum([0, *map(len, steps)]),
            step_node=np.array([node for node, _, _ in flat], np.int32),
            step_vm=np.array([vm for _, vm, _ in flat], np.int32),
            step_function=np.array([-1 if f is None else f for _, _, f in flat], np.int32),
            seconds=0.5,
        )  # fmt: skip


def first_fit(
    scenario: Scenario | None = None,
    workload: Workload | None = None,
    timeline: FailureTimeline | None = None,
    **settings,
) -> RunRecord:
    """A run of ``FirstFit``; by default on the toy scenario, its workload, without failures."""
    scenario = toy.toy_scenario() if scenario is None else scenario
    workload = toy.toy_workload() if workload is None else workload
    timeline = FailureTimeline.empty() if timeline is None else timeline
    return FirstFit(scenario, workload, timeline).run(**settings)


def read_decisions(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "decisions.jsonl").read_text().splitlines()]


def write_decisions(folder: Path, decisions: list[dict]) -> None:
    (folder / "decisions.jsonl").write_text("".join(json.dumps(decision) + "\n" for decision in decisions))
