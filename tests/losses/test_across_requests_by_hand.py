"""Losses that look across requests, against numbers worked out on paper.

Values of state 0 and 1 as in the other hand-made tests: actions 0 and 2 of state 1 are valid, 1 and 3 have the highest
values but are not.
"""

import pytest
import torch
from tensordict import TensorDict
from two_states import SIZES, set_target, table_network

from nfv_torchrl.losses import CentredDQN, DifferentialDQN, SlotDiscountDQN
from nfv_torchrl.losses.n_step import n_step_returns

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

ONLINE = [[0.5, 0.25, 7.0, 9.0], [0.1, 8.0, 0.3, 9.0]]
TARGET = [[0.0, 0.0, 0.0, 0.0], [0.6, 50.0, 0.2, 90.0]]
LOSSES = {"differential": DifferentialDQN, "centred": CentredDQN, "slot_discount": SlotDiscountDQN}
TWO_SERVICES = SIZES._replace(services=2)


def batch(rewards, request_done, *, done=None, terminated=None, slots=None, services=None) -> TensorDict:
    """One environment over T steps, action 1 in state 0, then state 1."""
    steps = len(rewards)
    nothing = [0] * steps
    here = torch.tensor([[1, 1, 0, 0]], dtype=torch.bool).expand(1, steps, 4)
    there = torch.tensor([[1, 0, 1, 0]], dtype=torch.bool).expand(1, steps, 4)
    outcome = {"slots_closed": torch.tensor(slots or nothing, dtype=torch.float32).view(1, -1, 1)}
    outcome["service"] = torch.tensor(services or nothing).view(1, -1, 1)
    flags = {"request_done": request_done, "done": done or terminated or nothing, "terminated": terminated or nothing}
    after = {name: torch.tensor(flag, dtype=torch.bool).view(1, -1, 1) for name, flag in flags.items()}
    after |= {"observation": torch.ones(1, steps, 1), "action_mask": there, "outcome": outcome}
    after["reward"] = torch.tensor(rewards, dtype=torch.float32).view(1, -1, 1)
    seen = {"observation": torch.zeros(1, steps, 1), "action_mask": here, "action": torch.ones(1, steps).long()}
    return TensorDict({**seen, "next": TensorDict(after, batch_size=[1, steps])}, batch_size=[1, steps])


def make(name, sizes=SIZES, **options):
    loss = LOSSES[name](table_network(ONLINE), sizes, **options)
    set_target(loss, "value_network", TARGET)
    return loss


def goals(loss, data) -> list[float]:
    """The target of each transition at the reward rate as it is, read off the error of Q(0, 1) = 0.25."""
    rate = loss.rate.clone()
    rows = loss.prepare(data)
    found = []
    for row in rows.split(1):
        loss.rate.copy_(rate)
        table = loss.actor[0].module.table
        table.grad = None
        loss(row)["loss"].backward()
        found.append(0.25 - table.grad[0, 1].item() / 2)  # the loss is (Q - y)^2
    return found


@pytest.mark.parametrize(("double", "ahead"), [(False, 0.6), (True, 0.2)])
@pytest.mark.parametrize(
    ("name", "options", "discount"),
    [
        ("differential", {}, 1.0),
        ("centred", {"gamma": 0.5}, 0.5),
        ("slot_discount", {"gamma": 0.5, "n": 1, "by_service": False}, 0.25),
    ],
)
def test_discount_and_rate_apply_at_the_end_of_a_request_alone(name, options, discount, double, ahead):
    loss = make(name, double=double, **options)
    loss.rate.fill_(0.75)
    # Within a request, its end with two slots closing, the horizon's end.
    data = batch([0.125, 1.0, 1.0], [0, 1, 1], terminated=[0, 0, 1], slots=[0, 2, 1])
    expected = [0.125 + ahead, 1.0 - 0.75 + discount * ahead, 1.0 - 0.75]
    assert goals(loss, data) == pytest.approx(expected)


def test_requests_of_one_slot_are_not_discounted_by_time():
    loss = make("slot_discount", gamma=0.5, n=1, double=False, by_service=False)
    assert goals(loss, batch([1.0, 1.0], [1, 1], slots=[0, 3])) == pytest.approx([1.6, 1.0 + 0.125 * 0.6])


