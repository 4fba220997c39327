"""The Gymnasium environment: the interface, and the same world as ``NFVEnv``."""

import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
import toy
from gymnasium.utils.env_checker import check_env

from nfv_torchrl import rewards
from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.gym import ENV_ID, NFVGymEnv
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Reason

SHORT = paper_scenario(horizon=3, arrival_rate=2.0)


@pytest.mark.parametrize("one_hot", [False, True])
@pytest.mark.parametrize("scenario", [SHORT, toy.toy_scenario(admission_control=True, mask="feasible")])
def test_gymnasium_accepts_it(scenario, one_hot):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(NFVGymEnv(scenario, one_hot=one_hot), skip_render_check=True)


def test_make():
    env = gymnasium.make(ENV_ID, scenario={"horizon": 3, "substrate": {"nodes": 8}}, one_hot=False, seed=4)
    observation, info = env.reset()
    assert env.unwrapped.scenario.horizon == 3
    actions = 2 * 8 * 6 + 1
    assert env.action_space.n == actions
    assert observation.shape == (8 * 6 + 16 + 5,)
    assert info["action_mask"].shape == (actions,)
    assert gymnasium.make(ENV_ID).unwrapped.scenario.horizon == 1000
    with pytest.raises(ScenarioError, match="horizn"):
        gymnasium.make(ENV_ID, scenario={"horizn": 3})


def test_masked_random_agent_sees_no_invalid_action():
    env = gymnasium.make(ENV_ID, scenario=SHORT)
    env.action_space.seed(0)
    reasons, terminated = set(), False
    _, info = env.reset(seed=1)
    while not terminated:
        # Found from outside the wrappers, as sb3-contrib does.
        masks = env.get_wrapper_attr("action_masks")()
        assert masks.dtype == bool
        np.testing.assert_array_equal(masks, info["action_mask"])
        observation, _, terminated, truncated, info = env.step(env.action_space.sample(info["action_mask"]))
        assert env.observation_space.contains(observation)
        assert not truncated
        reasons.add(info["rejection_reason"])
    assert reasons - {-1}
    assert Reason.INVALID_ACTION not in reasons


def test_what_a_step_tells():
    scenario = toy.toy_scenario(endpoint_pairs=np.array([[[0, 3]], [[3, 0]]]), horizon=50, mean_lifetime=0.1)
    env = NFVGymEnv(scenario, reward=partial(rewards.admission_step_cost, w_cost=1.0))
    env.reset(seed=0)
    while env.simulator.world.env["service"][0] != toy.DUO:
        env.step(toy.REJECT)
    walk = toy.DUO_0_TO_3[2]
    # $12, $41 and $2 of at most $108.
    for action, cost in zip(walk[:2], (12, 41), strict=True):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(-cost / 108)
        assert (info["request_done"], info["rejection_reason"], info["request_cost"]) == (False, -1, 0)
    _, reward, _, _, info = env.step(walk[2])
    assert reward == pytest.approx(1 - 2 / 108)
    assert (info["request_done"], info["accepted"], info["rejection_reason"]) == (True, True, -1)
    assert info["request_cost"] == pytest.approx(55)
    _, reward, _, _, info = env.step(10**6)
    assert (reward, info["accepted"], info["rejection_reason"]) == (0, False, Reason.INVALID_ACTION)


def test_it_is_environment_0_of_an_nfv_env():
    ours, theirs = NFVGymEnv(SHORT), NFVEnv(SHORT, 2)
    theirs.set_seed(7)
    rng = np.random.default_rng(0)
    td = theirs.reset()
    observation, info = ours.reset(seed=7)
    for _episode in range(3):
        terminated = False
        while not terminated:
            np.testing.assert_array_equal(td["observation"][0].numpy(), observation)
            np.testing.assert_array_equal(td["action_mask"][0].numpy(), info["action_mask"])
            actions = [int(rng.choice(np.flatnonzero(mask))) for mask in td["action_mask"].numpy()]
            step = theirs.step(td.clone().set("action", torch.tensor(actions)))["next"]
            observation, reward, terminated, _, info = ours.step(actions[0])
            assert reward == pytest.approx(step["reward"][0].item())
            assert step["request_done"][0].item() == info["request_done"]
            for name, key in (("accepted", "accepted"), ("reason", "rejection_reason")):
                assert step["outcome", name][0].item() == info[key]
            assert terminated == step["terminated"][0].item()
            td = step.exclude("reward")
        # Each reset is the next horizon.
        observation, info = ours.reset()
        td = theirs.reset(td.set("_reset", torch.tensor([[True], [False]])))


def test_seeds():
    env, same = NFVGymEnv(SHORT, seed=3), NFVGymEnv(SHORT)

    def arrivals(environment: NFVGymEnv) -> list:
        requests = environment.simulator.world.env["num_requests"][0]
        return environment.simulator.world.arrivals.lifetime[0, :requests].tolist()

    env.reset()
    same.reset(seed=3)
    first = arrivals(env)
    assert first == arrivals(same)
    env.reset()
    assert arrivals(env) != first
    env.reset(seed=3)
    assert arrivals(env) == first


def test_a_horizon_without_requests_ends_with_the_first_step():
    scenario = toy.toy_scenario(horizon=1, arrival_rate=0.5)
    env = NFVGymEnv(scenario)
    seed = next(seed for seed in range(100) if not len(scenario.workload(seed, 0, 0)))
    _, info = env.reset(seed=seed)
    assert np.flatnonzero(info["action_mask"]).tolist() == [toy.REJECT]
    _, reward, terminated, _, info = env.step(toy.REJECT)
    assert (reward, terminated, info["request_done"]) == (0, True, False)
