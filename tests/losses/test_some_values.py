"""Values of some actions alone, compared with TorchRL's loss over all of them: values, gradients and priorities."""

import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict

from nfv_torchrl.losses import DQN, NStepDQN
from nfv_torchrl.losses import dqn as module
from nfv_torchrl.networks import DuelingNetwork, MLPNetwork, Sizes
from nfv_torchrl.networks.base import QNetwork

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

ROWS, SIZES = 40, Sizes(observation=30, actions=23, services=2, candidate_features=3)


def transitions(weighted=False):
    """Rows whose next state differs from the state in a few numbers, but for some that differ in all."""
    seen = torch.rand(ROWS, 30) * (torch.rand(ROWS, 30) < 0.5)
    after = torch.where(torch.rand(ROWS, 30) < 0.1, torch.rand(ROWS, 30), seen)
    after[:5] = torch.rand(5, 30)
    masks = torch.rand(2, ROWS, 23) < 0.3
    masks[..., -1] = True
    rows = {
        "observation": seen,
        "action_mask": masks[0],
        "action": torch.multinomial(masks[0].float(), 1).squeeze(-1),
        "next": {
            "observation": after,
            "action_mask": masks[1],
            "reward": torch.randn(ROWS, 1),
            "request_done": torch.rand(ROWS, 1) < 0.3,
        },
        "steps_to_next_obs": torch.randint(1, 4, (ROWS, 1)),
    }
    return TensorDict(rows | ({"priority_weight": torch.rand(ROWS)} if weighted else {}), batch_size=ROWS)


def learned(loss, rows):
    """The loss, its gradients, and the priorities written."""
    loss.zero_grad()
    value = loss(rows)["loss"]
    value.backward()
    return value, [weights.grad for weights in loss.parameters()], rows["td_error"]


@pytest.mark.parametrize("hidden", [(16,), (24, 16), (8, 8, 8)])
@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("weighted", [True, False])
def test_the_loss_is_that_over_all_actions(hidden, double, weighted, monkeypatch):
    torch.manual_seed(3)
    network = partial(MLPNetwork, hidden=hidden, activation="Tanh" if weighted else "ReLU")
    loss = NStepDQN(network, SIZES, gamma=0.9, double=double, loss_function="smooth_l1" if weighted else "l2")
    for weights in loss.target_value_network_params.values(True, True):
        weights.data.normal_(0, 0.3)
    rows = transitions(weighted)
    some = learned(loss, rows.clone())
    monkeypatch.setattr(module, "serves", lambda *_: False)
    whole = learned(loss, rows.clone())
    assert some[0].item() == pytest.approx(whole[0].item(), rel=1e-5)
    torch.testing.assert_close(some[1], whole[1], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(some[2], whole[2], rtol=1e-4, atol=1e-6)


def test_a_copy_learns_with_its_own_weights():
    torch.manual_seed(4)
    loss, rows = DQN(partial(MLPNetwork, hidden=(16,)), SIZES, double=True), transitions()
    other = copy.deepcopy(loss)
    with torch.no_grad():
        for weights in other.parameters():
            weights.add_(0.1)
    before = loss(rows)["loss"].item()
    assert other(rows)["loss"].item() != before == loss(rows)["loss"].item()


class OwnNetwork(MLPNetwork):
    """A class of a user's own may compute something else."""

    def forward(self, observation):
        return 2 * super().forward(observation)


@pytest.mark.parametrize(
    "network",
    [
        partial(MLPNetwork, hidden=(16,), noisy=True),
        partial(MLPNetwork, hidden=(20,)),
        partial(MLPNetwork, hidden=()),
        partial(MLPNetwork, hidden=(16,), activation="PReLU"),
        partial(DuelingNetwork, hidden=(16,)),
        partial(OwnNetwork, hidden=(16,)),
    ],
)
def test_other_networks_are_left_to_torchrl(network):
    loss: QNetwork = network(SIZES)
    assert not module.serves(loss, transitions())
    assert module.serves(MLPNetwork(SIZES), transitions())


def test_other_devices_are_left_to_torchrl():
    network, rows = MLPNetwork(SIZES), transitions()
    assert module.serves(network, rows)
    assert not module.serves(network, rows.to("meta"))
