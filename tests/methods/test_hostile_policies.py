"""Policy files that a stranger made: each is refused in one line that names the file, and none runs anything."""

from __future__ import annotations

import io
import os
import pickle
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import ROOT

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN
from nfv_torchrl.methods import load_policy, load_weights, policy_content, save_policy
from nfv_torchrl.methods.building import CLASSES
from nfv_torchrl.methods.policy_file import FORMAT, KINDS
from nfv_torchrl.networks import CandidateNetwork, Sizes
from nfv_torchrl.scenario import Scenario, paper_scenario
from nfv_torchrl.simulator import Simulator

SCENARIO = paper_scenario(nodes=4, seed=1, horizon=10, arrival_rate=2)
PARTS = {
    "network": {"_target_": "nfv_torchrl.networks.CandidateNetwork", "_partial_": True, "hidden": [4]},
    "loss": {"_target_": "nfv_torchrl.losses.DQN", "gamma": 0.9},
}


def honest() -> dict:
    """What ``save_policy`` would write for a network that has learnt nothing."""
    sizes = Sizes.of(Simulator(SCENARIO, 1, one_hot=False))
    loss = DQN(lambda sizes: CandidateNetwork(sizes, hidden=[4]), sizes, gamma=0.9)
    content = policy_content(loss, sizes, PARTS, SCENARIO, {"aar": 0.5})
    content["network"], content["loss"] = dict(PARTS["network"], hidden=[4]), dict(PARTS["loss"])
    return content


def of_kind(kind: str) -> dict:
    """An honest file that says it is of another kind, with the parts of that kind."""
    content = {**honest(), "kind": kind}
    if kind == "planner":
        content["planner"] = {"_target_": "nfv_torchrl.nfvdeep.NFVdeepPlanner"}
    if kind == "evolved":
        content |= {"loss": {}, "policy": {"_target_": "nfv_torchrl.methods.CandidatePolicy"}}
    return content


WEIGHT = next(key for key in honest()["weights"] if key.endswith("layers.0.weight"))


class Payload:
    """Pickled, it makes the file that must not be there."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self):
        return os.mkdir, (str(self.canary),)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with ``victim``, which must stay, and without ``canary``, which must not appear; a package of a user."""
    (tmp_path / "victim").write_text("stays")
    (tmp_path / "payload.npy").write_bytes(npy_with_objects(tmp_path / "canary"))
    (tmp_path / "payload.pt").write_bytes(pickle.dumps(Payload(tmp_path / "canary")))
    for package in ("their_pkg", "their_pkg_two"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("")
        (tmp_path / package / "nets.py").write_text(
            "import os\nfrom pathlib import Path\nimport torch\n"
            "from torch import nn\nfrom nfv_torchrl.networks import CandidateNetwork\n"
            "class Mine(CandidateNetwork):\n    pass\n"
            "class Cleaner:\n    def __init__(self, path):\n        os.remove(path)\n"
            "def clean(path):\n    os.remove(path)\n"
        )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("their_pkg")]:
        del sys.modules[name]
    assert (tmp_path / "victim").read_text() == "stays"
    assert not (tmp_path / "canary").exists()


def npy_with_objects(canary: Path) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([Payload(canary)], dtype=object), allow_pickle=True)
    return file.getvalue()


def refused(path: Path, trusted=(), match=None) -> None:
    with pytest.raises(CheckpointError, match=match) as error:
        load_policy(path, SCENARIO, trusted_packages=trusted)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_an_honest_file_loads_and_decides(place):
    save_policy(place / "best.pt", honest())
    records = run_method(SCENARIO, load_policy(place / "best.pt", SCENARIO), [3])
    assert records[0].num_requests > 0


