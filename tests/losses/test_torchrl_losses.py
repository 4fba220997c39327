"""TorchRL's own loss classes, made by the adapter, against numbers worked out on paper.

State 0: action 1 taken of the valid {0, 1}. State 1: actions {0, 2} are valid, 1 and 3 are not but have the highest
values. The policy gradients are in ``test_policy_gradient.py``.
"""

import math
from functools import partial
from pathlib import Path

import pytest
import torch
from torchrl.objectives import DiscreteCQLLoss, DiscreteIQLLoss, DiscreteSACLoss, DistributionalDQNLoss, DQNLoss
from two_states import SIZES, set_target, table_network, transition

from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import DQN, request_loss
from nfv_torchrl.methods import load_policy, policy_content, save_policy
from nfv_torchrl.networks import MLPNetwork, Sizes
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

JUNK = 1e4
ONLINE = [[0.5, 0.25, 7.0, 9.0], [0.1, 8.0, 0.3, 9.0]]
TARGET = [[0.0, 0.0, 0.0, 0.0], [0.6, 50.0, 0.2, 90.0]]
STEP = {"action": 1, "mask": [1, 1, 0, 0], "reward": 0.5, "next_mask": [1, 0, 1, 0]}
# What the policy does in state 0 (1/4, 3/4) and in state 1 (1/2, 1/2), as log-odds.
POLICY = [[0.0, math.log(3), JUNK, JUNK], [1.0, JUNK, 1.0, JUNK]]
FIRST, SECOND = [[1.0, 2.0, JUNK, JUNK], [0.0] * 4], [[3.0, 1.5, JUNK, JUNK], [0.0] * 4]
TWO_TARGETS = [[[0.0, 0.75, JUNK, JUNK], [0.4, JUNK, 0.8, JUNK]], [[0.0, 2.5, JUNK, JUNK], [0.6, JUNK, 0.2, JUNK]]]
STATE_VALUES = [[1.0, 0.0, JUNK, JUNK], [0.2, JUNK, 0.4, JUNK]]  # means over valid actions: 0.5 and 0.3
ENTROPY = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)


def make(kind, *tables, target=None, name="value_network", **settings):
    loss = request_loss(kind)(table_network(*tables), SIZES, **settings)
    if target is not None:
        set_target(loss, name, target)
    return loss


def total(values) -> torch.Tensor:
    return sum(value for key, value in values.items() if key.startswith("loss"))


# --------------------------------------------------------------------------------------------- DQNLoss


@pytest.mark.parametrize(
    ("double", "done", "goal"),
    [
        (False, False, 0.5 + 0.9 * 0.6),  # the target's highest valid value, at action 0
        (True, False, 0.5 + 0.9 * 0.2),  # the online network prefers action 2
        (False, True, 0.5),
        (True, True, 0.5),
    ],
)
def test_dqn(double, done, goal):
    loss = make(DQNLoss, ONLINE, target=TARGET, gamma=0.9, double_dqn=double)
    assert loss(transition(**STEP, done=done))["loss"].item() == pytest.approx((goal - 0.25) ** 2)
    assert loss.actor(transition(**STEP, done=False))["action"].item() == 0


def test_dqn_without_a_target_network_looks_ahead_by_the_online_one():
    loss = make(DQNLoss, ONLINE, gamma=0.9, delay_value=False)
    goal = 0.5 + 0.9 * 0.3
    assert loss(transition(**STEP, done=False))["loss"].item() == pytest.approx((goal - 0.25) ** 2)


def test_dqn_looks_across_requests_when_asked_to():
    loss = make(DQNLoss, ONLINE, target=TARGET, gamma=0.9, stop_at="done")
    goal = 0.5 + 0.9 * 0.6
    assert loss(transition(**STEP, done=True))["loss"].item() == pytest.approx((goal - 0.25) ** 2)


