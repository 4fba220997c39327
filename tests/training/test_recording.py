"""Recorded datasets: without pickle, every file checked, and a user's folder left alone."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
import torch

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.methods import RandomMethod
from nfv_torchrl.observations import CandidateObservation, RequestObservation
from nfv_torchrl.observations.graph import GraphObservation
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.training.recording import Dataset

ORIGIN = {"method": "random", "scenario": {"nodes": 4}}


def dataset(folder, parts=("request", "candidates", "graph"), origin=None, frames=30) -> Dataset:
    scenario = paper_scenario(nodes=4, seed=1, horizon=10, arrival_rate=2)
    kinds = {"request": RequestObservation, "candidates": CandidateObservation, "graph": GraphObservation}
    env = NFVEnv(scenario, 2, observations=[kinds[name]() for name in parts])
    return Dataset(folder, origin or ORIGIN, env, frames=frames, steps=8)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "data"
    dataset(folder).record(RandomMethod(), lambda steps: None)
    return folder


@pytest.fixture
def copy(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "data")


def test_what_was_recorded_is_read_again(recorded):
    read = dataset(recorded)
    assert read.complete
    (first, second) = read.parts()  # 30 frames are two parts of 2 x 8
    assert first.shape == second.shape == (2, 8)
    going = ~first["next", "done"][:, :-1, 0]
    after, before = first["next", "candidates", "features"][:, :-1], first["candidates", "features"][:, 1:]
    assert torch.equal(after[going], before[going])
    assert first["candidates", "action"].dtype == torch.int64
    assert not [path for path in recorded.rglob("*") if path.is_file() and path.suffix not in (".npy", ".json")]


def test_a_network_that_reads_less_reads_the_same_files(recorded):
    (part, _) = dataset(recorded, parts=("request",)).parts()
    assert "candidates" not in part


def test_an_interrupted_recording_is_recorded_anew(copy):
    (copy / "dataset.json").unlink()
    (copy / ".part_0001.partial").mkdir()
    (copy / "part_0007").mkdir()
    again = dataset(copy)
    assert not again.complete
    again.record(RandomMethod(), lambda steps: None)
    assert sorted(path.name for path in copy.iterdir()) == ["dataset.json", "part_0000", "part_0001"]
    dataset(copy).check()


def array(name, change):
    """A change of one array of the second part."""

    def write(folder):
        path = folder / "part_0001" / f"{name}.npy"
        values = np.load(path)
        changed = change(values)
        np.save(path, values if changed is None else changed)

    return write


def set_all(value):
    return lambda values: values.fill(value)


def forbid(values):
    values[:] = False
    values[..., 0] = True


def reject_all(folder):
    for name, value in (("next.request_done", True), ("next.outcome.accepted", False), ("next.outcome.reason", -1)):
        array(name, set_all(value))(folder)


class Payload:
    """Pickled, it makes a folder."""

    def __init__(self, path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def objects(folder):
    payload = np.array([Payload(folder.parent / "canary")], dtype=object)
    np.save(folder / "part_0001" / "action.npy", payload, allow_pickle=True)


def archive(folder):
    path = folder / "part_0001" / "action.npy"
    values = np.load(path)
    with path.open("wb") as file:
        np.savez(file, values)


def pipe(folder):
    path = folder / "part_0001" / "action.npy"
    path.unlink()
    os.mkfifo(path)


def cut(folder):
    path = folder / "part_0001" / "observation.npy"
    path.write_bytes(path.read_bytes()[:-8])


def huge(folder):
    """A header that claims 8 TB."""
    path = folder / "part_0001" / "action.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<i8", "fortran_order": False, "shape": (10**6, 10**6)})


def flags(folder):
    """Bytes of 7 where true is 1."""
    path = folder / "part_0001" / "action_mask.npy"
    data = bytearray(path.read_bytes())
    data[-1] = 7
    path.write_bytes(data)


HOSTILE = {
    "an action that is none": array("action", set_all(10**9)),
    "a negative action": array("action", set_all(-1)),
    "an action of another kind": array("action", lambda values: values.astype(np.float64)),
    "actions that the mask forbids": array("action_mask", forbid),
    "a state without actions": array("next.action_mask", set_all(False)),
    "a candidate that is none": array("candidates.action", set_all(10**6)),
    "a candidate that is none, afterwards": array("next.candidates.action", set_all(-5)),
    "a service that is none": array("request.service", set_all(99)),
    "a node that is none": array("request.node", set_all(-1)),
    "an end of a link that is none": array("graph.link_ends", set_all(4)),
    "a reason that is none": array("next.outcome.reason", set_all(7)),
    "a service in the sums": array("next.outcome.service", set_all(2**40)),
    "rejected without a reason": reject_all,
    "a reward that is no number": array("next.reward", set_all(np.nan)),
    "an infinite observation": array("observation", set_all(-np.inf)),
    "another shape": array("observation", lambda values: values[:, :1]),
    "one number for all": array("observation", lambda values: values[:1, :1, :1]),
    "other bytes": flags,
    "pickled objects": objects,
    "an archive": archive,
    "a pipe": pipe,
    "half a file": cut,
    "a header of 8 TB": huge,
    "no array": lambda folder: (folder / "part_0001" / "action.npy").write_text("import os"),
    "a missing array": lambda folder: (folder / "part_0001" / "next.done.npy").unlink(),
    "a missing part": lambda folder: shutil.rmtree(folder / "part_0001"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_cannot_have_been_recorded_is_refused(copy, name):
    HOSTILE[name](copy)
    with pytest.raises(ScenarioError, match=r"^dataset: ") as error:
        dataset(copy).check()
    assert str(copy) in str(error.value) and "\n" not in str(error.value)
    assert not (copy.parent / "canary").exists()


def manifest(folder, **changes):
    path = folder / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: manifest(folder, format=1), "format"),
        (lambda folder: manifest(folder, parts=10**9), "parts"),
        (lambda folder: manifest(folder, origin={"method": "random"}), "another scenario"),
        (lambda folder: manifest(folder, origin=[]), "format"),
        (lambda folder: manifest(folder, arrays={}), "lacks 'action'"),
        (lambda folder: manifest(folder, arrays=7), "format"),
        (lambda folder: (folder / "dataset.json").write_text("{"), "JSON"),
        (lambda folder: (folder / "dataset.json").write_text("[" * 100_000), "JSON"),
        (lambda folder: (folder / "dataset.json").write_bytes(b" " * (10**7 + 1)), "too large"),
        # Of an earlier version: its meta.json could name a pickle.
        (lambda folder: (folder / "part_0000" / "meta.json").write_text("{}"), "record it again"),
        (lambda folder: (folder / "dataset.json").write_text('{"method": "random"}'), "record it again"),
    ],
)
def test_manifests(copy, change, words):
    change(copy)
    with pytest.raises(ScenarioError, match=words) as error:
        dataset(copy)
    assert str(copy) in str(error.value) and "\n" not in str(error.value)


def test_another_recording_is_named(recorded):
    for settings, words in (({"origin": {**ORIGIN, "method": "x"}}, "another method"), ({"frames": 90}, "parts")):
        with pytest.raises(ScenarioError, match=words):
            dataset(recorded, **settings)


@pytest.mark.parametrize("name", ["thesis.tex", "part_0000.txt", "part_1", "part_0000/photo.jpg", ".git/config"])
def test_a_folder_of_the_users_is_left_alone(tmp_path, name):
    path = tmp_path / "mine" / name
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    with pytest.raises(ScenarioError, match="which no recording has"):
        dataset(tmp_path / "mine")
    assert path.read_text() == "mine"
    with pytest.raises(ScenarioError, match="is a file"):
        dataset(path)


def test_a_disk_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(ScenarioError, match="No space left"):
        dataset(tmp_path / "data").record(RandomMethod(), lambda steps: None)
    assert not dataset(tmp_path / "data").complete