CALLS = {
    "a private function": ("nfv_torchrl.experiments.training._run", {"command": ["touch", "CANARY"], "log": "CANARY"}),
    "a method of a module's import": ("nfv_torchrl.files.Path.unlink", {"self": "VICTIM"}),
    "positional": ("nfv_torchrl.files.Path.unlink", {"_args_": ["VICTIM"]}),
    "a public function": ("nfv_torchrl.files.write_atomically", {"path": "CANARY", "content": "x"}),
    "pickle by numpy": ("nfv_torchrl.scenario.config.np.load", {"file": "NPY", "allow_pickle": True}),
    "pickle by torch": ("nfv_torchrl.tensor_files.torch.load", {"f": "PT", "weights_only": False}),
    "trust of its own": (
        "nfv_torchrl.methods.load_policy",
        {"path": "PT", "scenario": None, "trusted_packages": ["os", "builtins"]},
    ),
    "hydra again": (
        "nfv_torchrl.methods.from_config.instantiate",
        {"config": {"_target_": "os.mkdir", "path": "CANARY"}},
    ),
    "a shell": ("os.system", {"command": "touch CANARY"}),
    "a shell by attributes": ("nfv_torchrl.files.os.system", {"command": "touch CANARY"}),
    "a builtin": ("builtins.eval", {"source": "1"}),
    "no module": ("eval", {}),
    "a folder of ours": ("nfv_torchrl.training.run.RunFolder", {"path": "CANARY", "config": {}}),
    "a class of another kind": ("nfv_torchrl.nfvdeep.NFVdeepPlanner", {}),
    "an abstract class": ("nfv_torchrl.losses.MaskedLoss", {}),
    "a class by attributes": ("nfv_torchrl.losses.dqn.DQN.__class__", {}),
    "a method of a class": ("nfv_torchrl.losses.DQN.from_module", {}),
    "nothing": ("", {}),
    "a number": (7, {}),
    "interpolation": ("${oc.env:HOME}", {}),
}


@pytest.mark.parametrize("part", ["network", "loss", "planner", "policy"])
@pytest.mark.parametrize("name", CALLS)
def test_targets_outside_the_list(place, part, name):
    target, arguments = CALLS[name]
    if part == "planner" and name == "a class of another kind":
        target = "nfv_torchrl.planners.milp.MilpPlanner"
    content = of_kind({"planner": "planner", "policy": "evolved"}.get(part, "actor"))
    content[part] = {"_target_": target, **fill(arguments, place)}
    save_policy(place / "best.pt", content)
    refused(place / "best.pt")
    refused(place / "best.pt", trusted=["nfv_torchrl"])


def fill(value, place: Path):
    """The arguments of a case with the paths of its folder."""
    names = {"CANARY": "canary", "VICTIM": "victim", "NPY": "payload.npy", "PT": "payload.pt"}
    if isinstance(value, dict):
        return {key: fill(item, place) for key, item in value.items()}
    if isinstance(value, list):
        return [fill(item, place) for item in value]
    if isinstance(value, str):
        for word, name in names.items():
            value = value.replace(word, str(place / name))
    return value


