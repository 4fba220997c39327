"""Learning across requests through the recipe: the preset, every loss, and a start from trained weights."""

from __future__ import annotations

import pytest
import torch
from inprocess import call
from tiny import TINY_SCENARIO, TINY_TRAINING

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import load_policy
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.tensor_files import load_file
from nfv_torchrl.training.checkpoint import CheckpointFolder

PRESET = ["preset=across_requests", "network.hidden=[8]", *TINY_TRAINING, "eval.interval=6", "saving.interval=3"]
LOSSES = ["slot_discount", "centred", "differential"]


def train(folder, *overrides):
    call("dqn", f"run_dir={folder}", *TINY_SCENARIO, "scenario.colocation=true", *PRESET, *overrides)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Runs of 192 frames, one for each loss."""
    folder = tmp_path_factory.mktemp("across")
    for loss in LOSSES:
        train(folder / loss, f"loss={loss}", "collector.total_frames=192")
    return folder


@pytest.mark.parametrize("loss", LOSSES)
def test_it_trains_resumes_to_the_bit_and_loads(loss, trained, tmp_path):
    folder = trained / loss
    whole = load_file(CheckpointFolder(folder).files()[-1])
    assert whole["loss"]["rate"].abs().sum() > 0  # it has seen requests end
    CheckpointFolder(folder).files()[-1].unlink()
    train(folder, f"loss={loss}", "collector.total_frames=192", "resume=true")
    again = load_file(CheckpointFolder(folder).files()[-1])
    for key, value in whole["loss"].items():
        assert torch.equal(value, again["loss"][key]), key
        assert torch.isfinite(value).all()
    scenario = Scenario.from_config(whole["config"]["scenario"])
    assert scenario.admission_control and scenario.mask == "feasible"
    record = run_method(scenario, load_policy(folder / "best.pt", scenario), [1000])[0]
    assert len(record.accepted) == len(scenario.workload(1000))


def test_a_run_begins_with_the_weights_of_a_policy_file(trained, tmp_path):
    start = trained / "centred" / "best.pt"
    folder = tmp_path / "run"
    # No update: the first checkpoint still has what it began with.
    train(folder, "loss=double_dqn", f"init_from={start}", "collector.total_frames=32", "buffer.warmup_frames=64")
    found = load_file(CheckpointFolder(folder).files()[-1])["loss"]
    given = load_file(start)["weights"]
    for name in ("layers.0.weight", "layers.0.bias", "layers.2.weight", "layers.2.bias"):
        copies = [value for key, value in found.items() if key.endswith(name)]
        assert len(copies) == 2  # online and target
        for copy in copies:
            assert torch.equal(copy, given[f"value_network_params.{name}"])


def test_weights_that_a_run_begins_with_stay_the_best_where_training_makes_them_no_better(trained, tmp_path):
    start = trained / "centred" / "best.pt"
    folder = tmp_path / "run"
    still = "learner.lr=1e-12"  # it decides as it did
    train(folder, "loss=centred", f"init_from={start}", "collector.total_frames=64", still)
    progress = load_file(CheckpointFolder(folder).files()[-1])["progress"]
    best, given = (load_file(path) for path in (folder / "best.pt", start))
    assert progress["frames"] >= 64 and progress["best_frames"] == 0
    assert progress["best_aar"] == best["scores"]["aar"]
    for name, value in best["weights"].items():
        if name.startswith("value_network_params"):
            assert torch.equal(value, given["weights"][name]), name


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["network.hidden=[9]"], ["layers.0.weight [9, 22]", "[8, 22]", "network="]),
        (["network=mlp"], ["layers.0.weight", "network="]),
    ],
)
def test_weights_of_another_network_are_refused(overrides, words, trained, tmp_path, capsys):
    start = trained / "centred" / "best.pt"
    with pytest.raises(SystemExit):
        train(tmp_path / "run", f"init_from={start}", "collector.total_frames=32", *overrides)
    said = capsys.readouterr().err
    for word in (str(start), *words):
        assert word in said
    assert not (tmp_path / "run").exists()
