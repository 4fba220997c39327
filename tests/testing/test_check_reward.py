"""``check_reward`` passes the project's rewards and catches a planted fault of each kind."""

import numpy as np
import pytest

from nfv_torchrl import rewards
from nfv_torchrl.testing import check_reward


@pytest.mark.parametrize("reward", [rewards.paper, rewards.admission, rewards.admission_step_cost])
def test_the_rewards_of_the_project_pass(reward):
    check_reward(reward)


def writes(outcome, scale):
    outcome["accepted"] *= 2
    return outcome["accepted"]


def divides_by_zero(outcome, scale):
    with np.errstate(all="ignore"):
        return outcome["accepted"] / outcome["request_done"]


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (writes, "writes into the outcome"),
        (divides_by_zero, "on ordinary data"),
        (lambda outcome, scale: outcome["accepted"][:, None], "has shape"),
        (lambda outcome, scale: outcome["accepted"].sum(), "has shape"),
        (lambda outcome, scale: outcome["accepted"] - outcome["accepted"].mean(), "depends on the others"),
        (lambda outcome, scale: np.zeros_like(outcome["accepted"]), "the same for every step"),
    ],
)
def test_a_fault_is_named(faulty, complaint):
    with pytest.raises(AssertionError, match=complaint):
        check_reward(faulty)