def test_dqn_is_the_dqn_of_this_package():
    theirs, ours = make(DQNLoss, ONLINE, target=TARGET, gamma=0.9), DQN(table_network(ONLINE), SIZES, gamma=0.9)
    set_target(ours, "value_network", TARGET)
    data = transition(**STEP, done=False)
    assert torch.equal(theirs(data)["loss"], ours(data)["loss"])
    assert set(theirs.in_keys) == set(ours.in_keys)
    rows, others = (loss.prepare(data.unsqueeze(0)) for loss in (theirs, ours))
    assert set(rows.keys(True, True)) == set(others.keys(True, True))


# --------------------------------------------------------------------------------------------- DiscreteCQLLoss


@pytest.mark.parametrize(("done", "goal"), [(False, 0.5 + 0.9 * 0.6), (True, 0.5)])
def test_cql(done, goal):
    loss = make(DiscreteCQLLoss, ONLINE, target=TARGET, gamma=0.9)
    values = loss(transition(**STEP, done=done))
    assert values["loss_qvalue"].item() == pytest.approx(0.5 * (goal - 0.25) ** 2)
    # Only the valid actions 0 and 1 of state 0 are in the sum.
    assert values["loss_cql"].item() == pytest.approx(math.log(math.exp(0.5) + math.exp(0.25)) - 0.25)
    logged = {key: value.item() for key, value in values.items() if not key.startswith("loss")}
    assert logged == pytest.approx({"td_error": goal - 0.25, "pred_value": 0.25, "target_value": goal})


# --------------------------------------------------------------------------------------- DistributionalDQNLoss


def odds(*probabilities):
    """Log-odds [1, atoms] of one action."""
    return [math.log(p) for p in probabilities]


LOW, HIGH = odds(0.8, 0.1, 0.1), odds(0.01, 0.01, 0.98)
ATOMS_ONLINE = [[LOW, odds(0.2, 0.3, 0.5), HIGH, HIGH], [LOW, HIGH, odds(0.3, 0.3, 0.4), HIGH]]
ATOMS_TARGET = [[LOW] * 4, [HIGH, HIGH, odds(0.5, 0.25, 0.25), HIGH]]


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize(
    ("done", "goal"),
    [
        # Atoms -1, 0 and 1 go to 0.5 + 0.5 z: 0, half-way from 0 to 1, and 1. The online network chooses action 2 of
        # the valid 0 and 2, the target network says 1/2, 1/4, 1/4.
        (False, [0.0, 0.5 + 0.125, 0.125 + 0.25]),
        (True, [0.0, 0.5, 0.5]),
    ],
)
def test_distributional(rows, done, goal):
    loss = make(DistributionalDQNLoss, ATOMS_ONLINE, target=None, gamma=0.5, atoms=3)
    loss.target_value_network_params["network", "table"].data.copy_(torch.tensor(ATOMS_TARGET))
    data = torch.cat([transition(**STEP, done=done)] * rows)
    expected = -sum(m * math.log(p) for m, p in zip(goal, (0.2, 0.3, 0.5), strict=True))
    assert loss(data)["loss"].item() == pytest.approx(expected, rel=1e-5)


def test_distributional_chooses_by_the_expected_values_of_valid_actions():
    loss = make(DistributionalDQNLoss, ATOMS_ONLINE, gamma=0.5, atoms=3, v_min=0.0, v_max=4.0)
    chosen = loss.actor(transition(**STEP, done=False))
    assert chosen["action"].item() == 1
    assert chosen["action_value"][0, :2].tolist() == pytest.approx([0.1 * 2 + 0.1 * 4, 0.3 * 2 + 0.5 * 4])
    with pytest.raises(ScenarioError, match=r"loss\.v_min: 1"):
        make(DistributionalDQNLoss, ATOMS_ONLINE, atoms=3, v_min=1.0)


# --------------------------------------------------------------------------------------------- DiscreteSACLoss


def soft(**settings):
    given = {"gamma": 0.9, "alpha_init": 0.5, "target_entropy_weight": 0.5, "loss_function": "l2", **settings}
    tables = (POLICY, FIRST, SECOND)
    return make(DiscreteSACLoss, *tables, target=TWO_TARGETS, name="qvalue_network", **given)


