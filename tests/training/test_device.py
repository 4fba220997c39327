"""What a learner does on a device of its own, without a GPU: no number of a tensor is asked for in an update.

A GPU is waited for when Python needs such a number (``item``, ``float``, ``if``), and when a tensor goes to
the CPU.
"""

import copy
from contextlib import contextmanager

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from tiny import ROOT
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl import _torchrl

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import q_network
from nfv_torchrl.networks import Sizes
from nfv_torchrl.scenario.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.training import replay
from nfv_torchrl.training.learner import NoUpdater, gradient_step, target_updater
from nfv_torchrl.training.replay import make_buffer, some_rows
from nfv_torchrl.training.setup import make_loss

FOLDER = ROOT / "recipes/config"
LOSSES = [("dqn", f"loss={path.stem}") for path in sorted((FOLDER / "loss").glob("[!_]*.yaml"))]
LOSSES += [("policy_gradient", f"pg_loss={path.stem}") for path in sorted((FOLDER / "pg_loss").glob("[!_]*.yaml"))]
NETWORK = {name: ["network=gru"] for name in ("loss=rdpg", "loss=recurrent_dqn", "pg_loss=recurrent_ppo")}
# TorchRL 0.14.1: its ClipPPOLoss asks whether the entropy is finite.
WAITS = {"pg_loss=ppo": ["item"], "pg_loss=recurrent_ppo": ["item"]}
NETWORK |= {"loss=iqn": ["network=implicit"]}


class Waits(TorchDispatchMode):
    """Notes the operation by which Python gets a number of a tensor."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if operation is torch.ops.aten._local_scalar_dense.default:
            self.seen.append("item")
        return operation(*args, **(kwargs or {}))


@contextmanager
def waits(monkeypatch):
    """What a GPU would be waited for in the block."""
    mode = Waits()
    with monkeypatch.context() as patched, mode:
        for name in ("cpu", "numpy", "tolist"):
            patched.setattr(torch.Tensor, name, _noted(getattr(torch.Tensor, name), name, mode.seen))
        yield mode.seen


def _noted(method, name, seen):
    def noted(self, *args, **kwargs):
        seen.append(name)
        return method(self, *args, **kwargs)

    return noted


class Still(torch.optim.SGD):
    """Without Adam's count of steps, which is on the CPU and asked for there."""


@pytest.mark.parametrize(("recipe", "choice"), LOSSES)
def test_an_update_never_asks_the_device_for_a_number(recipe, choice, monkeypatch):
    loss, batch = loss_and_rows(recipe, choice)
    # What a perceptron computes on a CPU alone, with compiled code of ours, is left out on other devices.
    monkeypatch.setattr("nfv_torchrl.losses.dqn.serves", lambda network, tensordict: False)
    with initialize_config_dir(str(FOLDER), version_base=None):
        config = compose(recipe, ["preset=mlp"] if recipe == "dqn" else [])
    updater = target_updater(config.target, loss) if recipe == "dqn" else NoUpdater()
    optimizer = Still(loss.parameters(), lr=1e-3)
    with waits(monkeypatch) as seen:
        gradient_step(loss, optimizer, batch, 10.0)
        updater.step()
    assert seen == WAITS.get(choice, [])


def loss_and_rows(recipe, choice, place="cpu"):
    """A loss with its parts on ``place``, and rows that a copy of it on the CPU would keep."""
    preset = ["preset=mlp"] if recipe == "dqn" else []
    with initialize_config_dir(str(FOLDER), version_base=None):
        config = compose(recipe, [choice, *preset, *NETWORK.get(choice, ["network.hidden=[8]"])])
    scenario = paper_scenario(horizon=20, substrate={"nodes": 4})
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=config.one_hot))
    loss = make_loss(config.loss, instantiate(config.network), sizes)
    env = NFVEnv(scenario, 1, one_hot=config.one_hot, observations=q_network(loss).observations())
    rows = some_rows(loss, env, steps=config.collector.steps)
    if place != "cpu":
        with torch.device(place):
            loss = make_loss(config.loss, instantiate(config.network), sizes)
    return loss, rows


