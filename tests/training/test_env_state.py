"""Environments saved in little room and loaded to the bit."""

from __future__ import annotations

import pytest
import torch

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.training import env_state
from nfv_torchrl.training.disk import tensor_bytes
from nfv_torchrl.training.env_state import EnvState

SCENARIO = paper_scenario(nodes=6, seed=1, horizon=50, arrival_rate=10)


@pytest.fixture
def played(monkeypatch) -> NFVEnv:
    monkeypatch.setattr(env_state, "LARGE", 0)  # so that everything is packed
    env = NFVEnv(SCENARIO, 3)
    env.rollout(200, break_when_any_done=False)
    return env


def test_what_is_packed_comes_back_to_the_bit_in_a_tenth_of_the_room(played):
    plain, packed = played.state_dict(), EnvState(played).state_dict()
    assert tensor_bytes(packed) * 10 < tensor_bytes(plain)
    other = NFVEnv(SCENARIO, 3, seed=5)
    EnvState(other).load_state_dict(packed)
    again = other.state_dict()
    assert all(torch.equal(again["world"][name], array) for name, array in plain["world"].items())
    EnvState(other).load_state_dict(plain)  # as older versions saved it


@pytest.mark.parametrize(
    "change",
    [{"dtype": "float"}, {"dtype": 1}, {"shape": [3, 2**30]}, {"shape": [-1]}, {"shape": [3]}, {"packed": 1}, {"x": 1}],
)
def test_damaged_states_are_refused(played, change):
    packed = EnvState(played).state_dict()
    packed["world"]["running.entry_next"] |= change
    with pytest.raises(CheckpointError, match=r"running\.entry_next"):
        EnvState(played).load_state_dict(packed)
