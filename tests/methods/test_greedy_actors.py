"""Policies act by the highest score at once where they can, and then as their actor would."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN, IQN, DiscreteSAC, QuantileDQN, q_network, scorer
from nfv_torchrl.losses.ppo import PPO
from nfv_torchrl.losses.recurrent_dqn import RecurrentDQN
from nfv_torchrl.methods import PolicyMethod
from nfv_torchrl.networks import CandidateNetwork, DuelingNetwork, ImplicitQuantileNetwork, MLPNetwork, Sizes
from nfv_torchrl.networks.gru import GRUNetwork
from nfv_torchrl.observations import read_observation
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

SCENARIO = paper_scenario(nodes=6, seed=0, horizon=30, mean_lifetime=100.0, arrival_rate=12.0)


def made(loss, network):
    torch.manual_seed(0)
    loss = loss(network, Sizes.of(Simulator(SCENARIO, 1, one_hot=True)))
    loss.actor.eval()
    return loss.actor, q_network(loss).observations()


KINDS = [
    (DQN, functools.partial(MLPNetwork, noisy=True)),
    (DQN, CandidateNetwork),
    (DQN, DuelingNetwork),
    (QuantileDQN, CandidateNetwork),
    (DiscreteSAC, MLPNetwork),
    (PPO, CandidateNetwork),
    (functools.partial(IQN, quantiles=4), functools.partial(ImplicitQuantileNetwork, hidden=(16, 16))),
]


@pytest.mark.parametrize(("loss", "network"), KINDS)
def test_it_decides_as_the_actor(loss, network):
    """Step by step; where two scores are equal but for rounding, a softmax may choose the other."""
    actor, parts = made(loss, network)
    quick, slow = PolicyMethod(actor, parts), PolicyMethod(actor, parts)
    assert quick._scorer is not None
    slow._scorer = None
    simulator = Simulator(SCENARIO, 3, one_hot=True)
    for b in range(3):
        simulator.start(b, SCENARIO.workload(b), SCENARIO.failure_timeline(b))
    different, taken = 0, set()
    for _ in range(300):
        mine, theirs = quick.act(simulator), slow.act(simulator)
        assert simulator.world.seen.mask[np.arange(3), mine].all()
        for b in np.flatnonzero(mine != theirs):
            seen = read_observation(simulator, parts)
            with torch.no_grad():
                scores = quick._scorer(seen).get(quick._scorer.out_keys[0])[b]
            assert abs(scores[mine[b]] - scores[theirs[b]]) < 1e-5
            different += 1
        taken |= set(mine.tolist())
        simulator.step(mine)
    assert different <= 9 and len(taken) > 5


@pytest.mark.parametrize(("loss", "network"), KINDS[:4])
def test_whole_runs_are_the_same(loss, network):
    actor, parts = made(loss, network)
    quick, slow = PolicyMethod(actor, parts, mask="feasible"), PolicyMethod(actor, parts, mask="feasible")
    slow._scorer = None
    for one, other in zip(*(run_method(SCENARIO, method, [0, 1]) for method in (quick, slow)), strict=True):
        assert one.accepted.any()
        for name in ("reason", "cost", "step_offsets", "step_node", "step_vm"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_memory_needs_the_whole_actor():
    actor, _ = made(RecurrentDQN, GRUNetwork)
    assert scorer(actor) is None
