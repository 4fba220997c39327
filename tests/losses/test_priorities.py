"""Rows of a prioritised memory: weights in the mean, the size of the error as the next priority."""

import pytest
import torch
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.losses import DQN, QuantileDQN
from nfv_torchrl.losses.sequences import sequence_priority

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

HERE = [1.0, 4.0, 100.0, 100.0]
STEP = {"mask": [1, 1, 0, 0], "reward": 2.0, "next_mask": [1, 0, 0, 0], "done": True}


def rows(weights=None):
    both = torch.cat([transition(action=action, **STEP) for action in (0, 1)])
    return both if weights is None else both.set("priority_weight", torch.tensor(weights))


def test_dqn():
    """Errors 2 - 1 and 2 - 4."""
    loss = DQN(table_network([HERE, [0.0] * 4]), SIZES)
    assert loss(rows())["loss"].item() == pytest.approx((1 + 4) / 2)
    weighted = rows([0.5, 1.0])
    assert loss(weighted)["loss"].item() == pytest.approx((0.5 * 1 + 1.0 * 4) / 1.5)
    assert weighted["td_error"].flatten().tolist() == pytest.approx([1.0, 2.0])


def test_quantiles():
    """Quantiles (0, 2) and (3, 5) of the two actions, all samples 2."""
    table = [[[0.0, 2.0], [3.0, 5.0], [9.0, 9.0], [9.0, 9.0]], [[0.0, 0.0]] * 4]
    loss = QuantileDQN(table_network(table), SIZES, quantiles=2)
    set_target(loss, "value_network", table)
    # |1/4 - 0| * 1.5 + 0, and |1/4 - 1| * 0.5 + |3/4 - 1| * 2.5
    each = [0.375, 0.375 + 0.625]
    weighted = rows([1.0, 3.0])
    assert loss(weighted)["loss"].item() == pytest.approx((each[0] + 3 * each[1]) / 4)
    assert weighted["td_error"].flatten().tolist() == pytest.approx([1.0, 2.0])


def test_sequences():
    """Steps with errors 1, 0 and 2."""
    assert sequence_priority(torch.tensor([[1.0, 0.0, 2.0]])).tolist() == [[pytest.approx(0.9 * 2 + 0.1 * 1)]]
