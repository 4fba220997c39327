"""``NFVEnv``: TorchRL's contract, seeds, resets, and going on from a saved state."""

import copy
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
import toy
from hydra.utils import instantiate
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv
from torchrl.envs.utils import check_env_specs

from nfv_torchrl import rewards
from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.observations import CandidateObservation, GraphObservation, MemoryObservation, RequestObservation
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.simulator import Reason
from nfv_torchrl.training.random_policy import RandomPolicy

# These policies need no InitTracker, which a collector of a later TorchRL would add.
pytestmark = pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")

FAILING = {"p_fail_vm": 0.02, "p_fail_link": 0.02, "p_repair": 0.2}


def tiny(**changes) -> Scenario:
    """The paper's kind of network at five nodes, a few slots long."""
    settings = {"horizon": 8, "arrival_rate": 2.0, "mean_lifetime": 4.0, **changes}
    return paper_scenario(5, **settings, substrate={"vms_max": 2}, pairs_per_service=3)


def masked_random(generator: torch.Generator | None = None):
    """A policy: any valid action, each as likely."""

    def act(mask: torch.Tensor) -> torch.Tensor:
        rows = torch.multinomial(mask.reshape(-1, mask.shape[-1]).float(), 1, generator=generator)
        return rows.view(mask.shape[:-1])

    return TensorDictModule(act, in_keys=["action_mask"], out_keys=["action"])


def rollout(env: NFVEnv, steps: int, seed: int = 0) -> TensorDict:
    """Steps under a random policy of its own randomness, through the ends of horizons."""
    policy = masked_random(torch.Generator().manual_seed(seed))
    return env.rollout(steps, policy, break_when_any_done=False)


def assert_same(one: TensorDict, other: TensorDict) -> None:
    """Equal to the bit, key by key."""
    keys = sorted(map(str, one.keys(True, True)))
    assert keys == sorted(map(str, other.keys(True, True)))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


EVERY_PART = [RequestObservation(), CandidateObservation(), GraphObservation()]
OPTIONS = {
    "default": ({}, {}),
    "feasible": ({"mask": "feasible"}, {}),
    "colocation": ({"colocation": True}, {}),
    "admission control": ({"admission_control": True}, {}),
    "lifetimes": ({"observe_lifetime": True}, {}),
    "failures": ({"failures": FAILING}, {}),
    "uniform": ({"endpoints": "uniform"}, {}),
    "all rules": (
        {"mask": "feasible", "colocation": True, "admission_control": True, "observe_lifetime": True}
        | {"failures": FAILING, "warmup": 2},
        {"observations": EVERY_PART, "stagger": True},
    ),
    "paper's observation": ({}, {"one_hot": False, "observations": []}),
    "candidates": ({}, {"observations": [CandidateObservation()]}),
    "graph": ({}, {"observations": [GraphObservation()]}),
    "paper's reward": ({}, {"reward": rewards.paper}),
    "admission reward": ({}, {"reward": rewards.admission}),
    "stagger": ({}, {"stagger": True}),
    "one slot": ({"horizon": 1}, {}),
}


@pytest.mark.parametrize("batch_size", [1, 64])
@pytest.mark.parametrize("option", OPTIONS)
def test_specs(option, batch_size):
    scenario, settings = OPTIONS[option]
    env = NFVEnv(tiny(**scenario), batch_size, **settings)
    check_env_specs(env)
    # Through several horizons there is always an action, and what comes out is what the specs say.
    data = rollout(env, 60 if batch_size > 1 else 300)
    assert data["action_mask"].any(-1).all()
    assert data["next", "action_mask"].any(-1).all()
    assert data["next", "done"].any()
    assert torch.equal(data["next", "done"], data["next", "terminated"])
    assert env.observation_spec.contains(env.reset().select(*env.observation_spec.keys(True, True)))
    assert not (data["next", "outcome", "reason"] == Reason.INVALID_ACTION).any()
    assert (data["observation"] >= 0).all()
    assert (data["observation"] <= 1).all()
    # A request ends accepted or for a reason, and an answer is given only then.
    ended, accepted = data["next", "request_done"], data["next", "outcome", "accepted"]
    assert torch.equal(data["next", "outcome", "reason"] >= 0, ended & ~accepted)
    assert torch.equal(data["next", "outcome", "request_cost"] > 0, accepted)


