"""Training cells: under any path, once, and of the files that they were asked for."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from forked import ForkedTraining
from tiny import ROOT, TINY_SCENARIO

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.experiments import training, work
from nfv_torchrl.experiments.cells import CellStore, make_cell
from nfv_torchrl.experiments.computing import compute
from nfv_torchrl.experiments.training import run_folder
from nfv_torchrl.folders import claim
from nfv_torchrl.parallel import Joblib
from nfv_torchrl.training.checkpoint import CheckpointFolder

WORLD = {"substrate": {"nodes": 5}, "horizon": 60, "arrival_rate": 4.0, "mean_lifetime": 40.0}
SMALL = ["collector.num_envs=2", "collector.steps=8", "eval.interval=2", "eval.seeds=[1000]", "network.hidden=[8]",
         "logger.figures=false", *TINY_SCENARIO]  # fmt: skip
ODD = "größe = 1, 'a' ${b} \\"
"""A folder's name with what Hydra, shells and TensorBoard could take for something else."""


def cell_of(*overrides: str, label: str = "train_größe=1, 'a'"):
    spec = {"recipe": "policy_gradient.py", "policy": "best.pt", "overrides": [*SMALL, *overrides], "scenario": WORLD}
    return make_cell("training", label, spec)


def test_under_a_path_with_anything_in_it(tmp_path, monkeypatch):
    """And a worker that is killed before it drops the checkpoints, or before it writes its cell, has lost nothing."""
    monkeypatch.setattr(training, "subprocess", SimpleNamespace(Popen=ForkedTraining))  # below is a real one
    store = CellStore(tmp_path / ODD, ROOT / "recipes")
    cell = cell_of("collector.total_frames=32")
    write = store.write
    monkeypatch.setattr(store, "write", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):  # killed when everything but the cell was there
        work.work(cell, store)
    checkpoints = CheckpointFolder(run_folder(cell, store))
    assert checkpoints.files() and not store.has(cell)
    monkeypatch.setattr(store, "write", write)
    monkeypatch.setattr(work, "drop_checkpoints", lambda *_: None)  # killed once more, later
    work.work(cell, store)
    log = run_folder(cell, store).with_suffix(".log").read_text()
    assert log.count("Resumed from") == 1 and "older run" not in log
    assert [point["frames"] for point in store.read(cell)["eval"]] == [0, 32]
    assert compute([cell], store, workers=Joblib(jobs=1)) == {} and not checkpoints.files()


def test_a_worker_told_to_stop_lets_its_recipe_save(tmp_path, monkeypatch):
    store = CellStore(tmp_path / ODD, ROOT / "recipes")
    cell = cell_of("collector.total_frames=1000000", "saving.interval=1")
    monkeypatch.setattr(training, "stopping", False)

    def stop_soon() -> None:
        while not CheckpointFolder(run_folder(cell, store)).files():  # the first one says that the loop is at work
            time.sleep(0.1)
        training.stop(signal.SIGTERM, None)

    threading.Thread(target=stop_soon, daemon=True).start()
    with pytest.raises(training.TrainingStopped, match="interrupted and saved"):
        work.work(cell, store)
    assert CheckpointFolder(run_folder(cell, store)).files() and not store.has(cell)
    with pytest.raises(training.TrainingStopped, match="did not begin"):
        work.work(cell, store)


def test_a_recipe_that_outlives_its_worker_is_waited_for(tmp_path):
    lock = claim("run_dir", tmp_path / "run", "run")
    threading.Timer(0.3, lock.release).start()
    begun = time.monotonic()
    training._wait_for(tmp_path / "run")
    assert 0.2 < time.monotonic() - begun < 10


def test_the_content_of_files_makes_the_cell(tmp_path, monkeypatch):
    net, policy = tmp_path / "net.json", tmp_path / "best.pt"
    net.write_text("a")
    policy.write_text("b")
    specs = [
        {"scenario": {"substrate": {"path": str(net)}}},
        {"overrides": [f"scenario.substrate.path={net}"]},
        {"method": {"path": str(policy)}},
        {"overrides": [f"+init_from='{policy}'"]},
    ]
    before = [make_cell("bound", "x", spec).key for spec in specs]
    assert before == [make_cell("bound", "x", spec).key for spec in specs]
    net.write_text("c")
    policy.write_text("d")
    assert not set(before) & {make_cell("bound", "x", spec).key for spec in specs}
    # Names of what ships, and a scenario of no file, are as they were: their cells are still found.
    assert "files" not in make_cell("bound", "x", {"scenario": {"substrate": {"path": "nsfnet"}}}).spec

    def changes_meanwhile(cell, store):
        net.write_text("e")
        return {}

    monkeypatch.setitem(work.WORK, "bound", changes_meanwhile)
    store = CellStore(tmp_path / "out")
    cell = make_cell("bound", "x", specs[0])
    with pytest.raises(ScenarioError, match=r"scenario\.substrate\.path: the file was changed"):
        work.work(cell, store)
    assert not store.has(cell)


@pytest.mark.parametrize("label", ["../../x", "/x", "a b", "größe", "x" * 300])
def test_a_label_stays_inside_the_output(label, tmp_path):
    path = CellStore(tmp_path).path(make_cell("bound", label, {}))
    assert path.parent == tmp_path / "cells" and path.name.isascii() and len(path.name) < 110
    assert Path(path.name).name == path.name and " " not in path.name
