"""Q-learning from returns over several steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.dqn import DQN
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Count, Distance, Share, StopKey


class NStepDQN(DQN):
    r"""The error of deep Q-learning with n rewards before the look ahead.

    $$
    \Big(\sum_{i=0}^{k-1} \gamma^i r_{t+i}
    + \gamma^k (1 - d_{t+k}) \max_{a' \in A_p(s_{t+k})} \bar Q(s_{t+k}, a') - Q(s_t, a_t)\Big)^2
    $$

    (Watkins, "Learning from Delayed Rewards", 1989; as used by Hessel et al., "Rainbow", AAAI 2018, eq. 1). k is n, or
    fewer where the request, the horizon or the collected batch ends sooner: rewards of another request are never
    summed, and the discount of the bootstrap is that of the steps really summed. What was explored within the n steps
    is not corrected for.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        n: most rewards to sum.
        gamma: discount per step.
        double: choose the next action by the online network.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.
        stop_at: key that ends the look ahead: ``request_done``, or ``done`` to look across requests.

    Keys read: those of ``DQN``, whose ``next`` is k steps on and whose ``reward`` is the sum, and
    ``steps_to_next_obs`` int64 [1], k. ``prepare`` makes them from a batch [B, T], time in dimension 1. Writes
    ``loss`` []. Logs nothing else.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        n: Count = 3,
        gamma: Share = 1.0,
        double: bool = False,
        loss_function: Distance = "l2",
        stop_at: StopKey = "request_done",
    ) -> None:
        super().__init__(network, sizes, gamma=gamma, double=double, loss_function=loss_function, stop_at=stop_at)
        if n < 1:
            raise ScenarioError(f"loss.n is {n}; at least one reward is summed")
        self.n, self.gamma, self.stop_at = n, gamma, stop_at

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Transitions of up to n steps, [B, T] flattened."""
        return n_step_transitions(data, self.in_keys, stop_at=self.stop_at, n=self.n, gamma=self.gamma)


def n_step_transitions(
    data: TensorDictBase, keys: Sequence[NestedKey], *, stop_at: str, n: int, gamma: float
) -> TensorDictBase:
    """Transitions of up to ``n`` steps from a batch [B, T], flattened: see ``NStepDQN``.

    Args:
        data: as collected, with ``reward`` [1], ``done`` [1] and ``stop_at`` [1] under ``next``.
        keys: what the transitions keep; ``next`` is that of the last step of a sum.
        stop_at: key that ends a sum, as the end of the horizon does.
        n: most rewards to sum.
        gamma: discount per step.
    """
    after = data.get("next")
    stop = after.get(stop_at) | after.get("done")
    total, steps, _ = n_step_returns(after.get("reward").squeeze(-1), stop.squeeze(-1), n, gamma)
    out = data.select(*keys)
    out.set("next", out.get("next")[last_of_sums(steps)])
    out.set(("next", "reward"), total.unsqueeze(-1))
    out.set("steps_to_next_obs", steps.unsqueeze(-1))
    return out.reshape(-1)


def n_step_returns(reward: Tensor, stop: Tensor, n: int, gamma: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Discounted sums of up to ``n`` rewards from each step on.

    Args:
        reward: float32 [B, T].
        stop: bool [B, T]; nothing after such a step belongs to the same sum.
        n: most rewards to sum.
        gamma: discount of what follows a step: one number, or float32 [B, T] if it differs from step to step.

    Returns:
        The sums, float32 [B, T]; how many rewards each has, int64 [B, T]; the discount of what follows the last of
        them, the product of theirs, float32 [B, T].
    """
    discount = torch.as_tensor(gamma, dtype=reward.dtype, device=reward.device).expand_as(reward)
    total, steps, ahead = reward.clone(), torch.ones_like(stop, dtype=torch.int64), discount.clone()
    going = ~stop  # whether the sum that begins here is still open
    for i in range(1, min(n, reward.shape[1])):
        # The last i steps have no i-th successor: their sums end with the batch.
        begin = slice(0, reward.shape[1] - i)
        still = going[:, begin]
        total[:, begin] += ahead[:, begin] * reward[:, i:] * still
        steps[:, begin] += still
        ahead[:, begin] *= torch.where(still, discount[:, i:], 1.0)
        going[:, begin] = still & ~stop[:, i:]
    return total, steps, ahead


def last_of_sums(steps: Tensor) -> tuple[Tensor, Tensor]:
    """Where in [B, T] the last reward of each sum is, to index with, from ``steps`` int64 [B, T]."""
    rows = torch.arange(steps.shape[0], device=steps.device).unsqueeze(-1)
    return rows, torch.arange(steps.shape[1], device=steps.device) + steps - 1
