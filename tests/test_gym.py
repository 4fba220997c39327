"""The Gymnasium environment: the interface, and the same world as ``NFVEnv``."""

import importlib
import re
import sys
import warnings
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
import toy
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from torchrl.envs import ActionMask, TransformedEnv
from torchrl.envs.utils import check_env_specs

from nfv_torchrl import rewards
from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.experiments.gym_speed import run_gym
from nfv_torchrl.gym import ENV_ID, NFVGymEnv, NFVVectorEnv, wrap_for_torchrl
from nfv_torchrl.gym.sb3 import SB3VecEnv
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Reason

SHORT = paper_scenario(horizon=3, arrival_rate=2.0)


@pytest.mark.parametrize("one_hot", [False, True])
@pytest.mark.parametrize("scenario", [SHORT, toy.toy_scenario(admission_control=True, mask="feasible")])
def test_gymnasium_accepts_it(scenario, one_hot):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ENV_ID, scenario=scenario, one_hot=one_hot, render_mode="rgb_array")
        check_env(env)


def test_make():
    env = gymnasium.make(ENV_ID, scenario={"horizon": 3, "substrate": {"nodes": 8}}, one_hot=False, seed=4)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    observation, info = env.reset()
    assert env.scenario.horizon == 3
    actions = 2 * 8 * 6 + 1
    assert env.action_space.n == actions
    assert observation.shape == (8 * 6 + 16 + 5,)
    assert info["action_mask"].shape == (actions,)
    assert gymnasium.make(ENV_ID).scenario.horizon == 1000
    with pytest.raises(ScenarioError, match="horizn"):
        gymnasium.make(ENV_ID, scenario={"horizn": 3})


def test_masked_random_agent_sees_no_invalid_action():
    env = gymnasium.make(ENV_ID, scenario=SHORT)
    env.action_space.seed(0)
    reasons, terminated = set(), False
    _, info = env.reset(seed=1)
    while not terminated:
        masks = env.action_masks()
        np.testing.assert_array_equal(masks, env.get_wrapper_attr("action_masks")())  # as sb3-contrib asks
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


# --------------------------------------------------------------------------------------------- many environments


def masked(masks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A valid action of each row, each as likely."""
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])


def assert_same(one, other) -> None:
    """Equal in all of it: dicts, arrays of arrays and numbers."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, np.ndarray) and one.dtype == object:
        for left, right in zip(one, other, strict=True):
            assert_same(left, right)
    else:
        np.testing.assert_array_equal(one, other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)


@pytest.mark.parametrize("threads", [1, 2])
def test_many_are_what_gymnasium_makes_of_single_ones(threads):
    ours = gymnasium.make_vec(ENV_ID, num_envs=5, scenario=SHORT, threads=threads)
    theirs = gymnasium.make_vec(
        ENV_ID, num_envs=5, scenario=SHORT, vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )  # fmt: skip
    assert isinstance(ours.unwrapped, NFVVectorEnv)
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    rng, ends = np.random.default_rng(0), 0
    for seed in (3, None, [5, None, 1, 8, 8]):
        (observation, info), expected = ours.reset(seed=seed), theirs.reset(seed=seed)
        assert_same(observation, expected[0])
        assert_same(info, expected[1])
        for _ in range(120):
            masks = ours.action_masks()
            np.testing.assert_array_equal(masks, info["action_mask"].astype(bool))
            actions = masked(masks, rng)
            *step, info = ours.step(actions)
            *expected, expected_info = theirs.step(actions)
            for value, other in zip(step, expected, strict=True):
                assert_same(value, other)
            assert_same(info, expected_info)
            ends += step[2].sum()
        chosen = {"reset_mask": np.array([True, False, False, True, False])}
        for value, other in zip(ours.reset(options=dict(chosen)), theirs.reset(options=dict(chosen)), strict=True):
            assert_same(value, other)
    assert ends > 10


def test_what_many_refuse():
    with pytest.raises(ScenarioError, match="num_envs is 0"):
        NFVVectorEnv(0)
    envs = NFVVectorEnv(2, SHORT)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(2, np.int64))
    for seed, message in (([1], "1 seeds for 2"), ([0, -1], "seed: -1"), ([0, 2**80], "seed")):
        with pytest.raises(ScenarioError, match=message):
            envs.reset(seed=seed)
    with pytest.raises(ScenarioError, match=r"reset_mask: bool \[2\] is needed, not int64 \[3\]"):
        envs.reset(options={"reset_mask": [1, 0, 1]})
    with pytest.raises(ScenarioError, match="'human' is none of"):
        NFVVectorEnv(2, SHORT, render_mode="human")


def test_a_picture_shows_what_is_used_and_where_the_walk_is():
    scenario = toy.toy_scenario(endpoint_pairs=np.array([[[0, 3]], [[0, 3]]]), horizon=50)
    envs = NFVVectorEnv(2, scenario, render_mode="rgb_array")
    envs.reset(seed=0)
    while envs.simulator.world.env["service"][0] != toy.DUO:
        envs.step(np.full(2, toy.REJECT))
    empty = envs.render()
    assert all(picture.dtype == np.uint8 and picture.shape == (440, 540, 3) for picture in empty)
    np.testing.assert_array_equal(envs.render()[0], empty[0])
    envs.step(np.array([toy.DUO_0_TO_3[2][0], toy.REJECT]))
    walking = envs.render()[0]
    assert (walking != empty[0]).any()
    picture = envs._picture
    node_use, link_use = picture._use(0)
    world = envs.simulator.world
    capacity = world.tables.vm_capacity[0, :, :, 0]
    np.testing.assert_allclose(node_use, 1 - world.ledger.vm_offered[0, :, :, 0].sum(1) / capacity.sum(1), atol=1e-3)
    np.testing.assert_allclose(link_use, 1 - world.ledger.link_offered[0] / world.tables.link_capacity[0], atol=1e-3)
    assert node_use.sum() > 0 and link_use.sum() > 0
    single = NFVGymEnv(scenario)
    single.reset()
    assert single.render() is None and NFVVectorEnv(1, scenario).render() is None