@pytest.mark.parametrize("name", LOSSES)
def test_choice_and_target_keep_to_valid_actions(name):
    loss = make(name, n=1)
    assert loss.actor(batch([0.0], [0])[:, 0])["action"].item() == 0
    loss(loss.prepare(batch([1.0], [1])))["loss"].backward()
    gradient = loss.actor[0].module.table.grad
    assert gradient[0, 1] != 0 and (gradient.flatten()[[0, 2, 3, 4, 5, 6, 7]] == 0).all()


@pytest.mark.parametrize("name", ["centred", "slot_discount"])
def test_sums_from_the_end_of_a_request_on_cross_those_of_others_with_discount_and_rate(name):
    options = {"gamma": 0.5, "n": 3, "double": False, "by_service": False}
    loss = make(name, **options)
    loss.rate.fill_(0.5)
    # Requests of two steps, of one and of one again; a slot ends with each.
    data = batch([0.0, 1.0, 0.0, 1.0], [0, 1, 1, 1], slots=[0, 1, 1, 1])
    expected = [
        0.0 + 0.6,  # within a request: one step
        (1.0 - 0.5) + 0.5 * (0.0 - 0.5) + 0.25 * (1.0 - 0.5) + 0.125 * 0.6,
        (0.0 - 0.5) + 0.5 * (1.0 - 0.5) + 0.25 * 0.6,
        (1.0 - 0.5) + 0.5 * 0.6,
    ]
    assert goals(loss, data) == pytest.approx(expected)


def test_only_time_that_passed_discounts_a_sum_by_slots():
    loss = make("slot_discount", gamma=0.5, n=3, double=False, by_service=False)
    data = batch([1.0, 2.0, 4.0], [1, 1, 1], slots=[0, 2, 0])
    expected = [1.0 + 2.0 + 0.25 * 4.0 + 0.25 * 0.6, 2.0 + 0.25 * 4.0 + 0.25 * 0.6, 4.0 + 0.6]
    assert goals(loss, data) == pytest.approx(expected)


def test_a_segment_ends_the_sum_and_a_horizon_the_look_ahead_too():
    loss = make("centred", gamma=0.5, n=5, double=False)
    segment = batch([1.0, 2.0, 4.0], [1, 1, 1], done=[0, 1, 0])
    assert goals(loss, segment) == pytest.approx([1.0 + 0.5 * 2.0 + 0.25 * 0.6, 2.0 + 0.5 * 0.6, 4.0 + 0.5 * 0.6])
    horizon = batch([1.0, 2.0, 4.0], [1, 1, 1], terminated=[0, 1, 0])
    assert goals(loss, horizon) == pytest.approx([1.0 + 0.5 * 2.0, 2.0, 4.0 + 0.5 * 0.6])


def test_the_rate_of_each_service_is_taken_off_its_own_requests():
    loss = make("centred", TWO_SERVICES, gamma=0.5, n=2, double=False, by_service=True)
    loss.rate.copy_(torch.tensor([0.25, 0.75]))
    data = batch([1.0, 1.0], [1, 1], services=[1, 0])
    expected = [(1.0 - 0.75) + 0.5 * (1.0 - 0.25) + 0.25 * 0.6, (1.0 - 0.25) + 0.5 * 0.6]
    assert goals(loss, data) == pytest.approx(expected)


def test_the_running_mean_is_what_a_request_earns():
    loss = make("centred", rate_over=1000)
    loss.prepare(batch([-0.5, 1.0, 0.0, 1.0], [0, 1, 1, 1]))  # costs of a walk belong to its request
    assert loss.rate.tolist() == pytest.approx([1.5 / 3])
    loss.prepare(batch([0.0], [1]))  # a thousandth is forgotten for each request that ended
    assert loss.rate.tolist() == pytest.approx([1.5 * 0.999 / (3 * 0.999 + 1)])


def test_the_running_mean_of_each_service():
    loss = make("slot_discount", TWO_SERVICES)
    loss.prepare(batch([-0.5, 1.0, 0.0, 1.0], [0, 1, 1, 1], services=[1, 1, 0, 1]))
    assert loss.rate.tolist() == pytest.approx([0.0, 1.5 / 2])
    assert loss(loss.prepare(batch([0.0], [0])))["reward_rate"].item() == pytest.approx(0.375)