MKDIR = {"_target_": "os.mkdir", "path": "CANARY"}
ARGUMENTS = {
    "a resolver that creates": {"hidden": "${oc.create:{_target_: os.mkdir}}"},
    "a resolver that reads": {"activation": "${oc.env:HOME}"},
    "one in a list": {"hidden": [4, "${oc.env:HOME}"]},
    "one in a key": {"${oc.env:HOME}": 1},
    "a nested target": {"hidden": MKDIR},
    "one in a list of lists": {"hidden": [[MKDIR]]},
    "one of the list": {"hidden": {"_target_": "nfv_torchrl.networks.CandidateNetwork"}},
    "_args_": {"_args_": [1]},
    "_convert_": {"_convert_": "all"},
    "_recursive_": {"_recursive_": True},
    "_partial_ that is no flag": {"_partial_": "yes"},
    "_partial_ false": {"_partial_": False},
    "_method_": {"_method_": "nfv_torchrl.files.write_atomically"},
    "a module of torch that is none": {"activation": "init"},
    "a base class": {"activation": "Module"},
    "a function": {"activation": "factory_kwargs"},
    "no such argument": {"depth": 3},
    "sizes of its own": {"sizes": [1, 2, 3, 4]},
    "a tuple": {"hidden": (4,)},
    "bytes": {"hidden": b"4"},
    "not a number": {"noisy": float("nan")},
    "infinite": {"outputs": float("inf")},
    "a number of 400 digits": {"outputs": 10**400},
    "a layer of 800 GB": {"hidden": [200_000_000_000]},
    "layers of 40 GB": {"hidden": [100_000, 100_000]},
    "a hundred thousand layers": {"hidden": [1] * 100_000},
    "negative layers": {"hidden": [-1]},
    "half a neuron": {"hidden": [1.5]},
    "words for layers": {"hidden": ["four"]},
    "lists in lists": {"hidden": [[[[[[[[[[4]]]]]]]]]]},
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_that_are_not_plain(place, name):
    content = honest()
    content["network"].update(fill(ARGUMENTS[name], place))
    save_policy(place / "best.pt", content)
    refused(place / "best.pt")


def test_a_list_that_holds_itself_twice_thirty_times(place):
    """A billion values from thirty lists."""
    value: list = [4]
    for _ in range(30):
        value = [value, value]
    content = honest()
    content["network"]["hidden"] = value
    save_policy(place / "best.pt", content)
    refused(place / "best.pt")


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("their_pkg.nets.Mine", None),
        ("their_pkg.nets.Cleaner", "no Module class"),
        ("their_pkg.nets.clean", "no Module class"),
        ("their_pkg.nets.Path", "no Module class"),
        ("their_pkg.nets.os.remove", "cannot be imported"),
        ("their_pkg.nets.nn.Linear", "cannot be imported"),
        ("their_pkg.nets.CandidateNetwork", "no Module class that their_pkg defines"),
        ("their_pkg.nets.Mine.__init__", "no name of a class"),
        ("their_pkg.__main__.Mine", "no name of a class"),
        ("their_pkg.nowhere.Mine", "cannot be imported"),
        ("their_pkg..nets.Mine", "no name of a class"),
        ("their_pkg_two.nets.Mine", "trusted_packages"),
        ("os.path.Path", "trusted_packages"),
    ],
)
def test_trust_is_in_classes_of_the_package(place, target, words):
    content = honest()
    content["network"]["_target_"] = target
    save_policy(place / "best.pt", content)
    refused(place / "best.pt", match="trusted_packages")
    refused(place / "best.pt", trusted=[""], match="trusted_packages")
    if words is None:
        load_policy(place / "best.pt", SCENARIO, trusted_packages=["their_pkg"])
        load_policy(place / "best.pt", SCENARIO, trusted_packages="their_pkg")
    else:
        refused(place / "best.pt", trusted=["their_pkg"], match=words)


def test_no_package_is_imported_without_trust(place):
    content = honest()
    content["network"]["_target_"] = "their_pkg.nets.Mine"
    save_policy(place / "best.pt", content)
    refused(place / "best.pt")
    assert "their_pkg" not in sys.modules


WEIGHTS = {
    "one number for all": lambda weights: weights.update({WEIGHT: torch.zeros(1)}),
    "another shape": lambda weights: weights.update({WEIGHT: weights[WEIGHT].T}),
    "missing": lambda weights: weights.pop(WEIGHT),
    "one more": lambda weights: weights.update({"more": torch.zeros(2)}),
    "float64": lambda weights: weights.update({WEIGHT: weights[WEIGHT].double()}),
    "whole numbers": lambda weights: weights.update({WEIGHT: weights[WEIGHT].long()}),
    "not a number": lambda weights: weights[WEIGHT].fill_(float("nan")),
    "infinite": lambda weights: weights[WEIGHT].view(-1)[3:4].fill_(float("-inf")),
    "a list": lambda weights: weights.update({WEIGHT: weights[WEIGHT].tolist()}),
    "no tensor": lambda weights: weights.update({WEIGHT: None}),
    "expanded": lambda weights: weights.update({WEIGHT: torch.zeros(1, 1).expand(weights[WEIGHT].shape)}),
    "sparse": lambda weights: weights.update({WEIGHT: weights[WEIGHT].to_sparse()}),
    "meta": lambda weights: weights.update({WEIGHT: weights[WEIGHT].to("meta")}),
    "a petabyte of one number": lambda weights: weights.update({WEIGHT: torch.zeros(1).expand(2**48)}),
    "complex": lambda weights: weights.update({WEIGHT: weights[WEIGHT].to(torch.complex64)}),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_weights_that_are_not_those_of_the_network(place, name):
    content = honest()
    WEIGHTS[name](content["weights"])
    save_policy(place / "best.pt", content)
    refused(place / "best.pt", match="more" if name == "one more" else "layers.0.weight")
    if name != "one more":  # which other losses may have beside the network's
        network = CandidateNetwork(Sizes.of(Simulator(SCENARIO, 1)), hidden=[4])
        before = {key: value.clone() for key, value in network.state_dict().items()}
        with pytest.raises(CheckpointError, match=r"layers\.0\.weight"):
            load_weights(network, place / "best.pt")
        assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())


