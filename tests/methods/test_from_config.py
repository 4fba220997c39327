"""Methods are made of their targets in a yaml, and each has a name that is a folder of its own."""

from __future__ import annotations

import pkgutil

import numpy as np
import pytest

from nfv_torchrl import methods
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import methods_from_config
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator.reasons import Reason


class RejectAll:
    """A user's own method."""

    name, decides_admission, mask, one_hot = "reject_all", True, None, False

    def __init__(self, scenario=None):
        self.scenario = scenario

    def prepare(self, simulator, seeds):
        pass

    def act(self, simulator):
        return np.full(simulator.batch_size, simulator.num_actions - 1)


def test_methods_come_from_their_targets():
    scenario = paper_scenario(6, 0, horizon=2)
    own = f"{__name__}.RejectAll"
    first, second = methods_from_config(
        {
            "a": {"_target_": "nfv_torchrl.methods.RandomMethod"},
            "b": {"_target_": own, "_partial_": True},
        },
        scenario,
    )
    assert first.name == "random" and second.scenario is scenario
    (record,) = run_method(scenario, second, [0])
    assert set(record.reason) == {Reason.REJECTED_BY_POLICY}
    for config, problem in (
        ({}, "names no method"),
        ({"a": {"name": "x"}}, "give _target_"),
        ({"a": {"_target_": "builtins.dict"}}, "dict lacks 'name'"),
        ({"a": {"_target_": own}, "b": {"_target_": own}}, "is called 'reject_all' too"),
    ):
        with pytest.raises(ScenarioError, match=problem):
            methods_from_config(config, scenario)


@pytest.mark.parametrize("name", ["a/b", "", ".hidden", " blank", "summary.csv", "Summary.CSV", "x" * 101, "tab\t", 3])
def test_names_that_are_no_folder_of_their_own(name):
    entry = {"_target_": "nfv_torchrl.methods.RandomMethod", "name": name}
    with pytest.raises(ScenarioError, match=r"method\.mine\.name"):
        methods_from_config({"mine": entry}, paper_scenario(6, 0, horizon=2))


@pytest.mark.parametrize(
    "former",
    [
        "nfv_torchrl.evaluation.methods.PlannerMethod",
        "nfv_torchrl.evaluation.methods.PolicyMethod",
        "nfv_torchrl.evaluation.methods.RandomMethod",
        "nfv_torchrl.evaluation.methods.methods_from_config",
        "nfv_torchrl.evolution.CandidatePolicy",
        "nfv_torchrl.evolution.PricePolicy",
        "nfv_torchrl.training.policies.load_policy",
        "nfv_torchrl.training.policies.save_policy",
    ],
)
def test_former_names_mean_the_same(former):
    """Scripts and settings of users may have them."""
    assert pkgutil.resolve_name(former) is getattr(methods, former.rpartition(".")[2])