def test_each_environment_has_means_of_its_own():
    """Environment 0 earns 1 and 0 with service 0; environment 1 earns 3 with service 1 and 2 with service 0."""
    loss = make("centred", TWO_SERVICES, gamma=0.5, double=False, by_service=True, environments=2)
    rows = [batch([1.0, 0.0], [1, 1]), batch([3.0, 2.0], [1, 1], services=[1, 0])]
    stored = loss.prepare(torch.cat(rows))
    assert loss.rate.tolist() == [[0.5, 0.0], [2.0, 3.0]]
    assert stored["next", "environment"].flatten().tolist() == [0, 0, 1, 1]
    # 1 - 0.5, 0 - 0.5, 3 - 3 and 2 - 2, each with 0.5 * 0.6 ahead; Q(0, 1) is 0.25.
    errors = [row_of(loss, row) for row in stored.split(1)]
    assert errors == pytest.approx([0.8 - 0.25, 0.2 + 0.25, 0.3 - 0.25, 0.3 - 0.25])
    loss.prepare(torch.cat(rows[::-1]))
    assert loss.rate.flatten().tolist() == pytest.approx([1.0, 3.0, 1.0, 3.0], rel=1e-3)


def row_of(loss, row) -> float:
    """The size of the error of one transition."""
    return loss(row)["td_error"].item()


def test_the_differential_rate_follows_the_errors_at_the_ends_of_requests():
    loss = make("differential", rate_step=0.1, double=False)
    rows = loss.prepare(batch([0.0, 1.0, 0.0], [0, 1, 1]))
    assert loss.rate.item() == 0.0  # what was collected does not move it
    loss(rows)
    # Errors 1 + 0.6 - 0.25 and 0 + 0.6 - 0.25; that within a request is none of the rate's.
    assert loss.rate.item() == pytest.approx(0.1 * (1.35 + 0.35) / 2)
    loss(loss.prepare(batch([0.0], [0])))
    assert loss.rate.item() == pytest.approx(0.1 * (1.35 + 0.35) / 2)


def test_differential_q_learning_finds_the_reward_rate():
    # A single state where action 0 earns 1 and action 1 earns 0.25, one step a request: the best rate is 1.
    def alone(sizes, outputs=1):
        return table_network([[0.0, 0.0, 7.0, 9.0], [0.0] * 4])(sizes, outputs)

    loss = DifferentialDQN(alone, SIZES, rate_step=0.05)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.2)
    data = batch([1.0, 0.25], [1, 1])
    data["next", "observation"].zero_()
    data["next", "action_mask"] = data["action_mask"].clone()
    data["action"] = torch.tensor([[0, 1]])
    rows = loss.prepare(data)
    for _ in range(400):
        optimizer.zero_grad()
        loss(rows)["loss"].backward()
        optimizer.step()
        loss.target_value_network_params.data.update_(loss.value_network_params.data)
    assert loss.rate.item() == pytest.approx(1.0, abs=0.01)
    values = loss.actor[0].module.table[0]
    assert (values[0] - values[1]).item() == pytest.approx(0.75, abs=0.01)


def test_the_reward_rate_is_kept_with_the_weights():
    loss = make("centred")
    loss.prepare(batch([1.0, 0.0], [1, 1]))
    other = make("centred")
    other.load_state_dict(loss.state_dict())
    for each in (loss, other):
        each.prepare(batch([1.0], [1]))
    assert loss.rate.item() == other.rate.item() == pytest.approx(2 / 3, abs=1e-4)


def test_the_discount_after_a_sum_is_the_product_of_its_own():
    discount = torch.tensor([[0.5, 1.0, 0.25, 0.5]])
    stop = torch.tensor([[False, False, True, False]])
    _, steps, ahead = n_step_returns(torch.zeros(1, 4), stop, 3, discount)
    assert steps.tolist() == [[3, 2, 1, 1]] and ahead.tolist() == [[0.125, 0.25, 0.25, 0.5]]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("differential", {"rate_step": 0.0}, r"loss\.rate_step is 0"),
        ("differential", {"n": 0}, r"loss\.n is 0"),
        ("centred", {"gamma": 1.5}, r"loss\.gamma is 1\.5"),
        ("slot_discount", {"rate_over": 0}, r"loss\.rate_over is 0"),
    ],
)
def test_bad_settings_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        make(name, **options)