def test_the_batch_size_is_a_number_or_a_shape():
    scenario = tiny(failures=FAILING)
    make = partial(NFVEnv, scenario, observations=[*EVERY_PART, MemoryObservation(3)], stagger=True, segment=4)
    wide = make(torch.Size([3]))
    check_env_specs(wide)
    wide.set_seed(0)
    assert_same(rollout(wide, 50), rollout(make(3), 50))
    with pytest.raises(ScenarioError, match=r"batch_size is \[2, 3\]; an environment has one batch dimension"):
        make((2, 3))


@pytest.mark.parametrize("option", OPTIONS)
def test_an_environment_without_a_batch_dimension(option):
    scenario, settings = OPTIONS[option]
    alone, batch = NFVEnv(tiny(**scenario), [], **settings), NFVEnv(tiny(**scenario), 1, **settings)
    check_env_specs(alone)
    alone.set_seed(0)
    batch.set_seed(0)
    assert alone.action_spec.shape == () and alone.rand_action()["action"].shape == ()
    assert_same(rollout(alone, 60), rollout(batch, 60)[0])
    frames = Collector(alone, RandomPolicy(), frames_per_batch=40, total_frames=80)
    assert [data.shape for data in frames] == [(40,), (40,)]
    state, other = copy.deepcopy(alone.state_dict()), NFVEnv(tiny(**scenario), [], **settings)
    other.load_state_dict(state)
    alone.load_state_dict(state)
    assert_same(rollout(other, 20), rollout(alone, 20))


def test_networks_of_different_sizes():
    env = NFVEnv([tiny(), toy_sized(6), toy_sized(4)], 5, observations=EVERY_PART)
    check_env_specs(env)
    data = rollout(env, 100)
    assert not (data["next", "outcome", "reason"] == Reason.INVALID_ACTION).any()
    assert data["next", "outcome", "accepted"].any(1).all()
    with pytest.raises(ScenarioError, match="horizon"):
        NFVEnv([tiny(), tiny(horizon=9)], 2)


def toy_sized(nodes: int) -> Scenario:
    return tiny().replace(substrate=paper_scenario(nodes, seed=1).substrate, endpoints="uniform", endpoint_pairs=None)


def test_a_seed_gives_the_same_rollout_to_the_bit():
    options = {"observations": EVERY_PART, "stagger": True}
    scenario = tiny(failures=FAILING)
    env = NFVEnv(scenario, 4, **options)
    env.set_seed(5)
    first = rollout(env, 100)
    env.set_seed(5)
    assert_same(rollout(env, 100), first)
    assert_same(rollout(NFVEnv(scenario, 4, seed=5, threads=2, **options), 100), first)
    env.set_seed(6)
    assert not torch.equal(rollout(env, 100)["observation"], first["observation"])


def test_requests_do_not_depend_on_the_batch_size():
    scenario = tiny(failures=FAILING)
    wide, narrow = NFVEnv(scenario, 8, seed=3), NFVEnv(scenario, 3, seed=3)
    for _episode in range(2):
        wide.reset()
        narrow.reset()
        for b in range(3):
            for of, count in (("", "num_requests"), ("event_", "num_events")):
                here = [env.simulator.world.env[count][b] for env in (wide, narrow)]
                assert here[0] == here[1]
                names = ("slot", "profile", "ingress", "egress", "lifetime") if not of else ("slot", "resource", "up")
                for name in names:
                    values = [getattr(env.simulator.world.arrivals, of + name)[b, : here[0]] for env in (wide, narrow)]
                    np.testing.assert_array_equal(*values)
    lifetimes = [wide.simulator.world.arrivals.lifetime[b, :5].tolist() for b in range(8)]
    assert all(one != other for one, other in pairwise(lifetimes))


