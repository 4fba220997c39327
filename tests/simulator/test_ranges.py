"""Rates and tolerable delays that every request draws for itself, and mean lifetimes of services."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import Instance
from test_agreement import run_both

from nfv_torchrl.bounds.bound import blind_bound, hindsight_bound
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evaluation.walk_figure import title_of
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.planners.greedy import GreedyPlanner
from nfv_torchrl.planners.milp import MilpPlanner
from nfv_torchrl.planners.myopic import MyopicPlanner
from nfv_torchrl.scenario.failures import FailureTimeline
from nfv_torchrl.scenario.files import read_run_folder
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario

SERVICES = {
    "drawn": {"chain": ["A", "B"], "rate": [1, 3], "tolerable_delay": [100, 500]},
    "late": {"chain": ["A"], "rate": 2, "tolerable_delay": [50, 60], "weight": 2, "mean_lifetime": 30},
    "fixed": {"chain": ["B"], "rate": 0.5, "tolerable_delay": 100},
}


def scenario_of(services=SERVICES, **changes) -> Scenario:
    settings = {"horizon": 12, "arrival_rate": 3, "mean_lifetime": 4, "vnfs": {"A": 2, "B": 3}, "pairs_per_service": 4}
    substrate = {"nodes": 5, "vms_max": 2, "vm_capacity": [20, 60], "link_capacity": [10, 30]}
    return Scenario.from_config({**settings, "services": services, "substrate": substrate, **changes})


def test_the_values_of_an_interval():
    drawn = scenario_of().catalogue.drawn
    mine = drawn.service == 0
    # 21 rates from 1 to 3 and 21 delays from 100 to 500; "late" has one rate and 21 delays.
    assert [mine.sum(), (drawn.service == 1).sum(), (drawn.service == 2).sum()] == [441, 21, 0]
    np.testing.assert_array_equal(np.unique(drawn.rate[mine]), [0, *(round(1 + k / 10, 1) for k in range(21))][1:])
    np.testing.assert_array_equal(np.unique(drawn.tolerable_delay[mine]), np.arange(100, 501, 20))
    # A takes 2 cycles/bit, B 3: at 1.7 Mbit/s 3.4 and 5.1 Mcycles/s.
    row = np.flatnonzero(mine & (drawn.rate[:, 0] == 1.7))[0]
    assert drawn.amount[row, :, 0].tolist() == pytest.approx([3.4, 5.1])
    assert drawn.rate[row].tolist() == [1.7, 1.7, 1.7]


def test_every_request_draws_its_own():
    scenario = scenario_of(horizon=4000)
    workload = scenario.workload(3)
    profiles = scenario.profiles
    mine = workload.service == 0
    rate, delay = profiles.rate[workload.profile, 0][mine], profiles.tolerable_delay[workload.profile][mine]
    # Uniform on 21 values: means 2 and 300, and all values come up; rate and delay are independent.
    assert len(np.unique(rate)) == len(np.unique(delay)) == 21
    spread = math.sqrt(mine.sum())
    assert abs(rate.mean() - 2) < 4 * rate.std() / spread
    assert abs(delay.mean() - 300) < 4 * delay.std() / spread
    assert abs(np.corrcoef(rate, delay)[0, 1]) < 4 / spread
    assert (workload.profile[workload.service == 2] == 2).all()
    # Nothing else of the workload knows of it.
    plain = scenario_of({**SERVICES, "drawn": {**SERVICES["drawn"], "rate": 2, "tolerable_delay": 300}}, horizon=4000)
    for name in ("slot", "service", "ingress", "egress", "lifetime"):
        np.testing.assert_array_equal(getattr(plain.workload(3), name), getattr(workload, name))


def test_lifetimes_of_services():
    workload = scenario_of(horizon=4000).workload(5)
    for service, mean in enumerate((4, 30, 4)):
        lived = workload.lifetime[workload.service == service]
        assert abs(lived.mean() - mean) < 4 * mean / math.sqrt(len(lived))


def test_the_offered_load_by_hand():
    # Loads at the mean rate: (2 + 3) 2 = 10, 2 * 2 = 4, 3 * 0.5 = 1.5 Mcycles/s; shares of the mix 1/4, 1/2, 1/4.
    scenario = scenario_of()
    short, long = (mean * -math.expm1(-12 / mean) for mean in (4, 30))
    expected = 3 * (10 / 4 * short + 4 / 2 * long + 1.5 / 4 * short) / scenario.substrate.total_vm_capacity
    assert scenario.offered_load() == pytest.approx(expected, rel=1e-12)


def test_paper_ranges_are_those_of_its_table():
    services = {name: {**kind, "rate": [0.064, 4], "tolerable_delay": [100, 500]} for name, kind in paper().items()}
    scenario = paper_scenario(services=services, horizon=5)
    assert [round(x, 4) for x in np.unique(scenario.catalogue.drawn.rate[:, 0])[[0, -1]]] == [0.064, 4.0]


def paper():
    return {each.name: {"chain": list(each.chain)} for each in paper_scenario(horizon=1).catalogue.types}


@settings(max_examples=12)
@given(
    st.fixed_dictionaries(
        {
            "mask": st.sampled_from(["adjacency", "feasible"]),
            "colocation": st.booleans(),
            "endpoints": st.sampled_from(["catalogue", "uniform"]),
            "step_budget": st.sampled_from(["request", "slot"]),
            "placing_after_chain": st.sampled_from(["masked", "forwards"]),
            "max_steps": st.sampled_from([6, 20]),
            "horizon": st.just(4),
        }
    ),
    st.integers(0, 1000),
)
def test_agrees_with_the_reference(changes, seed):
    scenario = scenario_of(**changes)
    run_both(Instance(scenario, scenario.workload(seed), FailureTimeline.empty()), seed)


@pytest.mark.parametrize("planner", [GreedyPlanner, MyopicPlanner, MilpPlanner])
def test_planners_audit_and_files_know_them(tmp_path: Path, planner):
    scenario = scenario_of(arrival_rate=2, horizon=8, colocation=True)
    (record,) = run_method(scenario, PlannerMethod(planner(), name="it"), [4])
    if planner is MilpPlanner:
        (exact,) = run_method(scenario, PlannerMethod(MyopicPlanner(), name="it"), [4])
        np.testing.assert_allclose(record.cost, exact.cost, rtol=1e-6)
    for bound in (hindsight_bound, blind_bound):
        assert 0 < bound(scenario, record.workload).aar <= 1
    write_run(tmp_path / "run", record, compute_metrics(record))
    assert audit_run(tmp_path / "run").problems == []
    first = int(np.flatnonzero(record.workload.service == 0)[0])
    tolerable = scenario.profiles.tolerable_delay[record.workload.profile[first]]
    assert f"drawn, request {first}, at most {tolerable:g} ms" in title_of(record, first)
    back = read_run_folder(tmp_path / "run")
    assert back.scenario.catalogue.types == scenario.catalogue.types
    np.testing.assert_array_equal(back.workload.profile, record.workload.profile)
    np.testing.assert_array_equal(back.workload.departure, record.workload.departure)


def test_the_audit_reads_what_each_request_asks_for(tmp_path: Path):
    scenario = scenario_of(horizon=8)
    (record,) = run_method(scenario, PlannerMethod(GreedyPlanner(), name="it"), [4])
    write_run(tmp_path / "run", record, compute_metrics(record))
    path = tmp_path / "run" / "workload.csv"
    lines = path.read_text().splitlines()
    place = 1 + next(r for r in range(len(record.accepted)) if record.accepted[r] and record.workload.service[r] == 0)
    before, demand = lines[place].split("{", 1)
    others = [line.split("{", 1)[1] for line in lines if ",drawn," in line and line.split("{", 1)[1] != demand]
    for text, problem in [
        (others[0], "the cost is"),  # what another one asks for: this one was charged for something else
        (
            re.sub(r'delay"": [0-9.]+', 'delay"": 999.0', demand),
            "draws what its requests ask for, and this one asks for",
        ),
        (None, "and this one says nothing"),
    ]:
        lines[place] = before[:-1] if text is None else before + "{" + text
        path.write_text("\n".join(lines) + "\n")
        assert problem in " ".join(audit_run(tmp_path / "run").problems)


def test_a_file_has_to_say_what_would_be_drawn(tmp_path: Path):
    path = tmp_path / "requests.csv"
    path.write_text("slot,service,ingress,egress,lifetime\n0,fixed,0,1,5\n1,drawn,0,1,5\n")
    with pytest.raises(ScenarioError, match="line 3: requests of 'drawn' draw what they ask for"):
        scenario_of(workload={"path": str(path)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": [3, 1]}, r"services.drawn.rate: \[3.0, 1.0\]; give \[low, high\] with 0 < low < high"),
        ({"rate": [1, 2, 3]}, "services.drawn.rate"),
        ({"tolerable_delay": [0, 5]}, r"services.drawn.tolerable_delay: \[0.0, 5.0\]; give"),
        ({"rates": [1, 1, 1]}, "services.drawn.rates: leave it out, or give rate as one number"),
        ({"mean_lifetime": 0}, "services.drawn.mean_lifetime: 0.* s; use a positive number"),
    ],
)
def test_what_is_no_interval(changes, message):
    with pytest.raises(ScenarioError, match=message):
        scenario_of({"drawn": {**SERVICES["drawn"], **changes}})
