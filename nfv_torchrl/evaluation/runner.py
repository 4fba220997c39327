"""Runs a method on workloads, several at once, and turns what the simulator logged into run records."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from nfv_torchrl.codec import decode_action
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.records import FORWARD, NO_ACTION, REJECT, RunRecord
from nfv_torchrl.methods import MayStop, Method, WholePlay, WholeWalks
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.together import play_apart
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.reasons import NO_REASON

MOST_TOGETHER = 64
"""Runs made at the same time; the log of one takes some 10 MB for 100,000 requests."""
ROUNDS_PER_REPORT = 256

Progress = Callable[[int], object]
"""Told how many more requests have been answered (``ProgressBar.update``)."""


def scenario_for(scenario: Scenario, method: Method) -> Scenario:
    """The scenario as ``method`` runs it: with its own mask, and with ``admission_control`` if it refuses by itself."""
    changes: dict[str, object] = {}
    if method.mask is not None and method.mask != scenario.mask:
        changes["mask"] = method.mask
    if method.decides_admission and not scenario.admission_control:
        changes["admission_control"] = True
    return scenario.replace(**changes) if changes else scenario


def run_method(
    scenario: Scenario | Sequence[Scenario],
    method: Method,
    seeds: Sequence[int],
    *,
    progress: Progress | None = None,
    workloads: Sequence[Workload] | None = None,
    threads: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> list[RunRecord]:
    """Run ``method`` on one workload per seed, each from an empty network to the end of its horizon.

    Requests and failures follow from scenario and seed alone, so every method meets the same. What a planner or a
    rule decides under a seed does not depend on the other seeds.

    Args:
        scenario: one for all seeds, or one for each (of the same services, horizon and rules).
        method: what decides.
        seeds: workload seeds, S of them.
        progress: called now and then with the number of requests answered since.
        workloads: S workloads instead of those of the seeds.
        threads: threads of the simulator.
        clock: seconds, read around every decision: wall time, or ``time.process_time`` where other work on the machine
            shall not count.

    Returns:
        S records in the order of ``seeds``. Their ``seconds`` are those within ``method.act`` or ``method.plan`` alone
        (of a ``WholePlay``: of its plays, with the simulator's steps): of the whole batch, shared out by number of
        requests.

    Raises:
        ScenarioError: no seeds, a number of scenarios or workloads other than S, scenarios that do not go together.
    """
    if not len(seeds):
        raise ScenarioError("seeds: none was given; a run needs at least one workload seed")
    scenarios = [scenario] if isinstance(scenario, Scenario) else list(scenario)
    for what, given in (("scenarios", scenarios), ("workloads", workloads)):
        if given is not None and len(given) not in ({1, len(seeds)} if given is scenarios else {len(seeds)}):
            raise ScenarioError(f"{len(given)} {what} were given for {len(seeds)} seeds; give one for each")
    scenarios = [scenario_for(each, method) for each in scenarios]
    records: list[RunRecord] = []
    together = 1 if play_apart(scenarios) else MOST_TOGETHER
    for first in range(0, len(seeds), together):
        group = slice(first, first + together)
        here = scenarios if len(scenarios) == 1 else scenarios[group]
        simulator = Simulator(here, len(seeds[group]), one_hot=method.one_hot, record=True, threads=threads)
        given = None if workloads is None else workloads[group]
        records += _run_together(simulator, method, [int(seed) for seed in seeds[group]], given, progress, clock)
    return records


def _run_together(
    simulator: Simulator,
    method: Method,
    seeds: Sequence[int],
    workloads: Sequence[Workload] | None,
    progress: Progress | None,
    clock: Callable[[], float],
) -> list[RunRecord]:
    if workloads is None:
        workloads = [simulator.scenario(b).workload(seed) for b, seed in enumerate(seeds)]
    timelines = [simulator.scenario(b).failure_timeline(seed) for b, seed in enumerate(seeds)]
    for b, (workload, timeline) in enumerate(zip(workloads, timelines, strict=True)):
        simulator.start(b, workload, timeline)
    method.prepare(simulator, seeds)
    seconds = _play(simulator, method, progress, clock)
    requests = sum(len(workload) for workload in workloads)
    counts = method.unproved() if isinstance(method, MayStop) else None
    unproved = [None] * len(seeds) if counts is None else counts.tolist()
    shares = [seconds * len(workload) / max(requests, 1) for workload in workloads]
    return [
        RunRecord(
            method=method.name,
            workload_seed=seed,
            scenario=simulator.scenario(b),
            workload=workload,
            timeline=timeline,
            seconds=shares[b],
            unproved=unproved[b],
            **_answers(simulator, b, workload),
        )
        for b, (seed, workload, timeline) in enumerate(zip(seeds, workloads, timelines, strict=True))
    ]


def _play(simulator: Simulator, method: Method, progress: Progress | None, clock: Callable[[], float]) -> float:
    """Step all environments to the end of their horizons. Returns the seconds spent deciding."""
    if isinstance(method, WholePlay):
        return _play_whole(simulator, method, progress, clock)
    decide = (
        partial(_plan_and_answer, simulator, method, clock)
        if isinstance(method, WholeWalks)
        else partial(_act_and_step, simulator, method, clock)
    )
    env = simulator.world.env
    seconds, rounds, answered = 0.0, 0, 0
    while not env["done"].all():
        seconds += decide()
        rounds += 1
        if progress is not None and rounds % ROUNDS_PER_REPORT == 0:
            total = int(env["cursor"].sum())
            progress(total - answered)
            answered = total
    if progress is not None:
        progress(int(env["cursor"].sum()) - answered)
    return seconds


def _act_and_step(simulator: Simulator, method: Method, clock: Callable[[], float]) -> float:
    """One step of every environment; the seconds spent deciding."""
    begun = clock()
    actions = method.act(simulator)
    seconds = clock() - begun
    if actions.shape != (simulator.batch_size,):
        raise ScenarioError(f"{method.name}: act returned shape {actions.shape}, not ({simulator.batch_size},)")
    simulator.step(np.ascontiguousarray(actions, np.int64))
    return seconds


def _plan_and_answer(simulator: Simulator, method: WholeWalks, clock: Callable[[], float]) -> float:
    """One request of every environment; the seconds spent deciding."""
    begun = clock()
    plans, lengths = method.plan(simulator)
    seconds = clock() - begun
    simulator.answer(plans, lengths)
    return seconds


def _play_whole(
    simulator: Simulator, method: WholePlay, progress: Progress | None, clock: Callable[[], float]
) -> float:
    """The same, one environment after the other, each in a call. Returns the seconds of it all."""
    begun = clock()
    for b in range(simulator.batch_size):
        method.play(simulator, b)
        if progress is not None:
            progress(int(simulator.world.env["cursor"][b]))
    return clock() - begun


def _answers(simulator: Simulator, b: int, workload: Workload) -> dict[str, np.ndarray]:
    """What environment b answered, as arrays of its own: fields of a ``RunRecord``."""
    log, requests = simulator.world.log, len(workload)
    offsets = log.start[b, : requests + 1].copy()
    _, nodes, vms, _ = simulator.tables.vm_capacity.shape
    node, vm, function = _steps(log.action[b, : offsets[-1]], offsets, nodes, vms)
    if simulator.world.rules.switches:
        chain = simulator.tables.chain_length[workload.profile]
        function[function >= np.repeat(chain, np.diff(offsets))] = FORWARD
    reason = log.reason[b, :requests].copy()
    return {
        "accepted": reason == NO_REASON,
        "reason": reason,
        "delay_ms": log.delay[b, :requests].copy(),
        "cost": log.cost[b, :requests].copy(),
        "hops": log.hops[b, :requests].astype(np.int64),
        "interrupted_at": log.interrupted_at[b, :requests].astype(np.int64),
        "step_offsets": offsets,
        "step_node": node,
        "step_vm": vm,
        "step_function": function,
    }


def _steps(actions: np.ndarray, offsets: np.ndarray, nodes: int, vms: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Node, VM and function, int32 each, of actions; functions are placed in the order of the chain.

    Instead of a node: ``REJECT`` for the action after all of these, ``NO_ACTION`` for -1.
    """
    node, vm, places = decode_action(actions, vms)
    places &= actions >= 0
    placed = np.r_[0, np.cumsum(places)]  # before each step, over all walks
    before = np.repeat(placed[offsets[:-1]], np.diff(offsets))  # placed before the walk began
    function = np.where(places, placed[:-1] - before, FORWARD)
    node = np.where(actions < 0, NO_ACTION, node)
    node[node == nodes] = REJECT
    return node.astype(np.int32), vm.astype(np.int32), function.astype(np.int32)
