"""Returns over many steps across requests, discounted by the time that passes."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from nfv_torchrl.losses.centred import CentredDQN
from nfv_torchrl.networks import NetworkFactory, Sizes
from nfv_torchrl.settings.values import AtLeastOne, Count, Distance, Share


class SlotDiscountDQN(CentredDQN):
    r"""n-step double Q-learning across requests with a discount per slot.

    $$
    y_t = \sum_{i=0}^{k-1} \gamma^{\tau_{t+i} - \tau_t} \big(r_{t+i} - e_{t+i} \bar r_{m(t+i)}\big)
    + \gamma^{\tau_{t+k} - \tau_t} (1 - d_{t+k}) \bar Q(s_{t+k}, a^*)
    $$

    with $\tau_t$ the slot of step t: requests of the same slot count alike, and what a decision does after many
    slots counts the less the more time has passed, however many requests came (the discount of a semi-Markov process:
    Bradtke, Duff, "Reinforcement Learning Methods for Continuous-Time Markov Decision Problems", NeurIPS 1994; n steps
    as in ``NStepDQN``). The means $\bar r_m$ are those of ``CentredDQN``, by service unless told otherwise.
    Many rewards are summed before the first value is asked, since the effect of an acceptance shows tens of requests
    later, at other places of the network. Slots that belong to a warm-up are not counted and do not discount.

    Args:
        network: factory of the Q-network.
        sizes: sizes of observation and actions.
        gamma: discount per slot; 1 within it.
        rate_over: time constant of the running mean, requests.
        n: most rewards to sum; ``collector.steps`` should be larger.
        double: choose the next action by the online network, else by the target network.
        by_service: a mean for each service type, instead of one for all.
        loss_function: ``l2``, ``smooth_l1`` or ``l1``.

    Keys, what it writes and what it logs: see ``AcrossRequests``.
    """

    def __init__(
        self,
        network: NetworkFactory,
        sizes: Sizes,
        *,
        gamma: Share = 0.8,
        rate_over: AtLeastOne = 20_000,
        n: Count = 200,
        double: bool = True,
        by_service: bool = True,
        loss_function: Distance = "l2",
    ) -> None:
        super().__init__(
            network,
            sizes,
            gamma=gamma,
            rate_over=rate_over,
            n=n,
            double=double,
            by_service=by_service,
            loss_function=loss_function,
        )

    def request_discount(self, after: TensorDictBase) -> Tensor:
        """One factor per slot that ended with the step: see ``AcrossRequests``."""
        return self.gamma ** after.get(("outcome", "slots_closed")).squeeze(-1)
