"""The limit on the labels of an exact search: answers stay feasible, and those without proof are counted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from general_cases import general_case, plan_and_play
from test_myopic import toy_case
from toy import DUO, DUO_0_TO_3, SOLO

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.data_frames import metrics_frame
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.tables import detail_table
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.planners import GreedyPlanner, MyopicPlanner, PricedPlanner
from nfv_torchrl.planners.base import Planner
from nfv_torchrl.planners.learned_prices import LearnedPrices
from nfv_torchrl.scenario.random_graph import draw_random_substrate
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType
from nfv_torchrl.simulator.state import World

NEVER = 10**9


def plan_of(planner: Planner, world: World) -> list[int]:
    plans, lengths = np.zeros((1, world.rules.max_steps), np.int64), np.zeros(1, np.int64)
    planner.prepare(world)
    planner.plan_rows(world, np.zeros(1, np.int64), plans, lengths)
    return plans[0, : lengths[0]].tolist()


def test_a_limit_that_is_never_reached_changes_nothing():
    free, limited = MyopicPlanner(), MyopicPlanner(labels=NEVER)
    for seed in range(60):
        world = general_case(seed).world
        assert plan_of(limited, world) == plan_of(free, world)
        assert limited.unproved.tolist() == [0] and free.unproved is None


def test_learned_prices_may_be_limited_too():
    """Without prices they are the exact search, limited or not."""
    for seed in range(40):
        world = general_case(seed).world
        learned, exact = (make(40) for make in (unpriced, lambda labels: MyopicPlanner(labels=labels)))
        assert plan_of(learned, world) == plan_of(exact, world)
        assert learned.unproved.tolist() == exact.unproved.tolist()


def unpriced(labels: int) -> LearnedPrices:
    return LearnedPrices(PriceNetwork().weights(), labels=labels)


@pytest.mark.parametrize("labels", [1, 40])
def test_answers_are_feasible_and_those_not_counted_are_the_best(labels):
    unproved = dearer = 0
    for seed in range(150):
        planner = MyopicPlanner(labels=labels)
        cost, best = plan_and_play(planner, general_case(seed)), plan_and_play(MyopicPlanner(), general_case(seed))
        counted = int(planner.unproved[0])
        assert cost >= best - 1e-9
        assert counted or cost == best or cost == pytest.approx(best, abs=1e-6), seed
        unproved, dearer = unproved + counted, dearer + (cost > best + 1e-6 and math.isfinite(best))
    assert unproved > 5 and dearer < unproved


def test_only_the_requests_that_need_labels_are_without_proof():
    """With time enough the walk of the bounds is the answer, without a label. Else one label is too few."""
    in_time = toy_case(SOLO, 3, 0)
    in_time = in_time._replace(tables=in_time.tables._replace(tolerable_delay=np.full(2, 1e9)))
    planner = MyopicPlanner(labels=1)
    for case, count in ((in_time, 0), (toy_case(SOLO, 3, 0), 1), (toy_case(DUO, 0, 3), 1)):
        planner = MyopicPlanner(labels=1)
        plan_of(planner, case.world)
        assert planner.unproved.tolist() == [count]
    # The narrow search finds the best walk of the last one, but does not know it.
    assert plan_of(planner, toy_case(DUO, 0, 3).world) == DUO_0_TO_3[2]


def crowded() -> Scenario:
    """A ring-like network on which walks with functions on nodes of their own soon need what they used before."""
    chain = ServiceType("chain", ("NAT", "FW", "TM", "VOC"), 4.0, None, ingress="any", egress="any")
    substrate = draw_random_substrate(8, 3, mean_degree=2.5, vms=(1, 1), link_capacity=(12, 20))
    return Scenario(
        "crowded", 0, substrate, ServiceCatalogue((chain,)), horizon=60, endpoints="uniform", placement="distinct",
        arrival_rate=1.0, mean_lifetime=30.0,
    )  # fmt: skip


def test_the_count_reaches_files_tables_and_data_frames(tmp_path: Path):
    scenario = crowded()
    comparison = Comparison(scenario)
    planners = {"limited": PricedPlanner(labels=1), "free": PricedPlanner(), "greedy": GreedyPlanner()}
    for name, planner in planners.items():
        for _ in range(2):  # the count begins anew with every run
            (record,) = run_method(scenario, PlannerMethod(planner, name=name), [0])
        metrics = compute_metrics(record)
        assert ("unproved" in metrics) == (name == "limited")
        write_run(tmp_path / name, record, metrics)
        audit_run(tmp_path / name).raise_if_problems()
        comparison.add(record, metrics)
    count = comparison.metrics["limited"][0]["unproved"]
    assert 0 < count < record.num_requests
    table = detail_table(comparison)
    column = table.columns.index("unproved")
    assert [row[column] for row in table.rows] == [f"{count:.2f}" if count < 100 else f"{count:.1f}", "–", "–"]
    assert metrics_frame(comparison).loc[("limited", 0), "unproved"] == count


def test_several_environments_are_counted_apart():
    scenario = crowded()
    together = run_method(scenario, PlannerMethod(MyopicPlanner(labels=1), name="m"), [0, 1, 2])
    alone = [run_method(scenario, PlannerMethod(MyopicPlanner(labels=1), name="m"), [seed])[0] for seed in range(3)]
    assert [run.unproved for run in together] == [run.unproved for run in alone]
    assert len({run.unproved for run in alone}) > 1


def test_a_limit_below_one_is_refused():
    with pytest.raises(ScenarioError, match="labels is 0; give at least 1, or None"):
        PricedPlanner(labels=0)
