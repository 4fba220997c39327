"""Replay memories of every kind: what they draw, what they weigh, and that a checkpoint holds all of it."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, RandomSampler

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.losses import DQN, Imitation, RecurrentDQN, q_network
from nfv_torchrl.networks import Sizes
from nfv_torchrl.networks.gru import GRUNetwork
from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training.disk import tensor_bytes
from nfv_torchrl.training.memory import MemoryState
from nfv_torchrl.training.replay import check_replay, make_buffer, some_rows

UNIFORM = {
    "storage": {"_target_": "torchrl.data.LazyTensorStorage"},
    "sampler": {"_target_": "torchrl.data.RandomSampler"},
    "writer": {"_target_": "torchrl.data.TensorDictRoundRobinWriter"},
    "beta": None,
}
PRIORITIZED = UNIFORM | {
    "sampler": {"_target_": "torchrl.data.PrioritizedSampler", "alpha": 0.5, "beta": 1.0, "eps": 1e-6}
}
RECENT = UNIFORM | {"sampler": {"_target_": "nfv_torchrl.training.recent.RecentSampler", "preference": 2.0}}
ONCE = UNIFORM | {"sampler": {"_target_": "torchrl.data.SamplerWithoutReplacement"}}
SCENARIO = paper_scenario(horizon=30, arrival_rate=4.0)


def memory(parts, size=8, batch_size=4):
    return make_buffer(parts, size=size, batch_size=batch_size, device="cpu")


def env_of(loss):
    return NFVEnv(SCENARIO, 1, observations=q_network(loss).observations())


def items(first, last):
    return TensorDict({"x": torch.arange(first, last, dtype=torch.float32)}, [last - first])


def test_the_newest_are_preferred_as_the_power_law_says():
    buffer = memory(RECENT, size=8, batch_size=40_000)
    buffer.extend(items(0, 13))  # once round: 5 is the oldest, 12 the newest
    torch.manual_seed(0)
    drawn = np.bincount(buffer.sample()["x"].long(), minlength=13)[5:][::-1] / 40_000
    expected = np.diff(np.sqrt(np.arange(9) / 8))
    assert np.abs(drawn - expected).max() < 0.01


def test_priorities_and_weights_by_hand():
    """Errors 1, 4, 9 and 16 to the power 1/2 are 1, 2, 3 and 4; weights are (p / the smallest p) ** -1."""
    buffer = memory(PRIORITIZED, size=4, batch_size=20_000)
    buffer.extend(items(0, 4))
    learned = TensorDict({"index": torch.arange(4), "td_error": torch.tensor([[1.0], [4.0], [9.0], [16.0]])}, [4])
    buffer.update_tensordict_priority(learned)
    np.random.seed(0)  # noqa: NPY002  where TorchRL's sampler draws from
    batch = buffer.sample()
    shares = batch["x"].long().bincount() / len(batch)
    assert torch.allclose(shares, torch.tensor([0.1, 0.2, 0.3, 0.4]), atol=0.01)
    weights = 1 / (batch["x"] + 1)
    assert torch.allclose(batch["priority_weight"], weights, atol=1e-4)
    assert torch.allclose((batch["priority_weight"]).mean(), torch.tensor(0.4), atol=0.01)  # 4 * 0.1


@pytest.mark.parametrize(
    "parts", [UNIFORM, PRIORITIZED, RECENT, ONCE], ids=["uniform", "prioritized", "recent", "once"]
)
@pytest.mark.parametrize("written", [5, 13])
def test_a_memory_that_was_saved_goes_on_to_the_bit(parts, written):
    buffer, other = memory(parts), memory(parts)

    def learn(memory):
        batch = memory.sample()
        batch["td_error"] = (batch["x"] * 0.37 + 0.1).sin().abs().unsqueeze(-1)
        memory.update_tensordict_priority(batch)
        return batch["x"], batch.get("priority_weight", None)

    buffer.extend(items(0, written))
    torch.manual_seed(0), np.random.seed(0)  # noqa: NPY002
    for _ in range(20):
        learn(buffer)
    MemoryState(other).load_state_dict(copy.deepcopy(MemoryState(buffer).state_dict()))
    seen = []
    for one in (buffer, other):
        torch.manual_seed(1), np.random.seed(1)  # noqa: NPY002
        mine = []
        for k in range(10):
            mine.append(learn(one))
            one.extend(items(20 + 2 * k, 22 + 2 * k))
        seen.append(mine)
    for (x, weight), (y, other_weight) in zip(*seen, strict=True):
        assert torch.equal(x, y)
        assert weight is None or torch.equal(weight, other_weight)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda s: s["sampler"].pop("largest"), "buffer.sampler.largest is missing"),
        (
            lambda s: s["sampler"].update(largest=[torch.tensor(2.0), torch.tensor(8)]),
            "buffer.sampler.largest is outside",
        ),
        (lambda s: s["sampler"].update(largest=[torch.tensor(torch.inf), torch.tensor(0)]), "largest holds numbers"),
        (lambda s: s["sampler"].update(priorities={"raw": torch.zeros(3, dtype=torch.uint8)}), "priorities is damaged"),
    ],
)
def test_damaged_priorities_are_refused_by_name(damage, named):
    buffer = memory(PRIORITIZED)
    buffer.extend(items(0, 6))
    state = MemoryState(buffer).state_dict()
    damage(state)
    with pytest.raises(CheckpointError, match=named.replace(".", r"\.")):
        MemoryState(memory(PRIORITIZED)).load_state_dict(state)


def losses():
    sizes = Sizes.of(Simulator(SCENARIO, 1, one_hot=True))
    return DQN(MLPNetwork, sizes), Imitation(MLPNetwork, sizes), RecurrentDQN(GRUNetwork, sizes)


def test_parts_are_tried_before_a_run_and_leave_no_trace():
    dqn, imitation, recurrent = losses()
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    for loss in (dqn, recurrent):
        rows = some_rows(loss, env_of(loss), steps=16)
        for parts in (UNIFORM, PRIORITIZED, RECENT, ONCE):
            item = check_replay(loss, rows, parts, size=100)
        buffer = memory(UNIFORM, size=len(rows))
        buffer.extend(rows)
        assert item == tensor_bytes(buffer[:].exclude("index").to_dict()) / len(rows)
    assert torch.equal(torch.rand(1), expected)

    rows = some_rows(imitation, env_of(imitation), steps=16)
    slices = UNIFORM | {"sampler": {"_target_": "torchrl.data.SliceSampler", "num_slices": 2}}
    best = UNIFORM | {"writer": {"_target_": "torchrl.data.TensorDictMaxValueWriter", "rank_key": "action"}}
    for parts, size, named in (
        (PRIORITIZED, 100, r"^buffer\.sampler: PrioritizedSampler .* Imitation does not write"),
        (slices, 100, r"^buffer: SliceSampler, .* do not work here"),
        (best, 100, r"^buffer\.writer: TensorDictMaxValueWriter cannot be saved"),
        (UNIFORM | {"storage": {"_target_": "torchrl.data.ListStorage"}}, 100, r"^buffer\.storage: ListStorage"),
        (UNIFORM, 10**10, r"buffer\.size=10000000000"),
    ):
        with pytest.raises(ScenarioError, match=named):
            check_replay(imitation, rows, parts, size=size)


def test_items_can_be_on_the_disk(tmp_path):
    parts = UNIFORM | {
        "storage": {"_target_": "torchrl.data.LazyMemmapStorage", "scratch_dir": str(tmp_path / "items")}
    }
    loss = losses()[0]
    rows = some_rows(loss, env_of(loss), steps=8)
    check_replay(loss, rows, parts, size=100)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ScenarioError, match=r"buffer\.size=10+ needs .* GB on the disk of"):
        check_replay(loss, rows, parts, size=10**11)
    buffer = memory(parts, size=100)
    buffer.extend(rows)
    assert isinstance(buffer.storage, LazyMemmapStorage) and isinstance(buffer.sampler, RandomSampler)
    other = memory(UNIFORM, size=100)
    MemoryState(other).load_state_dict(MemoryState(buffer).state_dict())
    assert torch.equal(other[:]["observation"], buffer[:]["observation"])
