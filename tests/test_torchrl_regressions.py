"""What the project relies on in TorchRL 0.14: an upgrade that changes any of it shows here first.

Each test is a behaviour seen to be so, with the reason why it matters. Some are traps that the project walks around;
when such a test fails, the detour may have become unnecessary.
"""

import importlib
import math

import pytest
import torch
import toy
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import (
    Binary,
    Categorical,
    Composite,
    LazyTensorStorage,
    OneHot,
    PrioritizedSampler,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import ActionMask, MultiStepTransform
from torchrl.modules import EGreedyModule, MaskedCategorical, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate

from nfv_torchrl.env import NFVEnv

# The losses of these tests have target networks that nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")

ACTIONS = 3


class Table(nn.Module):
    """Q-values by a number of the state: row 0 for the state before, row 1 for the one after."""

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 9.0]]))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        return self.values[state.squeeze(-1).long()]


def actor(masked: bool = True, spec=None) -> QValueActor:
    module = TensorDictModule(Table(), in_keys=["observation"], out_keys=["action_value"])
    key = {"action_mask_key": "action_mask"} if masked else {}
    space = "categorical" if spec is None else "one_hot"
    return QValueActor(module, spec=spec or Categorical(ACTIONS), action_space=space, **key)


def transition(next_mask: list[bool], request_done: bool = False, done: bool = False) -> TensorDict:
    """One step from row 0 by action 0 to row 1, with reward 10."""
    return TensorDict(
        {
            "observation": torch.zeros(1, 1),
            "action_mask": torch.ones(1, ACTIONS, dtype=torch.bool),
            "action": torch.zeros(1, dtype=torch.int64),
            "next": {
                "observation": torch.ones(1, 1),
                "action_mask": torch.tensor([next_mask]),
                "reward": torch.full((1, 1), 10.0),
                "done": torch.tensor([[done]]),
                "terminated": torch.tensor([[done]]),
                "request_done": torch.tensor([[request_done]]),
            },
        },
        batch_size=[1],
    )


def loss_of(actor: QValueActor, *, double: bool = False, gamma: float = 0.5, stop_at: str | None = None) -> DQNLoss:
    loss = DQNLoss(actor, loss_function="l2", delay_value=True, double_dqn=double, action_space="categorical")
    loss.make_value_estimator(gamma=gamma)
    if stop_at:
        loss.set_keys(done=stop_at, terminated=stop_at)
    return loss


def target_of(loss: DQNLoss, data: TensorDict) -> float:
    """r + gamma max Q, read off the squared error against Q(s, 0) = 1; targets here are above 1."""
    return 1.0 + math.sqrt(loss(data)["loss"].item())


# ----------------------------------------------------------------------------------------------- masked Q-learning


@pytest.mark.parametrize("double", [False, True])
def test_dqn_loss_reads_the_next_mask(double):
    # The paper's target takes its maximum over A_p of the next state only: 5 of (4, 5), not 9.
    loss = loss_of(actor(), double=double)
    assert target_of(loss, transition([True, True, False])) == pytest.approx(10 + 0.5 * 5)
    assert target_of(loss, transition([True, False, False])) == pytest.approx(10 + 0.5 * 4)
    assert target_of(loss, transition([True, True, True])) == pytest.approx(10 + 0.5 * 9)


def test_double_dqn_chooses_by_the_online_network_within_the_mask():
    # What `double_dqn` promises: the online network chooses among valid actions, the target network says what that is
    # worth. Online row 1 prefers action 1 once action 2 is masked; the target, left behind, rates it at 5.
    loss = loss_of(actor(), double=True)
    with torch.no_grad():
        next(loss.value_network_params.values(True, True)).data[1] = torch.tensor([6.0, 7.0, 8.0])
        next(loss.target_value_network_params.values(True, True)).data[1] = torch.tensor([100.0, 5.0, 1000.0])
    assert target_of(loss, transition([True, True, False])) == pytest.approx(10 + 0.5 * 5)