@pytest.mark.parametrize(("recipe", "choice"), [pair for pair in LOSSES if pair[1] not in WAITS])
def test_an_update_stays_where_the_loss_is(recipe, choice):
    """On a device that knows shapes and no numbers, and refuses tensors of another place, as a GPU does."""
    loss, rows = loss_and_rows(recipe, choice, "meta")
    learned = gradient_step(loss, Still(loss.parameters(), lr=1e-3), rows.to("meta"), 10.0)
    assert {value.device.type for value in learned.values()} == {"meta"}
    assert {part.device.type for part in (*loss.actor.parameters(), *loss.actor.buffers())} == {"meta"}


@pytest.mark.parametrize(("recipe", "choice"), LOSSES)
def test_a_copy_that_moves_takes_its_actor_along(recipe, choice):
    """The recipe tries things on a copy that it brings to the CPU; in place of a GPU, a copy of another dtype."""
    loss, _ = loss_and_rows(recipe, choice)
    moved = copy.deepcopy(loss).to(torch.float64)
    parts = [*moved.actor.parameters(), *moved.actor.buffers()]
    assert {part.dtype for part in parts if part.is_floating_point()} == {torch.float64}
    assert {part.dtype for part in loss.actor.parameters()} == {torch.float32}


def test_waiting_is_seen(monkeypatch):
    with waits(monkeypatch) as seen:
        one = torch.ones(1)
        assert float(one) == 1 and one
        one.cpu()
        one.tolist()
    assert seen == ["item", "item", "cpu", "tolist"]


UNIFORM = {"_target_": "torchrl.data.RandomSampler"}
PRIORITIZED = {"_target_": "torchrl.data.PrioritizedSampler", "alpha": 0.6, "beta": 0.4}


def parts(sampler, **storage):
    return {
        "storage": {"_target_": "torchrl.data.LazyTensorStorage", **storage},
        "sampler": sampler,
        "writer": {"_target_": "torchrl.data.TensorDictRoundRobinWriter"},
    }


@pytest.mark.parametrize(("place", "learner", "pinned"), [("cpu", "cuda", True), ("cpu", "cpu", False)])
def test_batches_on_their_way_to_a_gpu_are_pinned(place, learner, pinned):
    buffer = make_buffer(parts(UNIFORM, device=place), size=4, batch_size=2, device=learner)
    assert buffer._pin_memory is pinned


@pytest.mark.parametrize(("trees", "place"), [(False, "cpu"), (True, "cuda")])
def test_items_drawn_by_priority_are_where_torchrl_has_its_trees(trees, place, monkeypatch):
    """PyPI's wheel has none on a GPU: ``dqn.py buffer=prioritized device=cuda`` ended at its first update."""
    if trees:
        monkeypatch.setattr(_torchrl, "CudaSumSegmentTreeFp32", object(), raising=False)
    else:
        monkeypatch.delattr(_torchrl, "CudaSumSegmentTreeFp32", raising=False)
    buffer = make_buffer(parts(PRIORITIZED), size=4, batch_size=2, device="cuda:0")
    assert (buffer._storage.device.type, buffer._pin_memory) == (place, place == "cpu")


@pytest.mark.parametrize(
    ("place", "message"),
    [("nowhere", "cannot be used here"), (None, "cannot be used here"), ("cuda:0", "no trees of priorities")],
)
def test_a_place_that_cannot_hold_the_items_is_refused(place, message, monkeypatch):
    monkeypatch.delattr(_torchrl, "CudaSumSegmentTreeFp32", raising=False)
    if place == "cuda:0":  # as on a machine that has one
        monkeypatch.setattr(replay, "check_device", lambda key, name, remedy: torch.device(name))
    with pytest.raises(ScenarioError, match=f"buffer.storage.device: .*{message}.*leave that key out"):
        make_buffer(parts(PRIORITIZED, device=place), size=4, batch_size=2, device="cpu")