# --------------------------------------------------------------------------------------------- other libraries


@pytest.mark.parametrize("wrapped", [False, True])
def test_gym_wrapper_keeps_the_mask(wrapped):
    inner = gymnasium.make(ENV_ID, scenario=SHORT)
    env = wrap_for_torchrl(gymnasium.wrappers.TimeLimit(inner, 50) if wrapped else inner)
    check_env_specs(env)
    env.set_seed(0)
    torch.manual_seed(0)
    data = TransformedEnv(env, ActionMask()).rollout(300, break_when_any_done=False)
    assert data["action_mask"].dtype == torch.bool
    assert data["action_mask"].gather(-1, data["action"].unsqueeze(-1)).all()
    assert data["next", "done"].sum() >= 2
    reasons = data["next", "rejection_reason"]
    assert (reasons >= 0).any() and not (reasons == Reason.INVALID_ACTION).any()
    ended = data["next", "request_done"]
    assert torch.equal(reasons >= 0, ended & ~data["next", "accepted"])


def test_stable_baselines_sees_what_it_makes_of_single_ones():
    ours = SB3VecEnv(gymnasium.make_vec(ENV_ID, num_envs=4, scenario=SHORT))
    theirs = DummyVecEnv([partial(NFVGymEnv, SHORT, seed=b) for b in range(4)])
    assert is_masking_supported(ours)
    rng, ends = np.random.default_rng(1), 0
    for envs in (ours, theirs):
        envs.seed(7)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for _ in range(150):
        masks = get_action_masks(ours)
        np.testing.assert_array_equal(masks, get_action_masks(theirs))
        np.testing.assert_array_equal(masks, [mask() for mask in ours.get_attr("action_masks")])
        actions = masked(masks, rng)
        *step, infos = ours.step(actions)
        *expected, expected_infos = theirs.step(actions)
        for value, other in zip(step, expected, strict=True):
            assert_same(value, other)
        for info, other in zip(infos, expected_infos, strict=True):
            assert ("accepted" in info) == other["request_done"]
            for key in info:
                assert_same(info[key], other[key])
            assert ("terminal_observation" in info) == ("terminal_observation" in other)
        ends += step[2].sum()
    assert ends >= 8
    np.testing.assert_array_equal(ours.env_method("action_masks", indices=[2])[0], get_action_masks(ours)[2])
    assert ours.env_is_wrapped(VecMonitor, indices=1) == [False]
    assert not ours.has_attr("no_such_thing")
    with pytest.raises(AttributeError, match="have action_masks and render only"):
        ours.env_method("step")
    with pytest.raises(ScenarioError, match="name it in make_vec"):
        ours.set_attr("reward", None)
    with pytest.raises(ScenarioError, match="not a SyncVectorEnv"):
        SB3VecEnv(gymnasium.make_vec(ENV_ID, scenario=SHORT, vectorization_mode="sync"))


def test_maskable_ppo_learns():
    envs = VecMonitor(SB3VecEnv(gymnasium.make_vec(ENV_ID, num_envs=8, scenario=SHORT, render_mode="rgb_array")))
    model = MaskablePPO("MlpPolicy", envs, n_steps=32, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = [weight.clone() for weight in model.policy.parameters()]
    model.learn(512)
    assert model.num_timesteps == 512
    assert all(torch.isfinite(weight).all() for weight in model.policy.parameters())
    assert any(not torch.equal(*pair) for pair in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer) >= 4  # horizons that ended
    taken = model.rollout_buffer.actions.astype(int)
    masks = model.rollout_buffer.action_masks.reshape(*taken.shape[:-1], -1)
    assert np.take_along_axis(masks, taken, -1).all()
    assert envs.render().shape == (3 * 440, 3 * 540, 3)
    # One environment of Gymnasium does as well, and masks are asked of it without `unwrapped`.
    assert MaskablePPO("MlpPolicy", gymnasium.make(ENV_ID, scenario=SHORT), n_steps=64).learn(64).num_timesteps == 64


def test_the_benchmark_has_a_row_for_each_way():
    config = {"nodes": [5], "batch_sizes": [1, 4], "frames": 64, "repeats": 1, "loaded_slot": 0}
    config |= {"arrivals_per_node": None, "scenario": {"arrival_rate": 2.0, "substrate": {}}}
    rows = list(run_gym(config))
    ways = [("gymnasium.make", 1), ("DummyVecEnv", 4), ("SB3VecEnv", 4)]
    assert [(row["environments"], row["B"]) for row in rows] == ways
    assert all(value > 0 for row in rows for name, value in row.items() if "," in name)


def test_the_page_prints_what_works():
    page = (Path(__file__).parents[1] / "docs" / "gymnasium.md").read_text()
    examples = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    here: dict = {}
    for example in examples:
        exec(example, here)
    assert len(examples) == 5
    assert here["model"].num_timesteps == 4096
    assert here["picture"].shape == (440, 540, 3)
    assert here["data"]["action_mask"].any(-1).all()


def test_without_stable_baselines_there_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "nfv_torchrl.gym.sb3")
    with pytest.raises(ScenarioError, match=r"needs Stable-Baselines3: pip install .*\[sb3\]"):
        importlib.import_module("nfv_torchrl.gym.sb3")