@pytest.mark.parametrize("double", [False, True])
def test_without_a_mask_key_the_target_looks_at_invalid_actions(double):
    # No error, no warning: the maximum runs over everything. So every actor here is given `action_mask_key`.
    loss = loss_of(actor(masked=False), double=double)
    assert target_of(loss, transition([True, True, False])) == pytest.approx(10 + 0.5 * 9)


def test_a_mask_without_a_valid_action():
    # Where the horizon ends it does no harm with categorical actions; elsewhere the loss is infinite. So the
    # environment leaves `reject` valid in every state, the last one included.
    nothing = [False] * ACTIONS
    assert target_of(loss_of(actor()), transition(nothing, done=True)) == pytest.approx(10)
    assert not math.isfinite(loss_of(actor())(transition(nothing))["loss"].item())


def test_the_loss_stops_at_the_key_it_is_told():
    # Looking ahead to the end of a request is the loss's choice: `request_done` beside `done`.
    between = transition([True, True, False], request_done=True)
    for stop_at, expected in [(None, 12.5), ("request_done", 10)]:
        for double in (False, True):
            assert target_of(loss_of(actor(), double=double, stop_at=stop_at), between) == pytest.approx(expected)
    on = transition([True, True, False])
    assert target_of(loss_of(actor(), stop_at="request_done"), on) == pytest.approx(12.5)


def test_gamma_belongs_to_the_value_estimator():
    loss = loss_of(actor(), gamma=1.0, stop_at="request_done")
    assert target_of(loss, transition([True, True, False])) == pytest.approx(15)
    assert target_of(loss, transition([True, True, False], request_done=True)) == pytest.approx(10)


def test_the_target_network_moves_when_the_updater_says():
    # HardUpdate copies at the step after `value_network_update_interval` others, and its count is in its state. It also
    # copies when it is made, so a resumed run makes it before it loads the target's weights.
    loss = loss_of(actor())
    updater, resumed = (HardUpdate(loss, value_network_update_interval=2) for _ in range(2))
    with torch.no_grad():
        for value in loss.value_network_params.values(True, True):
            value.data += 1
    data = transition([True, True, False])
    taken = 2.0  # Q(s, 0) now
    before = taken + math.sqrt(loss(data)["loss"].item())
    assert before == pytest.approx(12.5)
    updater.step()
    resumed.load_state_dict(updater.state_dict())
    resumed.step()
    assert taken + math.sqrt(loss(data)["loss"].item()) == pytest.approx(12.5)
    resumed.step()
    assert taken + math.sqrt(loss(data)["loss"].item()) == pytest.approx(13)
    with torch.no_grad():
        for value in loss.value_network_params.values(True, True):
            value.data -= 1
    HardUpdate(loss, value_network_update_interval=2)
    assert target_of(loss, data) == pytest.approx(12.5)


def test_masked_values_hold_the_lowest_number():
    # `action_value` is overwritten where the mask is False, so its mean says nothing: log `chosen_action_value`.
    td = actor()(TensorDict({"observation": torch.ones(1, 1), "action_mask": torch.tensor([[True, True, False]])}, [1]))
    assert td["action_value"].min() < -1e30
    assert (td["action"].item(), td["chosen_action_value"].item()) == (1, 5)


def test_one_hot_actions_pick_several_where_values_tie():
    # An initial network may well tie. Hence categorical actions.
    td = TensorDict({"observation": torch.zeros(1, 1), "action_mask": torch.ones(1, ACTIONS, dtype=torch.bool)}, [1])
    for spec, several in [(None, False), (OneHot(ACTIONS), True)]:
        q = actor(spec=spec)
        with torch.no_grad():
            q.module[0].module.values.fill_(1.0)
        action = q(td.clone())["action"]
        assert (action.dim() == 2 and int(action.sum()) > 1) is several


