"""``check_observation`` passes the project's parts and catches a planted fault of each kind."""

import pytest
import torch
from torchrl.data import Unbounded

from nfv_torchrl.observations import CandidateObservation, GraphObservation, RequestObservation
from nfv_torchrl.testing import check_observation


@pytest.mark.parametrize("part", [RequestObservation, CandidateObservation, GraphObservation])
def test_the_parts_of_the_project_pass(part):
    check_observation(part)


class Sound:
    """The use of every VM, as an array of its own."""

    def specs(self, simulator):
        return {"use": Unbounded((simulator.batch_size, self.width(simulator)), dtype=torch.float32)}

    def width(self, simulator):
        return simulator.world.seen.flat.shape[1]

    def read(self, simulator):
        return {"use": torch.from_numpy(simulator.world.seen.flat).clone()}


class GivesAwayTheSimulatorsArrays(Sound):
    def read(self, simulator):
        return {"use": torch.from_numpy(simulator.world.seen.flat)}


class WritesIntoTensorsItGaveAway(Sound):
    kept = None

    def read(self, simulator):
        now = super().read(simulator)["use"]
        if self.kept is None or self.kept.shape != now.shape:
            self.kept = now
        return {"use": self.kept.copy_(now)}


class HasAnotherShape(Sound):
    def width(self, simulator):
        return 1 + super().width(simulator)


class NamesAnotherKey(Sound):
    def read(self, simulator):
        return {"used": super().read(simulator)["use"]}


class IsNotFinite(Sound):
    def read(self, simulator):
        return {"use": super().read(simulator)["use"].log()}


class SpoilsTheSimulator(Sound):
    def read(self, simulator):
        simulator.world.ledger.vm_offered[0, 0, 0] -= 1
        return super().read(simulator)


class MixesEnvironments(Sound):
    def read(self, simulator):
        use = super().read(simulator)["use"]
        return {"use": use - use.mean(0)}


class CountsItsCalls(Sound):
    calls = 0

    def read(self, simulator):
        self.calls += 1
        return {"use": super().read(simulator)["use"] + self.calls}


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (GivesAwayTheSimulatorsArrays, "was written into later"),
        (WritesIntoTensorsItGaveAway, "was written into later"),
        (HasAnotherShape, "not that of its spec"),
        (NamesAnotherKey, "specs say"),
        (IsNotFinite, "not finite"),
        (SpoilsTheSimulator, "writes into the simulator"),
        (MixesEnvironments, "other numbers in a batch"),
        (CountsItsCalls, "read twice"),
    ],
)
def test_a_fault_is_named(faulty, complaint):
    check_observation(Sound)
    with pytest.raises(AssertionError, match=complaint):
        check_observation(faulty)
