"""``check_planner``: does a planner keep to the contract of ``Planner``, and within the network?"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method, scenario_for
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.scenario import Scenario
from nfv_torchrl.simulator import REASON_NAMES, Simulator
from nfv_torchrl.simulator.snapshot import take_snapshot
from nfv_torchrl.testing.worlds import full_scenario

ENVS = 3


def check_planner(planner: Planner, *, scenario: Scenario | None = None, seed: int = 0) -> None:
    """Check a planner on a small network that fills up, with colocation and without.

    - It writes plans and lengths of the rows it is asked for, and nothing into the world or into other rows.
    - Asked again it plans the same, and the same for an environment alone as among others.
    - Every plan that it gives can be carried out: each step passes the checks of the network, and the last one
      completes the request. So it overbooks nothing and is in time.
    - A whole horizon of its decisions passes the audit.

    Args:
        planner: as its class makes it; ``prepare`` is called here.
        scenario: where to try it; default six nodes.
        seed: of the requests.

    Raises:
        AssertionError: with what is wrong.

    Example::

        check_planner(ReservePlanner())
    """
    for colocation in (False, True) if scenario is None or scenario.placement is None else (False,):
        world = scenario.replace(colocation=colocation) if scenario else full_scenario(colocation=colocation)
        method = PlannerMethod(planner, name="checked")
        _play(planner, scenario_for(world, method), seed)
        _audit(method, world, seed)


def _play(planner: Planner, scenario: Scenario, seed: int) -> None:
    """Plan every request of three horizons, look at the plan, and walk it."""
    simulator = Simulator(scenario, ENVS)
    for b in range(ENVS):
        simulator.start(b, scenario.workload(seed, b), scenario.failure_timeline(seed, b))
    planner.prepare(simulator.world)
    reject, env = simulator.num_actions - 1, simulator.world.env
    plans = np.zeros((ENVS, simulator.world.rules.max_steps), np.int64)
    lengths = np.zeros(ENVS, np.int64)
    while not env["done"].all():
        fresh = np.flatnonzero((env["steps"] == 0) & (env["done"] == 0))
        if fresh.size:
            _plan(planner, simulator, fresh, plans, lengths)
        step = env["steps"].copy()
        planned = (env["done"] == 0) & (step < lengths)
        last = step == lengths - 1
        actions = np.where(planned, plans[np.arange(ENVS), np.minimum(step, plans.shape[1] - 1)], reject)
        simulator.step(actions)
        _check_step(simulator.outcome, planned, last, step)


def _check_step(outcome: dict[str, np.ndarray], planned: np.ndarray, last: np.ndarray, step: np.ndarray) -> None:
    """A planned step passes, and the last one of a plan completes the request."""
    for b in np.flatnonzero(planned):
        if outcome["passed"][b] == 0:
            reason = REASON_NAMES[int(outcome["reason"][b])]
            raise AssertionError(
                f"step {step[b]} of a plan is refused by the network ({reason}); plan with what is offered now, and "
                "count what the plan itself takes"
            )
        complete = outcome["accepted"][b] > 0
        assert complete or not last[b], "a plan ends before the request is at its egress with all functions placed"
        assert last[b] or not complete, "a plan goes on after its request is complete"


def _plan(planner: Planner, simulator: Simulator, rows: np.ndarray, plans: np.ndarray, lengths: np.ndarray) -> None:
    """Plans of ``rows``, checked for what they leave alone."""
    before = take_snapshot(simulator.world)
    kept = np.setdiff1d(np.arange(ENVS), rows)
    other_plans, other_lengths = plans[kept].copy(), lengths[kept].copy()
    planner.plan_rows(simulator.world, rows, plans, lengths)
    untouched = (plans[kept] == other_plans).all() and (lengths[kept] == other_lengths).all()
    assert untouched, "plan_rows writes into rows that it was not asked for"
    after = take_snapshot(simulator.world)
    changed = [name for name in before if not np.array_equal(before[name], after[name])]
    assert not changed, f"the planner writes into the world ({', '.join(changed)}); copy what you change"
    most = plans.shape[1]
    assert ((lengths[rows] >= 0) & (lengths[rows] <= most)).all(), f"a plan has {lengths[rows]} actions; 0 to {most}"
    for b in rows:
        again, length = np.zeros_like(plans), np.zeros_like(lengths)
        planner.plan_rows(simulator.world, np.array([b]), again, length)
        same = length[b] == lengths[b] and (again[b, : length[b]] == plans[b, : lengths[b]]).all()
        assert same, "planned again, or alone instead of among others, the same request gets another plan"


def _audit(method: PlannerMethod, scenario: Scenario, seed: int) -> None:
    """Its decisions over a whole horizon as files, recomputed by code that knows nothing of the simulator."""
    (record,) = run_method(scenario, method, [seed])
    with tempfile.TemporaryDirectory() as folder:
        write_run(Path(folder) / "run", record, compute_metrics(record))
        problems = audit_run(Path(folder) / "run").problems
    assert not problems, f"the audit found: {problems[0]}"
