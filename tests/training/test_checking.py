"""Checkpoints that a stranger made, on resume: compared with the run before anything of them is loaded."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torchrl.checkpoint import GlobalRNGState
from torchrl.objectives import HardUpdate

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evolution import Strategy
from nfv_torchrl.losses import DQN
from nfv_torchrl.networks import MLPNetwork, Sizes
from nfv_torchrl.training.checking import check_parts, load_part
from nfv_torchrl.training.checkpoint import CheckpointFolder
from nfv_torchrl.training.progress import Progress
from nfv_torchrl.training.run import RunFolder
from nfv_torchrl.training.window import TrainingWindow

SIZES = Sizes(observation=3, actions=2, services=2, candidate_features=0)


def parts(kind=torch.optim.Adam) -> dict:
    """The parts of a run that has learnt once."""
    loss = DQN(lambda sizes: MLPNetwork(sizes, hidden=[4]), SIZES)
    optimizer = kind(loss.parameters(), lr=0.01)
    for parameter in loss.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    updater = HardUpdate(loss, value_network_update_interval=5)
    updater.step()
    return {
        "loss": loss,
        "optimizer": optimizer,
        "updater": updater,
        "window": TrainingWindow(("a", "b")),
        "progress": Progress(),
        "rng": GlobalRNGState(),
    }


def content(state: dict) -> dict:
    """What its checkpoint holds."""
    kept = {name: part.state_dict() for name, part in state.items()}
    for name in ("loss", "window"):
        kept[name] = {key: value.detach().clone() for key, value in kept[name].items()}
    return kept


@pytest.mark.parametrize("kind", [torch.optim.Adam, torch.optim.AdamW, torch.optim.SGD, torch.optim.RMSprop])
def test_its_own_checkpoint_passes(kind):
    there = content(parts(kind))
    here = parts(kind)
    check_parts("c.pt", there, here)
    for name, part in here.items():
        load_part("c.pt", name, part, there[name])
    fresh = {**here, "optimizer": kind(here["loss"].parameters(), lr=0.01)}  # as a resumed run has it
    check_parts("c.pt", there, fresh)


def first(mapping):
    return next(iter(mapping))


def weight(there):
    return first(there["loss"])


def moments(there):
    return there["optimizer"]["state"][0]


def words(there):
    return there["rng"]["numpy"]


HOSTILE = {
    "a shape": lambda c: c["loss"].update({weight(c): torch.zeros(1)}),
    "not finite": lambda c: c["loss"][weight(c)].fill_(float("inf")),
    "a key too few": lambda c: c["loss"].pop(weight(c)),
    "a key too many": lambda c: c["loss"].update(more=torch.zeros(1)),
    "a list": lambda c: c.update(loss=[1]),
    "no loss": lambda c: c.pop("loss"),
    "no random numbers": lambda c: c.pop("rng"),
    "a moment's shape": lambda c: moments(c).update(exp_avg=torch.zeros(())),
    "a moment's kind": lambda c: moments(c).update(exp_avg_sq="large"),
    "a moment not finite": lambda c: moments(c)["exp_avg"].fill_(float("nan")),
    "a moment too few": lambda c: moments(c).pop("exp_avg"),
    "a moment too many": lambda c: moments(c).update(max_exp_avg_sq=torch.zeros(4, 3)),
    "steps of each weight": lambda c: moments(c).update(step=torch.zeros(4, 3)),
    "a parameter too many": lambda c: c["optimizer"]["state"].update({99: moments(c)}),
    "a parameter's name": lambda c: c["optimizer"]["state"].update({"0": moments(c)}),
    "a learning rate": lambda c: c["optimizer"]["param_groups"][0].update(lr=1e9),
    "a learning rate's kind": lambda c: c["optimizer"]["param_groups"][0].update(lr=torch.ones(2)),
    "a flag": lambda c: c["optimizer"]["param_groups"][0].update(capturable=True),
    "no groups": lambda c: c["optimizer"].pop("param_groups"),
    "a counter": lambda c: c["updater"].update(counter="many"),
    "sums": lambda c: c["window"].update(sums=torch.zeros(3)),
    "frames": lambda c: c["progress"].update(frames=2.5),
    "a flag for a number": lambda c: c["progress"].update(frames=True),
    "random numbers outside their words": lambda c: c["rng"].update(numpy=(*words(c)[:2], 10**6, *words(c)[3:])),
    "too few of them": lambda c: c["rng"].update(numpy=(words(c)[0], torch.zeros(3).long(), *words(c)[2:])),
    "another generator": lambda c: c["rng"].update(numpy=("PCG64", *words(c)[1:])),
    "no generator": lambda c: c["rng"].update(numpy=None),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_not_of_this_run_is_refused_before_it_is_loaded(name):
    there, here = content(parts()), parts()
    HOSTILE[name](there)
    with pytest.raises(CheckpointError, match=r"^c\.pt[ :]") as error:
        check_parts("c.pt", there, here)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("rng", {"python": (3, (1, 2), None)}),
        ("rng", {**GlobalRNGState().state_dict(), "torch_cpu": torch.zeros(7, dtype=torch.uint8)}),
        ("rng", {**GlobalRNGState().state_dict(), "python": (3, (*range(624), 9_999), None)}),
        ("strategy", {"fitness": [[1.0]]}),
        ("strategy", {"fitness": [[1.0, 2.0, 3.0, float("nan")]]}),
        ("strategy", {"fitness": [["a", "b", "c", "d"]]}),
        ("strategy", {"fitness": 3}),
        ("strategy", {}),
    ],
)
def test_what_readers_refuse_is_one_line_too(name, state):
    part = {"rng": GlobalRNGState(), "strategy": Strategy([0.0, 1.0], population=4)}[name]
    before = GlobalRNGState().state_dict()
    with pytest.raises(CheckpointError, match=rf"^c\.pt: {name}") as error:
        load_part("c.pt", name, part, state)
    GlobalRNGState().load_state_dict(before)
    assert "\n" not in str(error.value)


def test_the_config_in_a_checkpoint_is_compared_and_never_built(tmp_path):
    config = {"network": {"_target_": "nfv_torchrl.networks.MLPNetwork"}, "seed": 0}
    checkpoints = CheckpointFolder(tmp_path / "run", keep=1)
    again = SimpleNamespace(resume=True, checkpoints=checkpoints, config=config, path=tmp_path / "run", inputs={})
    for kept, said in (
        ({"network": {"_target_": "os.mkdir", "path": str(tmp_path / "canary")}, "seed": 0}, "network._target_"),
        ({"network": "${oc.create:{_target_: os.mkdir}}", "seed": 0}, "network"),
        (7, "config"),
        (None, "config"),
        ({"network": config["network"], "seed": torch.ones(2)}, "a config that no recipe has"),
    ):
        checkpoints.save(1, {"config": kept, "inputs": {}, "progress": Progress().state_dict()})
        with pytest.raises(CheckpointError, match=said):
            RunFolder.load(again, {"progress": Progress()})
    assert not (tmp_path / "canary").exists()
