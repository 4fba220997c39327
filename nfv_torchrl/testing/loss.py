"""``check_loss``: does a loss do what ``RequestLoss`` promises?"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import HardUpdate

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.losses import RequestLoss, has_target, request_loss
from nfv_torchrl.networks import MLPNetwork, NetworkFactory, QNetwork, Sizes
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.testing.worlds import small_scenario

ENVS, STEPS = 4, 48
Numbers = dict[str, Tensor]
LossFactory = Callable[..., Any]
"""A loss class, or a ``partial`` of one, called as ``make(network, sizes)``."""


class Poisoned(QNetwork):
    """A network whose values of some actions, none of them ever valid in the data, are off by ``amount``."""

    def __init__(self, network: QNetwork, actions: Tensor, amount: float) -> None:
        super().__init__()
        self.network, self.amount = network, amount
        self.in_keys, self.any_size, self.takes_levels = network.in_keys, network.any_size, network.takes_levels
        self.poisoned: Tensor
        self.register_buffer("poisoned", actions, persistent=False)
        if hasattr(network, "unroll"):
            self.unroll = self._unroll

    def observations(self) -> list:
        """See ``QNetwork``."""
        return self.network.observations()

    def forward(self, *inputs: Tensor) -> Any:
        """Values with the poison, and whatever else the network returns."""
        return self._spoil(self.network(*inputs))

    def _unroll(self, *inputs: Tensor) -> Any:
        return self._spoil(self.network.unroll(*inputs))  # type: ignore[operator]

    def _spoil(self, result: Any) -> Any:
        values, *rest = result if isinstance(result, tuple) else (result,)
        wide = values.dim() > 2 and values.shape[-1] != len(self.poisoned)
        spoiled = values + self.amount * (self.poisoned.unsqueeze(-1) if wide else self.poisoned)
        return (spoiled, *rest) if rest else spoiled


def check_loss(make: LossFactory, *, network: NetworkFactory | None = None, seed: int = 0) -> None:
    """Check a loss on a small network, with data that its own actor and random valid actions brought.

    - The actor takes valid actions only, whatever the network says of the others.
    - Values of invalid actions change neither loss nor gradient, now and in the next state.
    - ``prepare`` gives rows [R, ...] that a replay buffer takes, and leaves the batch that it was given as it was.
    - Entries that start with ``loss`` are finite numbers [] with a finite gradient that is not zero everywhere; all
      other entries are numbers [], too.
    - What follows the end of a horizon does not matter.
    - Priorities, if the loss writes any (``td_error``), are finite numbers [R, 1] of at least 0, and weights of rows
      (``priority_weight``) count then.
    - A target network, if there is one, is found by TorchRL's updaters and gets no gradient.
    - A loss of the same class goes on from ``state_dict`` with the same numbers.

    Args:
        make: the class, or a ``partial`` of it; called as ``make(network, sizes)``. Recipes and this check know what to
            do with a loss class of TorchRL's.
        network: the network that it gets; default a small ``MLPNetwork``.
        seed: of weights, requests and actions.

    Raises:
        AssertionError: with what is wrong.

    Example::

        check_loss(partial(MyLoss, gamma=0.9))
    """
    trial = _Trial(make, network or partial(MLPNetwork, hidden=(16,)), seed)
    data = trial.collect()
    kept = data.clone()
    _check_rows(trial.loss().prepare(data))
    _same(kept, data, "prepare changes the batch that it is given; clone what it writes to")
    values, gradients = trial.learn(data)
    for poison in (1e3, -1e3):
        _check_actor(trial.loss(poison), data)
        other, slopes = trial.learn(data, poison)
        _same(values, other, "the values of invalid actions count: mask them before a maximum, mean or sum")
        _same(gradients, slopes, "the gradient goes through values of invalid actions: mask them first")
    _check_end_of_horizon(trial, data, values)
    _check_priorities(trial, data)
    _check_target(trial.loss(), data)
    _check_state(trial, data)


class _Trial:
    """Losses of one kind, all with the same weights, and the data they are tried on."""

    def __init__(self, make: LossFactory, network: NetworkFactory, seed: int) -> None:
        scenario = small_scenario(horizon=4, arrival_rate=2.0)
        self._make, self._network, self._seed = request_loss(make), network, seed
        self._sizes = Sizes.of(Simulator(scenario, 1, one_hot=True))
        self._env = NFVEnv(scenario, ENVS, observations=network(self._sizes).observations(), seed=seed)
        # Never valid in the data; the last action, `reject`, always is.
        self._off = torch.rand(self._sizes.actions, generator=torch.Generator().manual_seed(seed)) < 0.3
        self._off[-1] = False

    def loss(self, poison: float = 0.0, seed: int | None = None) -> Any:
        """A new loss whose network's values of the actions that are never valid are off by ``poison``."""
        torch.manual_seed(self._seed if seed is None else seed)
        loss = self._make(
            lambda sizes, outputs=1: Poisoned(self._network(sizes, outputs), self._off, poison), self._sizes
        )
        for name in ("actor", "prepare"):
            assert hasattr(loss, name), f"the loss has no {name!r}; see RequestLoss"
        return loss

    def collect(self) -> TensorDictBase:
        """A batch [ENVS, STEPS]: the choice of a new loss's actor and, every other step, a random valid action."""
        actor = self.loss().actor
        torch.manual_seed(self._seed)
        state = self._env.reset()
        steps = []
        for step in range(STEPS):
            state["action_mask"] &= ~self._off
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                state = actor(state)
            taken = state["action_mask"].gather(-1, state["action"].unsqueeze(-1))
            assert taken.all(), "the actor takes invalid actions: give it action_mask_key (see greedy_actor)"
            if step % 2:
                state["action"] = torch.multinomial(state["action_mask"].float(), 1).squeeze(-1)
            after, following = self._env.step_and_maybe_reset(state)
            after["next", "action_mask"] &= ~self._off
            steps.append(after.clone())
            state = following
        return torch.stack(steps, 1)

    def learn(self, data: TensorDictBase, poison: float = 0.0, loss: Any = None) -> tuple[Numbers, Numbers]:
        """What a new loss, or ``loss``, says of ``data``, and the gradient of every parameter that has one."""
        loss = self.loss(poison) if loss is None else loss
        torch.manual_seed(self._seed)
        values = loss(loss.prepare(data.clone()))
        losses = [key for key in values.keys() if key.startswith("loss")]  # noqa: SIM118  a TensorDict iterates its batch
        assert losses, "forward returns no entry whose name starts with 'loss'"
        for key, value in values.items():
            assert value.numel() == 1, f"{key} has shape {list(value.shape)}; reduce it to one number"
            assert torch.isfinite(value).all(), f"{key} is {float(value.detach())} on ordinary data"
        sum(values[key] for key in losses).backward()
        gradients = {name: value.grad.clone() for name, value in loss.named_parameters() if value.grad is not None}
        assert all(torch.isfinite(value).all() for value in gradients.values()), "a gradient is not finite"
        assert any(value.any() for value in gradients.values()), "no parameter gets a gradient: all under no_grad?"
        return {key: value.detach().clone() for key, value in values.items()}, gradients


