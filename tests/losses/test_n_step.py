"""Returns over several steps, with the ends of requests, horizon and batch, worked out by hand."""

import pytest
import torch
from tensordict import TensorDict
from two_states import SIZES, set_target, table_network

from nfv_torchrl.losses import NStepDQN

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

VALUES = [[0.0, 0.0, 0.0, 0.0], [0.6, 50.0, 0.2, 90.0]]


def batch(rewards, request_done, done) -> TensorDict:
    """One environment over T steps; the observation is the number of the step, 0.1 apart."""
    steps = len(rewards)
    column = torch.arange(steps + 1).view(1, -1, 1) / 10
    mask = torch.tensor([[1, 0, 1, 0]], dtype=torch.bool).expand(1, steps, 4)
    flag = {"request_done": request_done, "done": done, "terminated": done}
    after = {name: torch.tensor(values, dtype=torch.bool).view(1, -1, 1) for name, values in flag.items()}
    after |= {"observation": column[:, 1:].clone(), "action_mask": mask, "reward": torch.tensor(rewards).view(1, -1, 1)}
    return TensorDict(
        {
            "observation": column[:, :-1].clone(),
            "action_mask": mask,
            "action": torch.zeros(1, steps, dtype=torch.int64),
            "next": TensorDict(after, batch_size=[1, steps]),
        },
        batch_size=[1, steps],
    )


def test_sums_end_with_request_horizon_and_batch():
    # Steps 0 to 2 are a request, 3 ends another and the horizon, 4 to 6 are the next one, cut by the batch's end.
    data = batch([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0], [0, 0, 1, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0])
    loss = NStepDQN(table_network(VALUES), SIZES, n=3, gamma=0.5)
    out = loss.prepare(data)
    assert out.batch_size == torch.Size([7])
    assert out["steps_to_next_obs"].flatten().tolist() == [3, 2, 1, 1, 3, 2, 1]
    # 1 + 2/2 + 4/4; 2 + 4/2; 4; 8; 16 + 32/2 + 64/4; 32 + 64/2; 64
    assert out["next", "reward"].flatten().tolist() == [3.0, 4.0, 4.0, 8.0, 48.0, 64.0, 64.0]
    assert out["next", "request_done"].flatten().tolist() == [True, True, True, True, False, False, False]
    assert out["next", "observation"].flatten().tolist() == pytest.approx([0.3, 0.3, 0.3, 0.4, 0.7, 0.7, 0.7])
    assert data["next", "reward"].flatten().tolist()[0] == 1.0  # the collected batch stays as it was


def test_horizons_are_crossed_by_no_sum_even_when_requests_are():
    data = batch([1.0, 2.0, 4.0], [1, 1, 1], [0, 1, 0])
    out = NStepDQN(table_network(VALUES), SIZES, n=5, gamma=1.0, stop_at="done").prepare(data)
    assert out["next", "reward"].flatten().tolist() == [3.0, 2.0, 4.0]
    assert out["next", "done"].flatten().tolist() == [True, True, False]


@pytest.mark.parametrize("double", [False, True])
def test_the_bootstrap_is_discounted_by_the_steps_summed(double):
    # From state 0 two steps: 1 + 0.9 * 2, then 0.9^2 times the highest valid value of state 1.
    data = batch([1.0, 2.0], [0, 0], [0, 0])
    data["observation"].zero_()
    data["next", "observation"].fill_(1.0)
    loss = NStepDQN(table_network(VALUES), SIZES, n=4, gamma=0.9, double=double)
    set_target(loss, "value_network", VALUES)
    rows = loss.prepare(data)
    assert loss(rows[:1])["loss"].item() == pytest.approx((1 + 0.9 * 2 + 0.81 * 0.6) ** 2)
    assert loss(rows[1:])["loss"].item() == pytest.approx((2 + 0.9 * 0.6) ** 2)


def test_one_step_is_plain_q_learning():
    data = batch([1.0, 2.0], [0, 1], [0, 0])
    out = NStepDQN(table_network(VALUES), SIZES, n=1).prepare(data)
    assert out["steps_to_next_obs"].flatten().tolist() == [1, 1]
    assert out["next", "reward"].flatten().tolist() == [1.0, 2.0]


def test_n_must_be_a_number_of_steps():
    with pytest.raises(ValueError, match=r"loss\.n is 0"):
        NStepDQN(table_network(VALUES), SIZES, n=0)