def test_nothing_returned_changes_later():
    env = NFVEnv(tiny(), 2, observations=EVERY_PART)
    policy = masked_random(torch.Generator().manual_seed(0))
    td = env.reset()
    kept, copies = [], []
    for _ in range(10):
        kept.append(td)
        copies.append(td.clone())
        td = env.step(policy(td.clone()))["next"].exclude("reward")
    for now, then in zip(kept, copies, strict=True):
        assert_same(now, then)
    # The state is no view either.
    state = env.state_dict()
    before = copy.deepcopy(state)
    rollout(env, 5)
    assert_same(TensorDict(state["world"]), TensorDict(before["world"]))


@pytest.mark.parametrize("segment", [None, 3])
def test_a_step_is_what_torchrl_makes_of_it(segment):
    """``LeanEnv`` leaves out checks and copies of TorchRL's own loop, and no more than that."""
    make = partial(NFVEnv, tiny(), 4, observations=EVERY_PART, stagger=True, segment=segment)
    ours, theirs = make(), make()
    policy = masked_random(torch.Generator().manual_seed(0))
    state, other = ours.reset(), theirs.reset()
    for _ in range(60):
        action = policy(state)["action"]
        state.set("of_the_policy", action.float()).set(("own", "nested"), action)
        other.set("action", action).set("of_the_policy", action.float()).set(("own", "nested"), action)
        step, state = ours.step_and_maybe_reset(state)
        expected, other = EnvBase.step_and_maybe_reset(theirs, other)
        assert_same(step, expected)
        assert_same(state, other)
        assert (step.device, step["next"].device, state.device) == (ours.device,) * 3
        # A key that is set in what comes next is not set in what has been.
        state["outcome", "new"] = state["outcome", "accepted"]
        assert step.get(("next", "outcome", "new"), None) is None
        del state["outcome", "new"]


def test_steps_out_of_the_ordinary_are_torchrls():
    class Counting(NFVEnv):
        steps = 0

        def _step_and_maybe_reset(self, tensordict):
            self.steps += 1
            return super()._step_and_maybe_reset(tensordict)

    env = Counting(tiny(), 2)
    td = env.rand_action(env.reset())
    env.step_and_maybe_reset(td.clone())
    assert env.steps == 0
    env.step_and_maybe_reset(td.clone().set(("next", "hint"), torch.zeros(2)))
    env.step_and_maybe_reset(td.clone().clear_device_())
    env.step_and_maybe_reset(TensorDict.lazy_stack(list(td.unbind(0))))
    assert env.steps == 3


def test_partial_resets():
    scenario = tiny()
    env, undisturbed = NFVEnv(scenario, 3), NFVEnv(scenario, 3)
    generator = torch.Generator().manual_seed(0)
    td, other = env.reset(), undisturbed.reset()
    for step in range(60):
        action = masked_random(generator)(td.clone())["action"]
        td = env.step(td.clone().set("action", action))["next"]
        other_action = action.clone()
        # The middle one is on its own way in the other.
        other_action[1] = masked_random(generator)(other.clone())["action"][1]
        other = undisturbed.step(other.clone().set("action", other_action))["next"]
        assert torch.equal(td["observation"][[0, 2]], other["observation"][[0, 2]])
        assert torch.equal(td["reward"][[0, 2]], other["reward"][[0, 2]])
        td, other = td.exclude("reward"), other.exclude("reward")
        if step % 7 == 3:
            before = td.clone()
            td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False]])))
            assert_same(td[[0, 2]], before.exclude("_reset")[[0, 2]])
            assert env.simulator.world.env["num_running"][1] == 0
            assert td["observation"][1, : 5 * 2].sum() == 0
            assert not td["request_done"][1]
            assert td["outcome", "reason"][1] == -1
    assert env.simulator.world.env["slot"][0] > 0


def test_horizons_without_requests():
    # Every other horizon of one slot is empty; its first step says that it is over.
    env = NFVEnv(toy.toy_scenario(horizon=1, arrival_rate=0.5), 16)
    data = rollout(env, 40)
    empty = data["next", "done"] & ~data["next", "request_done"]
    assert empty[:, 0].any()
    assert empty[:, 1:].any()
    assert (data["action_mask"].sum(-1)[empty.squeeze(-1)] == 1).all()
    assert (data["next", "reward"][empty] == 0).all()
    collector = Collector(env, masked_random(), frames_per_batch=160, total_frames=480)
    assert sum(batch["next", "done"].sum() for batch in collector) > 30
    collector.shutdown()