def _check_rows(rows: TensorDictBase) -> None:
    assert isinstance(rows, TensorDictBase), f"prepare returns a {type(rows).__name__}; return a TensorDict of rows"
    assert rows.batch_dims == 1 and len(rows), f"prepare returns batch size {list(rows.shape)}; flatten it to rows [R]"
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), batch_size=2)
    buffer.extend(rows)
    buffer.sample()


def _check_actor(loss: RequestLoss, data: TensorDictBase) -> None:
    """The actor on states whose invalid actions have the best or the worst values."""
    mask = data["action_mask"]
    for way in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with torch.no_grad(), set_exploration_type(way):
            action = loss.actor(data.exclude("action", "next").clone())["action"]
        valid = mask.gather(-1, action.unsqueeze(-1)).all()
        assert valid, "the actor takes invalid actions where their values are high: give it action_mask_key"


def _check_end_of_horizon(trial: _Trial, data: TensorDictBase, values: Numbers) -> None:
    """Other observations after ``done`` must not matter."""
    over = data["next", "done"].squeeze(-1)
    changed = data.clone()
    seen = changed["next", "observation"]
    seen[over] = torch.rand_like(seen[over]) * 100
    other, _ = trial.learn(changed)
    names = [key for key in values if key.startswith("loss")]
    first, second = ({key: found[key] for key in names} for found in (values, other))
    _same(first, second, "what follows the end of a horizon counts; stop at done")


def _check_priorities(trial: _Trial, data: TensorDictBase) -> None:
    """Priorities fit their memory. Half of the rows alone and the other half alone average to all of them."""
    rows = trial.loss().prepare(data.clone())

    def learn(weights: Tensor | None) -> TensorDictBase:
        loss, batch = trial.loss(), rows.clone()
        if weights is not None:
            batch.set("priority_weight", weights)
        torch.manual_seed(0)
        values = loss(batch).detach()
        return values.select(*(key for key in values.keys() if key.startswith("loss"))).set("rows", batch)  # noqa: SIM118

    priority = learn(None)["rows"].get("td_error", None)
    if priority is None:
        return
    assert priority.shape == (len(rows), 1), f"td_error has shape {list(priority.shape)}; write one of each row, [R, 1]"
    assert torch.isfinite(priority).all() and (priority >= 0).all(), "td_error is no finite number of at least 0"
    half = (torch.arange(len(rows)) % 2).float()
    whole, first, second = (
        learn(weights).exclude("rows") for weights in (torch.full((len(rows),), 0.5), half, 1 - half)
    )
    uncounted = "weights of rows (priority_weight) do not count: take the mean by MaskedLoss.mean"
    assert any(not torch.equal(first[key], second[key]) for key in first.keys()), uncounted  # noqa: SIM118
    mixed = first * half.mean() + second * (1 - half.mean())
    _same(whole, learn(None).exclude("rows"), "equal weights of rows change the loss: take the mean by MaskedLoss.mean")
    _same(whole, mixed, uncounted)


def _check_target(loss: Any, data: TensorDictBase) -> None:
    """An updater of TorchRL moves the target network, before the first update and after it."""
    if not has_target(loss):
        return
    loss(loss.prepare(data.clone()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        HardUpdate(loss, value_network_update_interval=1).step()


def _check_state(trial: _Trial, data: TensorDictBase) -> None:
    """Another loss with the same state says the same."""
    first, second = trial.loss(), trial.loss(seed=-1)
    trial.learn(data, loss=first)
    second.load_state_dict({name: value.clone() for name, value in first.state_dict().items()})
    complaint = "a loss that loads the state of another goes on with other numbers: keep them in buffers"
    _same(trial.learn(data, loss=first)[0], trial.learn(data, loss=second)[0], complaint)


def _same(first: Any, second: Any, complaint: str) -> None:
    """Equal to rounding: a constant added to values that are then left out costs the others nothing."""
    a, b = (TensorDict(dict(x)) if isinstance(x, dict) else x for x in (first, second))
    assert set(a.keys(True, True)) == set(b.keys(True, True)), complaint
    for key in a.keys(True, True):
        assert torch.allclose(a[key].double(), b[key].double(), rtol=1e-5, atol=1e-7), f"{complaint} ({key})"