@pytest.mark.parametrize("key", honest())
def test_every_entry_is_there_and_of_its_kind(place, key):
    for change in (lambda content: content.pop(key), lambda content: content.update({key: [1]})):
        content = honest()
        change(content)
        save_policy(place / "best.pt", content)
        refused(place / "best.pt", match=key)


NFVDEEP = {"kind": "planner", "planner": {"_target_": "nfv_torchrl.nfvdeep.NFVdeepPlanner"}}
PRICES = {"_target_": "nfv_torchrl.networks.prices.PriceNetwork", "price_unit": 1e12}  # prices could be infinite


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": 3}, "format"),
        ({"format": 1}, "has 'kind'"),
        ({"kind": "pickle"}, "kind is 'pickle'; it has to be one of actor, planner, evolved"),
        ({"kind": "planner"}, "planner names no class"),
        ({"kind": "evolved"}, "loss belongs to no policy of kind evolved"),
        ({"policy": {"_target_": "nfv_torchrl.methods.CandidatePolicy"}}, "policy belongs to no policy of kind actor"),
        ({"loss": {"_target_": "nfv_torchrl.methods.CandidatePolicy"}}, "none of this project's loss classes"),
        ({"format": torch.ones(2)}, "format"),
        ({"mask": "everything"}, "mask"),
        ({"mask": "${oc.env:HOME}"}, "mask"),
        ({"one_hot": 1}, "one_hot"),
        ({"sizes": {"observation": 1}}, "sizes lacks 'actions'"),
        ({"sizes": dict.fromkeys(Sizes._fields, 1.0)}, "sizes.observation"),
        ({"scores": {"aar": "high"}}, "scores.aar"),
        ({"scores": {1j: 2.0}}, "nested or named"),
        ({"weights": {}}, "no valid|lacks"),
        ({"more": 1}, "more"),
        ({**NFVDEEP, "planner": {**NFVDEEP["planner"], "route": "sea"}}, "planner.route"),
        ({**NFVDEEP, "planner": {**NFVDEEP["planner"], "actor": 3}}, "."),
        (
            {
                "kind": "evolved",
                "loss": {},
                "network": PRICES,
                "policy": {"_target_": "nfv_torchrl.methods.PricePolicy"},
            },
            "network.price_unit",
        ),
        ({"loss": {"_target_": "nfv_torchrl.losses.QuantileDQN", "quantiles": 2**40}}, "GB of memory would be needed"),
    ],
)
def test_entries_that_say_too_much(place, change, words):
    save_policy(place / "best.pt", {**honest(), **change})
    refused(place / "best.pt", match=words)


def test_a_training_checkpoint_is_no_policy(place):
    save_policy(place / "checkpoint_1.pt", {"loss": {}, "config": {}})
    refused(place / "checkpoint_1.pt", match="best.pt")


def test_pickled_payloads(place):
    content = honest()
    content["scores"] = Payload(place / "canary")
    torch.save(content, place / "zip.pt")
    torch.save(content, place / "legacy.pt", _use_new_zipfile_serialization=False)
    for name in ("zip.pt", "legacy.pt", "payload.pt", "payload.npy"):
        refused(place / name, match="not a checkpoint")