@pytest.mark.parametrize("skip", [False, True])
@pytest.mark.parametrize("done", [False, True])
def test_sac(done, skip):
    values = soft(skip_done_states=skip)(transition(**STEP, done=done))
    # V(s') = 1/2 (min(0.4, 0.6) + min(0.8, 0.2)) + alpha log 2
    goal = 0.5 + (0 if done else 0.9 * (0.5 * (0.4 + 0.2) + 0.5 * math.log(2)))
    assert values["loss_qvalue"].item() == pytest.approx((2 - goal) ** 2 + (1.5 - goal) ** 2, rel=1e-5)
    # sum of pi (alpha log pi - min Q): the lower values are 1 and 1.5
    regret = 0.25 * (0.5 * math.log(0.25) - 1) + 0.75 * (0.5 * math.log(0.75) - 1.5)
    assert values["loss_actor"].item() == pytest.approx(regret, rel=1e-5)
    assert values["entropy"].item() == pytest.approx(ENTROPY)
    # Of the entropy that two valid actions allow, not four.
    assert values["loss_alpha"].item() == pytest.approx(math.log(0.5) * (ENTROPY - 0.5 * math.log(2)))


def test_sac_aims_at_a_number_of_nats_when_told_so():
    values = soft(target_entropy=0.3)(transition(**STEP, done=False))
    assert values["loss_alpha"].item() == pytest.approx(math.log(0.5) * (ENTROPY - 0.3))


def test_sac_stays_finite_where_one_action_is_valid_and_the_temperature_high():
    loss = soft(alpha_init=1e6)
    values = loss(transition(**STEP | {"mask": [0, 1, 0, 0], "next_mask": [0, 0, 0, 1]}, done=False))
    assert values["entropy"].item() == 0
    total(values).backward()
    assert all(torch.isfinite(value).all() for value in values.values())
    assert all(torch.isfinite(each.grad).all() for each in loss.parameters() if each.grad is not None)


# --------------------------------------------------------------------------------------------- DiscreteIQLLoss


@pytest.mark.parametrize(("done", "goal"), [(False, 0.5 + 0.9 * 0.3), (True, 0.5)])
def test_iql(done, goal):
    tables = (POLICY, FIRST, SECOND, STATE_VALUES)
    settings = {"gamma": 0.9, "temperature": 2.0, "expectile": 0.7, "loss_function": "l2"}
    loss = make(DiscreteIQLLoss, *tables, target=TWO_TARGETS, name="qvalue_network", **settings)
    values = loss(transition(**STEP, done=done))
    assert values["loss_qvalue"].item() == pytest.approx((2 - goal) ** 2 + (1.5 - goal) ** 2)
    # The lower of the target values of what was done is 0.75, and V(s) is 0.5.
    assert values["loss_value"].item() == pytest.approx(0.7 * 0.25**2)
    assert values["loss_actor"].item() == pytest.approx(-math.exp(2.0 * 0.25) * math.log(0.75))
    assert values["cross_entropy"].item() == pytest.approx(-math.log(0.75))


# ------------------------------------------------------------------------------------------------ all of them

EACH = {
    DQNLoss: (ONLINE,),
    DistributionalDQNLoss: (ATOMS_ONLINE,),
    DiscreteCQLLoss: (ONLINE,),
    DiscreteIQLLoss: (POLICY, FIRST, SECOND, STATE_VALUES),
    DiscreteSACLoss: (POLICY, FIRST, SECOND),
}