# --------------------------------------------------------------------------------------------------- exploration


def greedy_then_random(spec=None, eps: float = 1.0) -> TensorDictSequential:
    explore = EGreedyModule(spec or Categorical(ACTIONS), eps_init=eps, eps_end=eps, action_mask_key="action_mask")
    return TensorDictSequential(actor(), explore)


def test_epsilon_greedy_explores_valid_actions_only():
    mask = torch.tensor([[True, True, False], [False, True, True], [False, False, True]]).repeat(200, 1)
    td = TensorDict({"observation": torch.zeros(600, 1), "action_mask": mask}, [600])
    action = greedy_then_random()(td)["action"]
    assert action.shape == (600,)
    assert mask.gather(1, action.unsqueeze(1)).all()
    assert set(action[::3].tolist()) == {0, 1}
    assert set(action[1::3].tolist()) == {1, 2}


def test_epsilon_is_a_buffer_that_can_be_set():
    # `step(k)` loops over k frames in Python; setting it in closed form is quick and resumes exactly.
    explore = EGreedyModule(Categorical(ACTIONS), action_mask_key="action_mask")
    explore.eps.fill_(0.0)
    td = TensorDict(
        {
            "observation": torch.zeros(64, 1),
            "action_mask": torch.ones(64, ACTIONS, dtype=torch.bool),
            "action": torch.full((64,), 2),
        },
        [64],
    )
    assert (explore(td.clone())["action"] == 2).all()
    assert "eps" in explore.state_dict()


def test_epsilon_greedy_cannot_choose_from_nothing():
    # The other reason to keep `reject` valid in every state.
    td = TensorDict({"observation": torch.zeros(1, 1), "action_mask": torch.zeros(1, ACTIONS, dtype=torch.bool)}, [1])
    with pytest.raises(RuntimeError, match="prob"):
        greedy_then_random()(td)


def test_the_environments_own_spec_takes_on_the_mask():
    # A batched spec given to the explorer keeps the last mask, here that of the environment; a fresh one does not
    # reach the environment. So exploration gets a `Categorical` of its own.
    env = NFVEnv(toy.toy_scenario(), 2)
    td = env.reset().set("action", torch.zeros(2, dtype=torch.int64))
    EGreedyModule(Categorical(env.num_actions), eps_init=1.0, action_mask_key="action_mask")(td.clone())
    assert env.action_spec.mask is None
    spec = env.action_spec.clone()
    EGreedyModule(spec, eps_init=1.0, action_mask_key="action_mask")(td.clone())
    assert spec.mask is not None


def test_the_action_mask_transform_draws_valid_actions():
    env = TransformedEnv(NFVEnv(toy.toy_scenario(horizon=50), 4), ActionMask())
    data = env.rollout(60, break_when_any_done=False)
    chosen = data["action_mask"].gather(-1, data["action"].unsqueeze(-1))
    assert chosen.all()


def test_masked_categorical_ignores_invalid_actions():
    # Entropy and probabilities of stochastic policies run over valid actions only.
    distribution = MaskedCategorical(
        logits=torch.zeros(1, ACTIONS), mask=torch.tensor([[True, False, True]]), neg_inf=-1e9
    )
    assert distribution.probs[0].tolist() == pytest.approx([0.5, 0, 0.5])
    assert set(distribution.sample((100,)).flatten().tolist()) == {0, 2}