def repack(source: Path, target: Path, *, method=zipfile.ZIP_STORED, cut=None) -> None:
    """The archive again, compressed or without the end of its pickle."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", method) as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, data[:cut] if name.endswith("data.pkl") else data)


def test_archives(place):
    save_policy(place / "best.pt", honest())
    repack(place / "best.pt", place / "same.pt")
    load_policy(place / "same.pt", SCENARIO)
    repack(place / "best.pt", place / "bomb.pt", method=zipfile.ZIP_DEFLATED)
    refused(place / "bomb.pt", match="compressed")
    repack(place / "best.pt", place / "cut.pt", cut=-7)
    refused(place / "cut.pt", match="truncated")
    (place / "half.pt").write_bytes((place / "best.pt").read_bytes()[:-100])
    refused(place / "half.pt", match="truncated")
    with (place / "large.pt").open("wb") as file:
        file.truncate(2 * 10**9)  # takes no room on the disk
    refused(place / "large.pt", match="2.0 GB")
    os.mkfifo(place / "pipe.pt")
    for name in ("pipe.pt", "their_pkg", "nowhere.pt"):
        refused(place / name, match="no checkpoint")


def test_a_tuple_of_itself_as_a_key_does_not_hang(place):
    """Hashing a pair of a pair of ... of one object 60 times takes 2**60 steps."""
    pairs = b"".join(b"h%ch%c\x86q%c" % (depth, depth, depth + 1) for depth in range(60))
    with zipfile.ZipFile(place / "endless.pt", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02K\x01\x85q\x00" + pairs + b"}h%cK\x01s." % 60)
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
    refused(place / "endless.pt", match="tuples in tuples")


def test_a_tensor_that_claims_more_bytes_than_the_archive_has(place):
    torch.save({"a": torch.zeros(4)}, place / "a.pt")
    with zipfile.ZipFile(place / "a.pt") as old, zipfile.ZipFile(place / "b.pt", "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name.endswith("data.pkl"):
                assert data.count(b"K\x04tq") == 1  # 4 numbers in the storage
                data = data.replace(b"K\x04tq", b"J\x00\x00\x10\x00tq")
            new.writestr(name, data)
    refused(place / "b.pt", match="not a checkpoint")


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs" / "results" / "policies").glob("*.pt")), ids=lambda path: path.stem
)
def test_policies_of_the_docs_name_classes_of_the_list(path):
    content = torch.load(path, weights_only=True)
    assert content["format"] == FORMAT
    assert all(content[part]["_target_"] in CLASSES[part] for part in KINDS[content["kind"]])
    load_policy(path, chains() if content["scenario"] == "virne" else SCENARIO)


def chains() -> Scenario:
    """Chains that bring what they ask for, on a small network."""
    free = {"ingress": "any", "egress": "any"}
    return Scenario.from_config({
        "name": "virne", "horizon": None, "endpoints": "uniform", "placement": "distinct",
        "substrate": {"generator": {"_target_": "nfv_torchrl.scenario.waxman.draw_waxman", "nodes": 8, "beta": 1.0}},
        "resources": {"cpu": {"scales_with_rate": False}}, "vnfs": {"function": {"cpu": 10}},
        "services": {"chain": {"chain": ["function"], "rate": 25, "tolerable_delay": None, **free}},
        "workload": {"path": str(ROOT / "tests" / "scenario" / "requests" / "virne_laws.yaml")},
    })  # fmt: skip


def test_every_class_of_the_configs_is_in_the_list():
    """So that whatever the recipes train can be loaded again."""
    configs = ROOT / "recipes" / "config"
    groups_of = {"network": ["network"], "loss": ["loss", "pg_loss"], "policy": ["policy"]}
    for part, groups in groups_of.items():
        for group in groups:
            for path in (configs / group).glob("*.yaml"):
                lines = [line for line in path.read_text().splitlines() if "_target_:" in line]
                targets = [line.split("_target_:")[1].split()[0] for line in lines]
                # A config without one takes the class of the config that it begins with.
                assert targets or "\ndefaults: [" in path.read_text(), path
                assert set(targets) <= set(CLASSES[part]), path


def test_every_loss_of_the_package_may_be_built_and_nothing_else_of_its_modules():
    known = {each.__name__ for each in CLASSES["loss"].values()}
    assert {"DQN", "PPO", "RecurrentDQN", "SlotDiscountDQN"} <= known
    assert not known & {"MeanValue", "TwoNetworks", "StateValue", "Acting", "AtomsModule", "LossModule", "SACLoss"}


@pytest.mark.parametrize("services", [-1, 0, 2**40])
def test_a_number_of_services_that_cannot_be(services, tmp_path):
    """What knows no service types is built with as many as its file says, since its loss may count them."""
    content = torch.load(ROOT / "docs" / "results" / "policies" / "cnupb_lookahead_0.pt", weights_only=True)
    content["sizes"]["services"] = services
    torch.save(content, tmp_path / "best.pt")
    with pytest.raises(CheckpointError):
        load_policy(tmp_path / "best.pt", SCENARIO)