@pytest.mark.parametrize("kind", EACH)
def test_values_of_invalid_actions_are_not_learned(kind):
    loss = make(kind, *EACH[kind], gamma=0.9, **({"atoms": 3} if kind is DistributionalDQNLoss else {}))
    total(loss(transition(**STEP, done=False))).backward()
    gradients = {name: each.grad for name, each in loss.named_parameters() if each.grad is not None}
    tables = {name: grad.unsqueeze(0) if "qvalue" not in name else grad for name, grad in gradients.items()}
    tables = {name: grad for name, grad in tables.items() if name.endswith("table")}
    assert tables
    for name, grad in tables.items():
        assert torch.isfinite(grad).all(), name
        assert not grad[:, 0, 2:].any() and not grad[:, 1].any(), name  # the next state's value is a target
        assert grad[:, 0, 1].any(), name


class Shifted(DQNLoss):
    """A class of somebody's own, with a setting of its own and one of TorchRL's."""

    def __init__(self, value_network, *, shift: float = 0.0, **settings):
        super().__init__(value_network, **settings)
        self.shift = shift

    def forward(self, tensordict):
        values = super().forward(tensordict)
        return values.set("loss", values.get("loss") + self.shift)


class Narrow(DQNLoss):
    def __init__(self, value_network, *, loss_function="l2"):
        super().__init__(value_network, loss_function=loss_function, double_dqn=True)


def test_a_class_derived_from_torchrls_keeps_what_it_overrides():
    loss = make(Shifted, ONLINE, target=TARGET, gamma=0.9, shift=3.0, double_dqn=True)
    goal = 0.5 + 0.9 * 0.2
    assert loss(transition(**STEP, done=False))["loss"].item() == pytest.approx((goal - 0.25) ** 2 + 3)
    assert isinstance(loss, Shifted)
    with pytest.raises(ScenarioError, match=r"loss.shift: 'far' where a finite number was expected"):
        make(Shifted, ONLINE, shift="far")
    with pytest.raises(ScenarioError, match=r"loss.double_dqn: unknown key.*loss_function"):
        make(Narrow, ONLINE, double_dqn=True)
    assert make(Narrow, ONLINE, loss_function="l1").double_dqn


def test_a_policy_file_builds_torchrls_classes_and_those_of_trusted_packages(tmp_path):
    scenario = paper_scenario(nodes=4, seed=1, horizon=10, arrival_rate=2)
    sizes = Sizes.of(Simulator(scenario, 1, one_hot=True))
    loss = request_loss(Shifted)(partial(MLPNetwork, hidden=[8]), sizes, shift=1.0)
    network = {"_target_": "nfv_torchrl.networks.MLPNetwork", "_partial_": True, "hidden": [8]}

    def written(**spec) -> Path:
        config = {"one_hot": True, "network": network, "loss": spec}
        save_policy(tmp_path / "best.pt", policy_content(loss, sizes, config, scenario, {}))
        return tmp_path / "best.pt"

    own = written(_target_=f"{__name__}.Shifted", shift=1.0)
    with pytest.raises(CheckpointError, match="trusted_packages"):
        load_policy(own, scenario)
    first = run_method(scenario, load_policy(own, scenario, trusted_packages=[__name__]), [0])[0]
    second = run_method(scenario, load_policy(written(_target_="torchrl.objectives.DQNLoss"), scenario), [0])[0]
    assert (first.accepted == second.accepted).all()
    with pytest.raises(CheckpointError, match=r"loss\.priority_key: unknown key"):
        load_policy(written(_target_="torchrl.objectives.DQNLoss", priority_key="x"), scenario)


def test_a_setting_that_torchrl_refuses_is_one_line():
    with pytest.raises(ScenarioError, match=r"loss: DQNLoss cannot be made \(.*delay_value=True"):
        make(DQNLoss, ONLINE, double_dqn=True, delay_value=False)


def test_noise_is_drawn_for_every_network():
    network = partial(MLPNetwork, hidden=(8,), noisy=True)
    loss = request_loss(DiscreteSACLoss)(network, SIZES)
    first, second = (total(loss(transition(**STEP, done=False))).item() for _ in range(2))
    assert math.isfinite(first) and math.isfinite(second) and first != second


def test_a_class_that_is_a_loss_of_requests_is_left_as_it_is():
    assert request_loss(DQN) is DQN
    assert request_loss(make) is make