def test_staggered_starts_are_on_loaded_networks():
    scenario = tiny(horizon=200, mean_lifetime=50.0)
    env = NFVEnv(scenario, 32, stagger=True)
    td = env.reset()
    world = env.simulator.world
    slots = world.env["slot"].copy()
    assert len(set(slots.tolist())) > 20
    late = (slots > 20) & (world.env["done"] == 0)
    assert (world.env["num_running"][late] > 0).all()
    used = td["observation"][:, :10].sum(-1).numpy()
    assert used[late].mean() > 10 * used[slots < 2].mean() if (slots < 2).any() else used[late].min() > 0
    env.reset()
    assert (env.simulator.world.env["slot"] != slots).mean() > 0.9  # every horizon has a start of its own
    assert NFVEnv(scenario, 4, stagger=True).reset()["observation"].equal(td["observation"][:4])


# ------------------------------------------------------------------------------------------------- saved states


@pytest.mark.parametrize("steps", [1, 5, 83])
def test_a_saved_state_goes_on_to_the_bit(steps):
    scenario = tiny(failures=FAILING)
    options = {"observations": EVERY_PART, "stagger": True}
    env = NFVEnv(scenario, 3, seed=2, **options)
    rollout(env, steps)
    in_hand = env.simulator.world.env["steps"].copy()
    state = copy.deepcopy(env.state_dict())
    resumed = NFVEnv(scenario, 3, **options)
    resumed.load_state_dict(state)
    again = NFVEnv(scenario, 3, seed=9, **options)
    rollout(again, 20)
    again.load_state_dict(state)
    first = rollout(resumed, 120, seed=4)
    assert_same(rollout(again, 120, seed=4), first)
    # The walks go on where they were.
    second = NFVEnv(scenario, 3, **options)
    second.load_state_dict(state)
    second.reset()
    np.testing.assert_array_equal(second.simulator.world.env["steps"], in_hand)
    # And as they would have without a stop.
    env.load_state_dict(state)
    assert_same(rollout(env, 120, seed=4), first)


def test_a_collector_goes_on_to_the_bit():
    scenario = tiny(failures=FAILING)
    env = NFVEnv(scenario, 4, stagger=True, seed=1)
    torch.manual_seed(0)
    collector = Collector(env, masked_random(), frames_per_batch=4 * 25, total_frames=-1)
    kept = []
    for number, batch in enumerate(collector):
        kept.append(batch.clone())
        if number == 2:
            state, rng = copy.deepcopy(env.state_dict()), torch.get_rng_state()
        if number == 5:
            break
    collector.shutdown()
    assert torch.cat(kept)["next", "done"].any()
    resumed = NFVEnv(scenario, 4, stagger=True)
    resumed.load_state_dict(state)
    collector = Collector(resumed, masked_random(), frames_per_batch=4 * 25, total_frames=-1)
    # Making a collector calls the policy once, so random numbers are restored after it.
    torch.set_rng_state(rng)
    for expected, batch in zip(kept[3:], collector, strict=False):
        # Trajectory numbers count from where a collector begins.
        assert_same(batch.exclude("collector"), expected.exclude("collector"))
    collector.shutdown()


def test_a_state_from_before_the_first_reset():
    env, other = NFVEnv(tiny(), 2, seed=8), NFVEnv(tiny(), 2)
    other.load_state_dict(env.state_dict())
    assert_same(rollout(other, 30), rollout(env, 30))


def test_a_seed_set_after_loading_begins_anew():
    env, other = NFVEnv(tiny(), 2, seed=8), NFVEnv(tiny(), 2)
    rollout(env, 10)
    other.load_state_dict(env.state_dict())
    other.set_seed(8)
    env.set_seed(8)
    assert_same(rollout(other, 30), rollout(env, 30))


