"""A policy that is saved and loaded decides as before, whatever kind it is; files of the first format are read, too."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN, CentredDQN, Reinforce, q_network
from nfv_torchrl.methods import (
    CandidatePolicy,
    CompiledNetwork,
    Method,
    PlannerMethod,
    PolicyMethod,
    PricePolicy,
    acting_method,
    load_policy,
    policy_content,
    save_policy,
)
from nfv_torchrl.networks import CandidateNetwork, LookaheadNetwork, MLPNetwork, Sizes
from nfv_torchrl.networks.prices import PriceNetwork
from nfv_torchrl.nfvdeep import NFVdeepPlanner
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

SCENARIO = paper_scenario(nodes=5, seed=1, horizon=20, arrival_rate=20, mean_lifetime=200, mask="feasible")
SIZES = Sizes.of(Simulator(SCENARIO, 1))
CANDIDATES = {"_target_": "nfv_torchrl.networks.CandidateNetwork", "_partial_": True, "hidden": [8]}
MLP = {"_target_": "nfv_torchrl.networks.MLPNetwork", "_partial_": True, "hidden": [8]}
PRICES = {"_target_": "nfv_torchrl.networks.prices.PriceNetwork", "_partial_": True, "hidden": 2}


def dqn() -> tuple[Method, dict]:
    loss = DQN(functools.partial(CandidateNetwork, hidden=[8]), SIZES)
    config = {"network": CANDIDATES, "loss": {"_target_": "nfv_torchrl.losses.DQN"}}
    method = acting_method(loss.actor, q_network(loss), one_hot=False)
    return method, policy_content(loss, SIZES, config, SCENARIO, {"aar": 0.5})


def nfvdeep() -> tuple[Method, dict]:
    planner = NFVdeepPlanner(route="cost")
    sizes = planner.sizes(Simulator(SCENARIO, 1))
    loss = Reinforce(functools.partial(MLPNetwork, hidden=[8]), sizes)
    planned = {"_target_": "nfv_torchrl.nfvdeep.NFVdeepPlanner", "route": "cost"}
    config = {"network": MLP, "loss": {"_target_": "nfv_torchrl.losses.Reinforce"}, "env": {"planner": planned}}
    method = PlannerMethod(planner.follow(loss.actor), name="nfvdeep")
    return method, policy_content(loss, sizes, config, SCENARIO, {})


def candidates() -> tuple[Method, dict]:
    policy = CandidatePolicy(functools.partial(CandidateNetwork, hidden=[8]), SIZES)
    config = {"network": CANDIDATES, "policy": {"_target_": "nfv_torchrl.evolution.CandidatePolicy"}}
    return policy.method("evolved"), policy_content(policy, SIZES, config, policy.settings(SCENARIO), {})


def prices() -> tuple[Method, dict]:
    policy = PricePolicy(functools.partial(PriceNetwork, hidden=2))
    policy.set_vector(np.random.default_rng(0).normal(0, 0.5, policy.vector().size))
    config = {"network": PRICES, "policy": {"_target_": "nfv_torchrl.evolution.PricePolicy"}}
    return policy.method("evolved"), policy_content(policy, SIZES, config, policy.settings(SCENARIO), {})


KINDS = [(dqn, "actor"), (nfvdeep, "planner"), (candidates, "evolved"), (prices, "evolved")]


@pytest.mark.parametrize(("make", "kind"), KINDS)
def test_it_decides_as_before_it_was_saved(make, kind, tmp_path):
    torch.manual_seed(0)
    method, content = make()
    assert content["kind"] == kind
    save_policy(tmp_path / "best.pt", content)
    assert_same_decisions(method, load_policy(tmp_path / "best.pt", SCENARIO))


def test_compiled_it_decides_the_same_under_the_name_and_mask_of_its_file(tmp_path):
    torch.manual_seed(0)
    loss = DQN(functools.partial(MLPNetwork, hidden=[8]), SIZES)
    config = {"network": MLP, "loss": {"_target_": "nfv_torchrl.losses.DQN"}}
    save_policy(tmp_path / "best.pt", policy_content(loss, SIZES, config, SCENARIO, {}))
    slow, fast = (load_policy(tmp_path / "best.pt", SCENARIO, name="dqn", compiled=how) for how in (False, True))
    assert isinstance(slow, PolicyMethod) and isinstance(fast, CompiledNetwork)
    assert (fast.name, fast.mask, fast.one_hot) == ("dqn", "feasible", False)
    assert_same_decisions(slow, fast)


def test_settings_of_the_planner_can_be_replaced_and_nothing_else(tmp_path):
    _, content = nfvdeep()
    save_policy(tmp_path / "policy.pt", content)
    other, own = (
        load_policy(tmp_path / "policy.pt", SCENARIO, planner=change) for change in ({"route": "delay"}, None)
    )
    assert own.planner.options.by_cost and not other.planner.options.by_cost
    with pytest.raises(CheckpointError, match="only the settings"):
        load_policy(tmp_path / "policy.pt", SCENARIO, planner={"_target_": "nfv_torchrl.nfvdeep.NFVdeepPlanner"})
    save_policy(tmp_path / "actor.pt", dqn()[1])
    with pytest.raises(CheckpointError, match="only the settings"):
        load_policy(tmp_path / "actor.pt", SCENARIO, planner={"route": "delay"})


@pytest.mark.parametrize(("make", "kind"), KINDS)
def test_the_first_format_is_read(make, kind, tmp_path):
    """It kept an evolved policy under ``loss`` and did not say what a policy is."""
    torch.manual_seed(0)
    method, content = make()
    former = {**content, "format": 1, "loss": content["loss"] or content["policy"]}
    del former["kind"], former["policy"]
    save_policy(tmp_path / "best.pt", former)
    assert_same_decisions(method, load_policy(tmp_path / "best.pt", SCENARIO))


@pytest.mark.parametrize(
    ("network", "target", "fits"),
    [(LookaheadNetwork, "LookaheadNetwork", True), (CandidateNetwork, "CandidateNetwork", False)],
)
def test_what_knows_no_service_types_serves_other_services(network, target, fits, tmp_path):
    other = paper_scenario(nodes=5, horizon=5, services={"only": {"chain": ["NAT"], "rate": 2, "tolerable_delay": 500}})
    torch.manual_seed(0)
    loss = CentredDQN(functools.partial(network, hidden=[8]), SIZES, by_service=True, environments=2)
    part = {"_target_": f"nfv_torchrl.networks.{target}", "_partial_": True, "hidden": [8]}
    of_loss = {"_target_": "nfv_torchrl.losses.CentredDQN", "by_service": True, "environments": 2}
    config = {"network": part, "loss": of_loss}
    save_policy(tmp_path / "best.pt", policy_content(loss, SIZES, config, SCENARIO, {}))
    if fits:
        (record,) = run_method(other, load_policy(tmp_path / "best.pt", other), [0])
        assert record.accepted.any()
        return
    with pytest.raises(CheckpointError, match=r"3 services; .* 1\. Evaluate it on"):
        load_policy(tmp_path / "best.pt", other)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("seen", [False, True])
def test_rows_of_candidates_are_those_of_training(seen, compiled, tmp_path):
    """What was trained with lifetimes hidden decides the same where they are shown; the other way round it may not."""
    torch.manual_seed(0)
    trained, other = (SCENARIO.replace(observe_lifetime=shown) for shown in (seen, not seen))
    sizes = Sizes.of(Simulator(trained, 1))
    loss = DQN(functools.partial(CandidateNetwork, hidden=[8]), sizes)
    config = {"network": CANDIDATES, "loss": {"_target_": "nfv_torchrl.losses.DQN"}}
    save_policy(tmp_path / "best.pt", policy_content(loss, sizes, config, trained, {}))
    there, here = (
        run_method(scenario, load_policy(tmp_path / "best.pt", scenario, compiled=compiled), [0])[0]
        for scenario in (trained, other)
    )
    assert there.accepted.any()
    assert seen or here.step_node.tolist() == there.step_node.tolist()


def assert_same_decisions(method: Method, other: Method) -> None:
    (one,), (two,) = run_method(SCENARIO, method, [0]), run_method(SCENARIO, other, [0])
    assert len(set(one.step_node.tolist())) > 1
    for name in ("reason", "cost", "step_offsets", "step_node", "step_vm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
