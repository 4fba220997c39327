"""NFVdeep's environment: one ledger with all other methods, exact books, the reward and the observation by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from choosing import HASHED
from torchrl.envs.utils import check_env_specs
from toy import DUO, toy_scenario

from nfv_torchrl.evaluation.audit import audit_folders
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses.policy_gradient import masked_actor
from nfv_torchrl.methods import PlannerMethod
from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.nfvdeep import NFVdeepEnv, NFVdeepPlanner
from nfv_torchrl.nfvdeep.reward import Profit
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator


def busy(**changes):
    """Overload on eight nodes."""
    return paper_scenario(nodes=8, seed=2, horizon=30, arrival_rate=25, mean_lifetime=1200).replace(**changes)


def test_specs():
    check_env_specs(NFVdeepEnv([busy(), paper_scenario(nodes=6, seed=1, horizon=30)], 3))


@pytest.mark.parametrize("colocation", [False, True])
def test_training_and_evaluation_are_the_same_decisions(colocation, tmp_path):
    scenario = busy(colocation=colocation)
    planner = NFVdeepPlanner(HASHED, backtracks=3)
    env = NFVdeepEnv(scenario, 1, planner=planner, seed=5)
    data = env.rollout(10_000, HASHED)
    ended = data["next", "request_done"]
    record = run_method(scenario, PlannerMethod(planner, name="nfvdeep"), [5], workloads=[scenario.workload(5, 0, 0)])[
        0
    ]
    assert data["next", "outcome", "accepted"][ended].tolist() == record.accepted.tolist()
    assert not record.accepted.all()
    costs = data["next", "outcome", "request_cost"][ended & data["next", "outcome", "accepted"]].numpy()
    np.testing.assert_allclose(costs, record.cost[record.accepted], rtol=1e-6)
    # What a complete plan promises, the step checks of the simulator keep: the only refusals are the planner's.
    assert set(record.reason[~record.accepted].tolist()) <= {4, 5}
    write_run(tmp_path / "nfvdeep" / "seed_5", record, compute_metrics(record))
    assert not audit_folders([tmp_path])[0].problems


def test_books_are_exact():
    scenario = busy(mean_lifetime=3.0)
    env = NFVdeepEnv(scenario, 4, planner=NFVdeepPlanner(HASHED), seed=1)
    env.rollout(400, HASHED, break_when_any_done=False)
    ledger, tables, net = env.simulator.world.ledger, env.simulator.tables, env.simulator.world.env["net"]
    assert (ledger.vm_reserved + ledger.vm_offered == tables.vm_capacity[net]).all()
    assert (ledger.link_reserved + ledger.link_offered == tables.link_capacity[net]).all()


def test_a_saved_state_goes_on_to_the_bit():
    whole, stopped, resumed = (NFVdeepEnv(busy(), 3, seed=4, stagger=True) for _ in range(3))
    expected = whole.rollout(90, HASHED, break_when_any_done=False)
    stopped.rollout(41, HASHED, break_when_any_done=False)
    resumed.load_state_dict(stopped.state_dict())
    rest = resumed.rollout(49, HASHED, break_when_any_done=False)
    for key in ("observation", "action_mask", "action", ("next", "reward"), ("next", "outcome", "slot_cost")):
        assert torch.equal(rest[key], expected[:, 41:][key]), key


def test_reward_is_income_less_cost():
    simulator = Simulator(toy_scenario(), 1)
    # Mean prices: VMs (3 + 1 + 5 + 2 + 1 + 4) / 6, links (2 + 1 + 1 + 4 + 2) / 5; duo loads 30 at rate 1.
    income = 4 * (16 / 6 * 30 + 2 * 1)
    solo = 4 * (16 / 6 * 20 + 2 * 2)
    outcome = {"service": np.array([DUO]), "request_cost": np.array([55.0]), "accepted": np.array([1.0])}
    profit, relative = Profit(), Profit(relative=True)
    for reward in (profit, relative):
        reward.prepare(simulator)
    assert relative(outcome, None).item() == pytest.approx(1 - 55 / income)
    expected = (income - 55) / ((income + solo) / 2)
    assert profit(outcome, None).item() == pytest.approx(expected)
    assert profit(outcome | {"accepted": np.zeros(1)}, None).item() == 0


def test_observation_by_hand():
    env = NFVdeepEnv(toy_scenario(), 1, seed=0)
    seen = env.reset()["observation"][0]
    request = env.simulator.world.env[0]
    # Node capacities 40, 140, 50, 100 of at most 140; links of a node 15, 34, 35, 14 of at most 35.
    np.testing.assert_allclose(seen[:4], np.array([40, 140, 50, 100]) / 140, rtol=1e-6)
    np.testing.assert_allclose(seen[4:8], np.array([15, 34, 35, 14]) / 35, rtol=1e-6)
    # A takes 10 of 20 Mcycles/s for a duo, 20 for a solo; a solo has twice the rate and half the chain.
    numbers = [0.5, 0.5, 1, 1] if request["service"] == DUO else [1, 1, 1, 0.5]
    np.testing.assert_allclose(seen[8:12], numbers, rtol=1e-6)
    assert seen[12:16].argmax() == request["ingress"] and seen[16:].argmax() == request["egress"]


def test_the_highest_score_is_what_the_actor_takes(monkeypatch):
    """Asking the network at once, or the actor with its distribution: the same plans."""
    scenario, planner = busy(), NFVdeepPlanner(backtracks=3)
    sizes = planner.sizes(Simulator(scenario, 1))
    torch.manual_seed(0)
    actor = masked_actor(MLPNetwork(sizes, hidden=[16]), sizes.actions)
    fast = run_method(scenario, PlannerMethod(planner.follow(actor), name="nfvdeep"), [0, 1])
    monkeypatch.setattr("nfv_torchrl.nfvdeep.planner.scorer", lambda actor: None)
    slow = run_method(scenario, PlannerMethod(planner, name="nfvdeep"), [0, 1])
    for one, other in zip(fast, slow, strict=True):
        assert one.accepted.any()
        np.testing.assert_array_equal(one.step_node, other.step_node)
        np.testing.assert_array_equal(one.step_vm, other.step_vm)
