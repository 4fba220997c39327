"""Differential Q-learning: the average reward of a request instead of a discount."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses.across_requests import AcrossRequests
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import Count, Distance, StepSize


class DifferentialDQN(AcrossRequests):
    r"""Q-learning for the highest average reward per request, without a discount.

    $$
    \delta = r - e \bar r + (1 - d') \bar Q(s', a^*) - Q(s, a), \quad
    \bar r \leftarrow \bar r + \beta \, \frac{\sum_B e \, \delta}{\sum_B e}
    $$

    with e = 1 for a step that ends a request and 0 for the others, so that the reward rate $\bar r$ is one per
    request and the steps of a walk cost no time, and B the batch (Wan, Naik, Sutton, "Learning and Planning in
    Average-Reward Markov Decision Processes", ICML 2021, eqs. 5 to 7; as with their options, a decision lasts as long
    as a request). Learning the rate from the errors of Q, and not from the rewards, makes it that of the greedy policy
    and not of the one that explores. With n > 1 sum and errors are those of ``AcrossRequests``. Values are fixed up to
    a constant by the equation and pinned by the horizon's end, where they are 0.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        rate_step: beta, for each update.
        n: most rewards to sum.
        double: choose the next action by the online network, else by the target network.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.

    Keys, what it writes and what it logs: see ``AcrossRequests``.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        rate_step: StepSize = 0.05,
        n: Count = 1,
        double: bool = True,
        loss_function: Distance = "l2",
    ) -> None:
        if not 0 < rate_step <= 1:
            raise ScenarioError(f"loss.rate_step is {rate_step}; use a number above 0, at most 1")
        super().__init__(network, sizes, n=n, double=double, loss_function=loss_function)
        self.rate_step = rate_step

    def request_discount(self, after: TensorDictBase) -> float:
        """No discount: see ``AcrossRequests``."""
        return 1.0

    def learn_rate(self, error: Tensor, requests: Tensor) -> None:
        """The second equation above."""
        total = requests.sum()
        # A batch without the end of a request says nothing of the rate.
        self.rate += self.rate_step * (error * (requests > 0)).sum() / total.clamp(min=1.0)
