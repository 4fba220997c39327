"""Behaviour cloning over valid actions, worked out by hand."""

import math

import pytest
import torch
from two_states import SIZES, table_network, transition

from nfv_torchrl.losses import Imitation

TABLE = [[math.log(2), math.log(6), 50.0, 50.0], [0.0] * 4]


def test_cross_entropy_of_the_recorded_action():
    loss = Imitation(table_network(TABLE), SIZES)
    data = transition(action=1, mask=[1, 1, 0, 0], reward=0.0, next_mask=[1, 1, 1, 1], done=False)
    values = loss(loss.prepare(data))
    assert values["loss"].item() == pytest.approx(-math.log(6 / 8))
    assert values["agreement"].item() == 1
    values["loss"].backward()
    gradient = loss.actor[0].module.table.grad[0]
    assert gradient.tolist() == pytest.approx([0.25, -0.25, 0, 0])
    assert torch.isfinite(gradient).all()


def test_nothing_of_the_next_state_is_stored():
    loss = Imitation(table_network(TABLE), SIZES)
    data = transition(action=1, mask=[1, 1, 0, 0], reward=0.0, next_mask=[1, 1, 1, 1], done=False)
    assert set(loss.prepare(data).keys(True, True)) == {"observation", "action_mask", "action"}


def test_a_temperature_divides_preferences():
    data = transition(action=1, mask=[1, 1, 0, 0], reward=0.0, next_mask=[1, 1, 1, 1], done=False)
    # Twice the difference: 2^2 and 6^2.
    assert Imitation(table_network(TABLE), SIZES, temperature=0.5)(data)["loss"].item() == pytest.approx(
        -math.log(36 / 40)
    )
    with pytest.raises(ValueError, match=r"loss\.temperature is 0"):
        Imitation(table_network(TABLE), SIZES, temperature=0.0)
