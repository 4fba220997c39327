"""Workers: the environments that one process has, their policy, their states, and what happens when one is lost."""

import os
import signal
from functools import partial

import pytest
import torch
from forked import forked_workers
from tensordict.nn import TensorDictSequential
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError, ScenarioError, TrainingError
from nfv_torchrl.losses import DQN
from nfv_torchrl.networks import Sizes
from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.collecting import MultiAsync, MultiSync, Single, World

SCENARIOS = [paper_scenario(seed=seed, horizon=30, arrival_rate=4.0) for seed in range(3)]
WORLD = World(partial(NFVEnv, seed=4, stagger=True, segment=10), SCENARIOS, 4)
CPU = torch.device("cpu")


def greedy():
    torch.manual_seed(0)
    return DQN(MLPNetwork, Sizes.of(Simulator(SCENARIOS, 3, one_hot=True))).actor


def exploring(actor):
    explore = EGreedyModule(Categorical(actor.spec["action"].n), action_mask_key="action_mask", eps_init=0.5)
    return TensorDictSequential(actor, explore), explore


def same(one, other):
    return all(
        torch.equal(one[key], other[key]) for key in ("observation", "action", ("next", "reward"), ("next", "done"))
    )


def test_two_workers_see_what_one_process_sees_and_go_on_to_the_bit():
    actor = greedy()
    policy, explore = exploring(actor)
    explore.eps.fill_(0.0)
    alone, two = Single(4, 12, 1), MultiSync(4, 12, 1, workers=2)
    for collector in (alone, two):
        collector.prepare(WORLD)
    batches, shared = alone.start(policy, CPU), two.start(policy, CPU)
    try:
        two.send_policy()
        assert same(next(batches), next(shared))
        with torch.no_grad():  # other weights, and exploration, reach the workers
            for weights in actor.parameters():
                weights.mul_(-1)
        two.send_policy()
        assert same(next(batches), next(shared))
        explore.eps.fill_(1.0)
        two.send_policy()
        assert not same(next(batches), next(shared))

        state = two.state_dict()
        expected = next(shared).clone()
    finally:
        two.shutdown()
        alone.shutdown()
    again = MultiSync(4, 12, 1, workers=2)
    again.prepare(WORLD)
    state["parts"][0]["random"] = state["parts"][0]["random"][:-1]
    with pytest.raises(CheckpointError, match=r"env\.parts\.0\.random has shape"):
        again.load_state_dict(state)
    state["parts"][0]["random"] = state["parts"][1]["random"]
    del state["parts"][0]["env"]["seed"]
    with pytest.raises(CheckpointError, match=r"env\.seed is missing"):
        again.load_state_dict(state)
    assert expected["action"].shape == (4, 12)


@forked_workers()
def test_a_worker_that_is_lost_ends_the_batches_with_one_error():
    policy, _ = exploring(greedy())
    lost = MultiAsync(4, 12, 1, workers=2)
    lost.prepare(WORLD)
    batches = lost.start(policy, CPU)
    assert next(batches).shape == (4, 12)
    os.kill(lost.collector.procs[1].pid, signal.SIGKILL)
    lost.collector.procs[1].join()
    lost.send_policy()  # waits for nobody
    assert all(batch.shape == (4, 12) for batch in batches)  # it ends
    state = lost.state_dict()
    assert state == {"starts": 0, "parts": []}
    with pytest.raises(
        TrainingError, match=r"^collector: a worker failed .*\(worker 1 ended with exit code -9\).* resume=true"
    ):
        lost.shutdown()


def test_environments_that_begin_anew_do_not_repeat_their_requests(capsys):
    resumed = MultiAsync(4, 12, 1, workers=2)
    resumed.prepare(WORLD)
    resumed.load_state_dict({"starts": 0, "parts": []})
    assert "The environments begin anew" in capsys.readouterr().out
    firsts = [part.first for part in resumed._parts()]
    assert firsts == [4, 6]
    worlds = [part.scenarios[0] for part in resumed._parts()]
    assert worlds == [SCENARIOS[4 % 3], SCENARIOS[6 % 3]]


def test_environments_are_shared_out_equally():
    with pytest.raises(ScenarioError, match=r"^collector\.workers: 3 cannot share 4"):
        MultiSync(4, 12, 1, workers=3)