def test_a_state_that_does_not_fit_is_refused():
    env = NFVEnv(tiny(), 2)
    env.reset()
    state = env.state_dict()
    for other, message in [
        (NFVEnv(tiny(), 3), "2 environments, this run has 3"),
        (NFVEnv(tiny(horizon=9), 2), "running"),
        (NFVEnv(tiny(seed=1), 2), "capacities"),
        (NFVEnv(paper_scenario(6, horizon=8), 2), "another scenario"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            other.load_state_dict(state)


def test_a_part_of_a_state_is_refused_unless_told_otherwise():
    env, other = NFVEnv(tiny(), 2, seed=8), NFVEnv(tiny(), 2, seed=8)
    rollout(env, 10)
    part = {key: value for key, value in NFVEnv(tiny(), 2).state_dict().items() if key != "episode"}
    for lacking in ({}, part):
        with pytest.raises(CheckpointError, match="missing"):
            env.load_state_dict(lacking)
        env.load_state_dict(lacking, strict=False)
    rollout(other, 10)
    assert_same(rollout(env, 30), rollout(other, 30))


# -------------------------------------------------------------------------------------------- TorchRL's own ways


def two_tiny() -> NFVEnv:
    return NFVEnv(tiny(), 2)


def test_env_creator_and_workers():
    creator = EnvCreator(two_tiny)
    assert creator().rollout(2).shape == (2, 2)
    parallel = ParallelEnv(2, creator, mp_start_method="fork")
    try:
        parallel.set_seed(3)
        data = parallel.rollout(5, masked_random())
    finally:
        parallel.close()
    assert data.shape == (2, 2, 5)
    assert not torch.equal(data[0]["observation"], data[1]["observation"])  # workers have seeds of their own


def test_random_actions_are_valid_and_follow_torchs_seed():
    env = NFVEnv(tiny(mask="feasible", admission_control=True), 16)
    runs = []
    for _ in range(2):
        env.set_seed(0)
        torch.manual_seed(7)
        runs.append(env.rollout(200, break_when_any_done=False))
    assert_same(*runs)
    taken = runs[0]["action_mask"].gather(-1, runs[0]["action"].unsqueeze(-1))
    assert taken.all()
    # Every valid action is as likely: so often is the last one, reject, taken.
    share = (runs[0]["action"] == env.num_actions - 1).float().mean()
    expected = (1 / runs[0]["action_mask"].sum(-1)).mean()
    assert abs(share - expected) < 0.03
    alone = env.rand_action()
    assert alone["action"].shape == (16,)


@pytest.mark.parametrize("seed", [-1, 2**63, 0.5, True])
def test_a_seed_out_of_range_is_refused(seed):
    with pytest.raises(ScenarioError, match=r"seed: .* is not a seed; use an integer"):
        NFVEnv(tiny(), 2).set_seed(seed)
    with pytest.raises(ScenarioError, match="seed"):
        NFVEnv(tiny(), 2, seed=seed)


# ----------------------------------------------------------------------------------------- answers and rewards


def toy_env(*requests, reward=None, **changes) -> NFVEnv:
    """One toy network with these requests, wherever they would have come from."""
    env = NFVEnv(toy.toy_scenario(**changes), 1, reward=reward, observations=EVERY_PART)
    workload = toy.workload_of(*requests) if requests else toy.toy_workload()
    env._arrivals = lambda b, episode: (workload, None)
    return env


def play(env: NFVEnv, actions: list[int]) -> list[TensorDict]:
    td, steps = env.reset(), []
    for action in actions:
        step = env.step(td.clone().set("action", torch.tensor([action])))["next"]
        steps.append(step)
        td = step.exclude("reward")
    return steps


def earned(reward, actions: list[int]) -> list[float]:
    # More delay than the toy network grants, so that there is time to wander.
    env = toy_env(reward=reward, catalogue=toy.toy_catalogue(duo_delay=2000.0))
    return [step["reward"].item() for step in play(env, actions)]


# The walk of $12, $41 and $2; with one bounce to 2 and back before it ($1 a hop) two steps longer; one that fails.
WALK = toy.DUO_0_TO_3[2]
LONGER = [toy.action(2), toy.action(0), *WALK]
FAILS = [toy.action(1, 0, True), toy.action(1)]
STEP, REQUEST = 108.0, 158.0


def test_cost_scale():
    # The dearest step is solo's; the dearest request would be a duo on the VM at $5 over two links at $4: 150 + 8.
    scale = toy_env().cost_scale
    assert scale.step.tolist() == [STEP]
    assert scale.request.tolist() == [REQUEST]


def test_a_reward_of_a_yaml_is_not_checked_anew_in_each_step():
    made = instantiate({"_target_": "nfv_torchrl.rewards.paper", "_partial_": True, "w_cost": 0.5})
    assert type(made) is not partial and type(toy_env(reward=made).reward) is partial
    assert earned(made, WALK) == earned(partial(rewards.paper, w_cost=0.5), WALK)


def test_paper_reward():
    assert earned(rewards.paper, WALK) == pytest.approx([1 - 12 / STEP, 1 - 41 / STEP, 1 - 2 / STEP])
    # Beware: the longer walk of the same placement earns more, and a rejected one keeps what its steps earned.
    assert sum(earned(rewards.paper, LONGER)) == pytest.approx(5 - 57 / STEP)
    assert earned(rewards.paper, FAILS) == pytest.approx([1 - 12 / STEP, 0])
    # Or it forfeits them: in all it has earned nothing. An accepted one is left alone.
    forfeit = partial(rewards.paper, w_cost=0.5, on_rejection="forfeit")
    first = 1 - 0.5 * 12 / STEP
    assert earned(forfeit, FAILS) == pytest.approx([first, -first])
    assert earned(forfeit, WALK) == pytest.approx(earned(partial(rewards.paper, w_cost=0.5), WALK))
    assert earned(forfeit, [toy.action(3)]) == [0]
    with pytest.raises(ScenarioError, match="on_rejection: 'lose' is unknown; use one of"):
        earned(partial(rewards.paper, on_rejection="lose"), WALK)


def test_admission_reward():
    assert earned(rewards.admission, WALK) == pytest.approx([0, 0, 1 - 55 / REQUEST])
    assert earned(rewards.admission, LONGER) == pytest.approx([0, 0, 0, 0, 1 - 57 / REQUEST])
    assert earned(rewards.admission, FAILS) == [0, 0]


def test_admission_step_cost_reward():
    expected = [-0.2 * 12 / STEP, -0.2 * 41 / STEP, 1 - 0.2 * 2 / STEP]
    assert earned(rewards.admission_step_cost, WALK) == pytest.approx(expected)
    assert earned(rewards.admission_step_cost, FAILS) == pytest.approx([-0.2 * 12 / STEP, 0])
    dearer = partial(rewards.admission_step_cost, w_step=0.125)
    assert earned(dearer, WALK) == pytest.approx([value - 0.125 for value in expected])
    assert earned(dearer, FAILS) == pytest.approx([-0.2 * 12 / STEP - 0.125, 0])  # the step that failed pays nothing
    assert earned(None, WALK) == pytest.approx(expected)


def test_answers():
    steps = play(toy_env(), [*WALK, toy.action(1), toy.REJECT])
    assert [step["request_done"].item() for step in steps] == [False, False, True, False, True]
    assert [step["outcome", "accepted"].item() for step in steps] == [False, False, True, False, False]
    assert [step["outcome", "reason"].item() for step in steps] == [-1, -1, -1, -1, Reason.INVALID_ACTION]
    assert [step["outcome", "request_cost"].item() for step in steps] == [0, 0, 55, 0, 0]


@pytest.mark.parametrize("action", [-1, -5, 17, 10**9])
def test_actions_that_are_none(action):
    (step,) = play(toy_env(), [action])
    assert (step["outcome", "reason"].item(), step["request_done"].item()) == (Reason.INVALID_ACTION, True)
    assert step["reward"].item() == 0


def test_a_segment_ends_between_requests_and_is_no_end_of_the_horizon():
    scenario = tiny(horizon=200, mean_lifetime=50.0)
    env = NFVEnv(scenario, 8, stagger=True, segment=5)
    data = rollout(env, 300)
    left = data["next", "done"] & ~data["next", "terminated"]
    assert left.sum() > 16
    assert data["next", "request_done"][left].all()
    whole = rollout(NFVEnv(scenario, 8, stagger=True), 300)
    assert whole["next", "done"].equal(whole["next", "terminated"])
    with pytest.raises(ScenarioError, match="stagger"):
        NFVEnv(scenario, 8, segment=5)