def test_multi_step_returns_do_not_stop_where_a_horizon_ends():
    # The step before the last gets the last state as its next one, yet is not marked as terminated: it would
    # bootstrap from there. Hence an n-step return of the project's own.
    transform = MultiStepTransform(n_steps=2, gamma=1.0)
    steps = 4
    done = torch.zeros(1, steps, 1, dtype=torch.bool)
    done[0, 2] = True
    data = TensorDict(
        {
            "observation": torch.arange(steps).float().reshape(1, steps, 1),
            "next": {
                "observation": torch.arange(1, steps + 1).float().reshape(1, steps, 1),
                "reward": torch.ones(1, steps, 1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        batch_size=[1, steps],
    )
    shifted = transform._inv_call(data)
    assert shifted["next", "reward"][0, 1].item() == 2
    assert not shifted["next", "terminated"][0, 1].item()


# ------------------------------------------------------------------------------------ environments and collectors


class Counter(EnvBase):
    """Counts steps; environment b's horizon is b + 2 steps."""

    def __init__(self, batch_size: int = 3) -> None:
        super().__init__(batch_size=torch.Size([batch_size]))
        shape = (batch_size, 1)
        self.observation_spec = Composite(count=Unbounded(shape), shape=self.batch_size)
        self.action_spec = Categorical(2, shape=self.batch_size)
        self.reward_spec = Unbounded(shape)
        self.done_spec = Composite(
            done=Binary(1, shape=shape, dtype=torch.bool),
            terminated=Binary(1, shape=shape, dtype=torch.bool),
            shape=self.batch_size,
        )
        self.count = torch.zeros(shape)
        self.resets: list = []

    def _reset(self, tensordict=None, **kwargs):
        rows = None if tensordict is None else tensordict.get("_reset", None)
        self.resets.append((rows, None if tensordict is None else set(tensordict.keys())))
        self.count = torch.zeros_like(self.count) if rows is None else self.count.masked_fill(rows, 0.0)
        # What is returned for rows that are not reset is left out by TorchRL: a number that cannot be overlooked.
        shown = self.count.clone() if rows is None else torch.where(rows, self.count, -7.0)
        done = torch.zeros_like(self.count, dtype=torch.bool)
        return TensorDict({"count": shown, "done": done, "terminated": done.clone()}, self.batch_size)

    def _step(self, tensordict):
        self.count = self.count + 1
        done = self.count >= torch.arange(2, self.batch_size[0] + 2).unsqueeze(-1)
        values = {"count": self.count.clone(), "reward": torch.ones_like(self.count)}
        return TensorDict({**values, "done": done, "terminated": done.clone()}, self.batch_size)

    def _set_seed(self, seed):
        pass


def first_action() -> TensorDictModule:
    return TensorDictModule(lambda count: torch.zeros(len(count), dtype=torch.int64), ["count"], ["action"])


def test_partial_resets_merge_what_the_environment_returns():
    # `NFVEnv._reset` relies on it: it returns fresh values for all rows, and those that were not reset keep theirs.
    env = Counter()
    data = env.rollout(6, first_action(), break_when_any_done=False)
    assert data["count"][..., 0].tolist() == [[0, 1, 0, 1, 0, 1], [0, 1, 2, 0, 1, 2], [0, 1, 2, 3, 0, 1]]
    partial = [rows for rows, _ in env.resets if rows is not None]
    assert partial[0].flatten().tolist() == [True, False, False]


def test_a_reset_row_that_is_done_is_refused():
    # A horizon without requests is over when it begins; `NFVEnv` says so with its first step, for this reason.
    env = Counter()
    plain = env._reset
    env._reset = lambda *args, **kwargs: plain(*args, **kwargs).update({"done": torch.ones(3, 1, dtype=torch.bool)})
    with pytest.raises(RuntimeError, match="done"):
        env.reset()


def collector_of(env: EnvBase, policy, batches: int = -1) -> Collector:
    frames = 4 * env.batch_size[0]
    return Collector(env, policy, frames_per_batch=frames, total_frames=batches if batches < 0 else batches * frames)


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_collector_begins_with_one_reset():
    # A loaded environment answers its first reset by going on; were there a second one, it would start a new horizon.
    env = Counter()
    collector = collector_of(env, first_action(), batches=2)
    full = [rows for rows, _ in env.resets if rows is None or rows.all()]
    assert len(full) == 1
    counts = torch.cat([batch["count"] for batch in collector], 1)
    assert counts[..., 0].tolist()[0] == [0, 1, 0, 1, 0, 1, 0, 1]
    assert len([rows for rows, _ in env.resets if rows is None]) == 1
    collector.shutdown()


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_collector_calls_the_policy_once_before_it_begins():
    # It may draw random numbers there, so a resumed run restores them after making the collector.
    calls = []

    def act(count: torch.Tensor) -> torch.Tensor:
        calls.append(len(calls))
        return torch.randint(2, (len(count),))

    collector = collector_of(Counter(), TensorDictModule(act, ["count"], ["action"]), batches=1)
    assert len(calls) == 1
    list(collector)
    assert len(calls) == 1 + 4
    collector.shutdown()


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_collectors_state_lacks_the_environments():
    # `NFVEnv.state_dict` is therefore part of a checkpoint by itself.
    env = NFVEnv(toy.toy_scenario(), 2)
    policy = TensorDictModule(lambda mask: mask.float().argmax(-1), ["action_mask"], ["action"])
    collector = collector_of(env, policy, batches=2)
    next(iter(collector))

    def names(state, prefix=""):
        for key, value in state.items():
            yield prefix + str(key)
            if hasattr(value, "items"):
                yield from names(value, f"{prefix}{key}.")

    assert not [name for name in names(collector.state_dict()) if "world" in name]
    assert [name for name in names(env.state_dict()) if "world" in name]
    assert not [name for name in names(TransformedEnv(env).state_dict()) if "world" in name]
    collector.shutdown()


# --------------------------------------------------------------------------------------------- replay and resume


def test_a_buffer_resumes_with_what_it_held():
    def filled() -> TensorDictReplayBuffer:
        return TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=4)

    buffer, other = filled(), filled()
    buffer.extend(TensorDict({"x": torch.arange(6)}, [6]))
    buffer.extend(TensorDict({"x": torch.arange(6, 11)}, [5]))
    other.extend(TensorDict({"x": torch.zeros(1, dtype=torch.int64)}, [1]))
    other.load_state_dict(buffer.state_dict())
    for memory in (buffer, other):
        # Where it writes next is part of the state, too.
        memory.extend(TensorDict({"x": torch.tensor([11])}, [1]))
    assert torch.equal(buffer[:]["x"], other[:]["x"])
    torch.manual_seed(0)
    first = buffer.sample()["x"]
    torch.manual_seed(0)
    assert torch.equal(other.sample()["x"], first)


def test_the_compiled_extension_fits_this_torch():
    # It is built for one torch release; with another it does not load, and whatever needs segment trees with it.
    importlib.import_module("torchrl._torchrl")


def test_prioritised_sampling_follows_the_priorities():
    # alpha = 1: an item is drawn in proportion to its priority, and its weight makes up for that.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(4),
        sampler=PrioritizedSampler(4, alpha=1.0, beta=1.0, eps=0.0),
        batch_size=4000,
        priority_key="priority",
    )
    buffer.extend(TensorDict({"x": torch.arange(4), "priority": torch.ones(4)}, [4]))
    buffer.update_priority(torch.arange(4), torch.tensor([1e-9, 1.0, 3.0, 1e-9]))
    torch.manual_seed(0)
    drawn = buffer.sample()
    share = (drawn["x"] == 2).float().mean().item()
    assert set(drawn["x"].tolist()) == {1, 2}
    assert share == pytest.approx(0.75, abs=0.03)
    weight = {x: drawn["priority_weight"][drawn["x"] == x].unique().tolist() for x in (1, 2)}
    assert weight[1][0] / weight[2][0] == pytest.approx(3.0, rel=1e-4)


def test_random_numbers_resume():
    state = GlobalRNGState().state_dict()
    first = torch.rand(3)
    GlobalRNGState().load_state_dict(state)
    assert torch.equal(torch.rand(3), first)
