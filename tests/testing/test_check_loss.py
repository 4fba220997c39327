"""``check_loss`` passes every loss of the project and catches a planted fault of each kind."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict

import nfv_torchrl.losses
from nfv_torchrl.losses import RDPG, MaskedLoss, RecurrentDQN, RecurrentPPO, greedy_actor
from nfv_torchrl.losses.masked import masked_argmax
from nfv_torchrl.networks import CandidateNetwork, GRUNetwork, ImplicitQuantileNetwork
from nfv_torchrl.testing import check_loss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
LOSSES = [
    *("DQN", "NStepDQN", "CQL", "Imitation", "QuantileDQN", "DiscreteSAC"),
    *("MunchausenDQN", "PaperLiteral", "Rainbow"),
    *("CentredDQN", "DifferentialDQN", "SlotDiscountDQN", "A2C", "PPO", "Reinforce"),
]


@pytest.mark.parametrize("name", LOSSES)
def test_the_losses_of_the_project_pass(name):
    check_loss(getattr(nfv_torchrl.losses, name))


def test_other_networks_serve(seed=1):
    for kind in (RecurrentDQN, RecurrentPPO, RDPG):
        check_loss(kind, network=partial(GRUNetwork, hidden=8))
    check_loss(nfv_torchrl.losses.IQN, network=partial(ImplicitQuantileNetwork, hidden=(8, 8)))
    check_loss(partial(nfv_torchrl.losses.DQN, double=True), network=partial(CandidateNetwork, hidden=(8,)), seed=seed)


class Sound(MaskedLoss):
    """Plain Q-learning; each fault below changes one thing of it."""

    def __init__(self, network, sizes):
        q_network = network(sizes)
        super().__init__(q_network)
        self.adopt(q_network, actor=greedy_actor(q_network, sizes.actions))

    def best(self, values, after):
        return values.gather(-1, masked_argmax(values, self.mask(after)))

    def forward(self, tensordict):
        taken = self.outputs("value_network", tensordict).gather(-1, self.action(tensordict))
        with torch.no_grad():
            after = tensordict.get("next")
            goal = self.returns(tensordict, self.best(self.outputs("value_network", after, target=True), after), 0.9)
        return TensorDict({"loss": (goal - taken).square().mean()})


class CountsInvalidActions(Sound):
    def best(self, values, after):
        return values.amax(-1, keepdim=True)


class SumsOverInvalidActions(Sound):
    def forward(self, tensordict):
        spread = self.outputs("value_network", tensordict).logsumexp(-1).mean()
        return super().forward(tensordict).set("loss_spread", spread)


class TakesInvalidActions(Sound):
    def __init__(self, network, sizes):
        super().__init__(network, sizes)
        self.act_by(greedy_actor(network(sizes), sizes.actions, ["observation"]))
        self.actor[-1].action_mask_key = None


class WritesIntoTheBatch(Sound):
    def prepare(self, data):
        data["next", "reward"].mul_(0.5)
        return super().prepare(data)


class LeavesRowsInTwoDimensions(Sound):
    def prepare(self, data):
        return data.select(*self.in_keys)


class LooksBeyondTheHorizon(Sound):
    def returns(self, tensordict, next_value, gamma):
        return tensordict["next", "reward"] + gamma * next_value


class ReturnsRows(Sound):
    def forward(self, tensordict):
        return super().forward(tensordict).set("error", torch.zeros(len(tensordict)))


class LearnsNothing(Sound):
    def forward(self, tensordict):
        return TensorDict({"loss": super().forward(tensordict)["loss"].detach().requires_grad_()})


class DividesByZero(Sound):
    def forward(self, tensordict):
        return TensorDict({"loss": super().forward(tensordict)["loss"] / tensordict["observation"].mul(0).sum()})


class ForgetsWeights(Sound):
    def forward(self, tensordict):
        self.prioritise(tensordict, tensordict["next", "reward"])
        return super().forward(tensordict)


class WritesOnePriority(Sound):
    def forward(self, tensordict):
        tensordict.set("td_error", torch.ones(len(tensordict), 4))
        return super().forward(tensordict)


class HasNoLoss(Sound):
    def forward(self, tensordict):
        return TensorDict({"error": super().forward(tensordict)["loss"]})


class ForgetsItsMean(Sound):
    mean = 0.0

    def forward(self, tensordict):
        self.mean = 0.9 * self.mean + float(tensordict["next", "reward"].mean()) + 1.0
        return TensorDict({"loss": super().forward(tensordict)["loss"] + self.mean})


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (CountsInvalidActions, "values of invalid actions count"),
        (SumsOverInvalidActions, "values of invalid actions count"),
        (TakesInvalidActions, "the actor takes invalid actions"),
        (WritesIntoTheBatch, "prepare changes the batch"),
        (LeavesRowsInTwoDimensions, "flatten it to rows"),
        (LooksBeyondTheHorizon, "what follows the end of a horizon counts"),
        (ReturnsRows, "error has shape"),
        (LearnsNothing, "no parameter gets a gradient"),
        (DividesByZero, "on ordinary data"),
        (ForgetsWeights, "weights of rows .* do not count"),
        (WritesOnePriority, "write one of each row"),
        (HasNoLoss, "no entry whose name starts with 'loss'"),
        (ForgetsItsMean, "keep them in buffers"),
    ],
)
def test_a_fault_is_named(faulty, complaint):
    check_loss(Sound)
    with pytest.raises(AssertionError, match=complaint):
        check_loss(faulty)
