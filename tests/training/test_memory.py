"""The replay memory in a checkpoint: every bit comes back, in little room, and a stranger's fills no memory."""

import copy
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.training.compact import RATIO, pack, unpack
from nfv_torchrl.training.disk import tensor_bytes
from nfv_torchrl.training.memory import MemoryState

SHAPES = arrays.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6)


def bits(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array).tobytes()


@settings(max_examples=60, deadline=None)
@given(
    st.one_of(
        arrays.arrays(np.bool_, SHAPES),
        arrays.arrays(np.int64, SHAPES),
        arrays.arrays(np.int32, SHAPES, elements=st.integers(-200, 200)),
        arrays.arrays(np.float32, SHAPES, elements=st.floats(width=32)),
        arrays.arrays(np.float32, SHAPES, elements=st.sampled_from([0, 1, 0.001, 0.37, 65.535, 65.536, -0.0])),
        arrays.arrays(np.float64, SHAPES),
    )
)
def test_every_bit_comes_back(array):
    again = unpack("x", pack(array), array.dtype, array.shape)
    assert again.dtype == array.dtype and again.shape == array.shape
    assert bits(again) == bits(array)


def buffer_of(size: int) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=8)


@pytest.fixture(scope="module")
def filled() -> TensorDictReplayBuffer:
    """A memory that has gone round once and stands in the middle of its rows."""
    env = NFVEnv(paper_scenario(horizon=20, arrival_rate=4.0), 8, stagger=True)
    torch.manual_seed(0)
    buffer = buffer_of(3000)
    for _ in range(4):
        data = env.rollout(120, break_when_any_done=False, auto_reset=True)
        keys = ("observation", "action_mask", "action", ("next", "observation"), ("next", "reward"), ("next", "done"))
        buffer.extend(data.select(*keys).reshape(-1))
    return buffer


def test_a_memory_comes_back_and_goes_on(filled):
    state = MemoryState(filled).state_dict()
    other = buffer_of(3000)
    MemoryState(other).load_state_dict(state)
    assert list(map(str, other[:].keys(True, True)))[:-1] == list(map(str, filled[:].keys(True, True)))[:-1]
    more = filled[:50].exclude("index").clone()
    for buffer in (filled, other):
        buffer.extend(more)
    for key in filled[:].exclude("index").keys(True, True):
        assert torch.equal(filled[:][key], other[:][key]), key
    assert tensor_bytes(filled[:].to_dict()) > 10 * tensor_bytes(state)


def test_an_empty_memory():
    other = buffer_of(3)
    MemoryState(other).load_state_dict(MemoryState(buffer_of(3)).state_dict())
    assert len(other) == 0


def test_an_array_of_one_value_stays_within_the_ratio():
    zeros = np.zeros((2**14, 500), np.float32)
    packed = pack(zeros)
    assert tensor_bytes(packed) >= zeros.nbytes // 2 // RATIO  # as integers of 16 bits
    assert not unpack("x", packed, zeros.dtype, zeros.shape).any()


def bomb(item: dict) -> None:
    item["shape"] = [2**31]


def zip_bomb(item: dict) -> None:
    data = zlib.compress(bytes(10**8), 9)
    item["blocks"][0]["shares"] = torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def cut(item: dict) -> None:
    item["blocks"][0]["shares"] = item["blocks"][0]["shares"][:-9]


def noise(item: dict) -> None:
    item["blocks"][0]["shares"][:50] = 255


def no_block(item: dict) -> None:
    item["blocks"] = []


def text(item: dict) -> None:
    item["dtype"] = "text"


def unknown_form(item: dict) -> None:
    item["blocks"][0] = {"pickle": torch.zeros(3, dtype=torch.uint8)}


@pytest.mark.parametrize("damage", [bomb, zip_bomb, cut, noise, no_block, text, unknown_form])
def test_a_damaged_item_is_refused_by_name(filled, damage):
    state = copy.deepcopy(MemoryState(filled).state_dict())
    damage(state["items"]["observation"])
    with pytest.raises(CheckpointError, match=r"^checkpoint: buffer\.items\.observation"):
        MemoryState(buffer_of(3000)).load_state_dict(state)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"size": 3001}, "buffer.size is 3001, outside 0 .. 3000"),
        ({"size": -1}, "buffer.size"),
        ({"writer": {"_cursor": 3000, "_write_count": 3840}}, "buffer.writer._cursor"),
        ({"writer": {"_cursor": 0.5, "_write_count": 3840}}, "buffer.writer._cursor is a float"),
        ({"writer": {"_cursor": 840, "_write_count": 2}}, "buffer.writer._write_count is 2"),
        ({"writer": {}}, "buffer.writer._cursor is missing"),
        ({"sampler": {"x": 1}}, "buffer.sampler.x is not known"),
        ({"items": []}, "buffer.items is no mapping"),
        ({"extra": 1}, "buffer.extra is not known"),
    ],
)
def test_sizes_are_checked(filled, change, named):
    state = MemoryState(filled).state_dict() | change
    with pytest.raises(CheckpointError, match=named.replace(".", r"\.")):
        MemoryState(buffer_of(3000)).load_state_dict(state)


def test_items_are_such_as_the_loss_keeps(filled):
    state = MemoryState(filled).state_dict()
    rows = filled[:2].exclude("index")
    MemoryState(buffer_of(3000), rows).load_state_dict(state)
    changed = rows.clone().rename_key_("action", "choice")
    changed["next", "reward"] = changed["next", "reward"].double()
    with pytest.raises(CheckpointError, match=r"keeps: action, choice, next\.reward differ\. The loss"):
        MemoryState(buffer_of(3000), changed).load_state_dict(state)


def test_rows_that_are_left_out_must_be_elsewhere(filled):
    state = MemoryState(filled).state_dict()
    del state["items"]["observation"]
    with pytest.raises(CheckpointError, match="leaves out rows that are nowhere else"):
        MemoryState(buffer_of(3000)).load_state_dict(state)


def test_windows_of_steps_come_back():
    buffer = buffer_of(5)
    torch.manual_seed(0)
    rows = TensorDict({"x": torch.rand(4, 3, 2), "next": {"x": torch.rand(4, 3, 2)}}, [4, 3])
    buffer.extend(TensorDict({"observation": rows["x"], "next": {"observation": rows["next", "x"]}}, [4]))
    other = buffer_of(5)
    MemoryState(other).load_state_dict(MemoryState(buffer).state_dict())
    assert torch.equal(other[:]["next", "observation"], rows["next", "x"])
