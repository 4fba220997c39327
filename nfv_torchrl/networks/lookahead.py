"""A network that knows what it takes to finish a request, and learns what that does to later ones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfv_torchrl.networks.base import QNetwork, Sizes
from nfv_torchrl.networks.layers import perceptron
from nfv_torchrl.observations import ObservationPart
from nfv_torchrl.observations.lookahead import PRICE, ROW, LookaheadObservation
from nfv_torchrl.observations.menu import AT_ONCE
from nfv_torchrl.observations.standing import FACTORS, STATE
from nfv_torchrl.settings.values import Activation, NotNegative, Share, Width

TIE = 1e-5
"""What is taken off rows that are not on the cheapest walk, so that of equals the one that is known to go on is
taken."""
DEAD = 0.01
"""What is taken off rows from which the request cannot be finished: refusing is no worse, and sooner."""


class LookaheadNetwork(QNetwork):
    r"""Q-values made of what is known, and of learned functions of the state alone.

    $$
    Q(s, a) = V(s) + \max_{w} \Big[ w_{acc} - w_{cost} \Big(\frac{\phi_w}{\phi_0} - 1\Big) - \lambda(s) \,
    \frac{\pi_w - \pi_{min}}{\phi_0} \Big] - \frac{l(s)}{\bar l} \, \tau(s) \, g(s),
    \qquad Q(s, \mathrm{reject}) = V(s)
    $$

    for a step a after which the request can be finished, by the cheapest way w and by the way that is cheapest at
    raised prices. $\phi_w$ is the cost of the whole walk, $\phi_0$ the least cost when the request came: the first two
    terms are the reward of ``admission_regret``. $\pi_w$ is what the walk costs at raised prices, so $\lambda$ says how
    much it is worth to spare what is nearly used up. g is a bid price for each unit of demand, the load l of the chain
    over the mean over services (of several kinds of resources the largest), times what its stay makes of it, $\tau$ (1
    where lifetimes are hidden): whether to serve the request at all. V says how good the state is.

    V, $\lambda$ and g are two small perceptrons of the state that begin at zero: no row is reordered by anything that
    was learned about a row, only prices are. Untrained, the network takes the cheapest walk: with ``exact`` that of
    ``myopic_optimal``. $\lambda$ is never below zero.

    Reads ``lookahead`` of ``LookaheadObservation`` and ``action_mask`` bool [..., A]. Actions without a row get 0.

    Args:
        sizes: number of actions.
        outputs: outputs per action.
        hidden: neurons of each hidden layer, of both perceptrons.
        activation: name of a ``torch.nn`` activation.
        exact: see ``LookaheadObservation``; False: lower bounds in place of exact walks.
        price: likewise, of the raised prices.
        w_acc: of the reward.
        w_cost: of the reward.
        at_once: see ``LookaheadObservation``; 0: all is paid in proportion to the stay.
    """

    in_keys = (
        ("lookahead", "features"),
        ("lookahead", "action"),
        ("lookahead", "mask"),
        ("lookahead", "state"),
        "action_mask",
    )
    any_size = True
    any_services = True

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Sequence[Width] = (32, 32),
        activation: Activation = "ReLU",
        exact: bool = True,
        price: NotNegative = PRICE,
        w_acc: NotNegative = 1.0,
        w_cost: NotNegative = 0.1,
        at_once: Share = AT_ONCE,
    ) -> None:
        super().__init__()
        self.outputs, self.exact, self.at, self.at_once = outputs, bool(exact), float(price), float(at_once)
        self.w_acc, self.w_cost = float(w_acc), float(w_cost)
        seen = len(STATE) - FACTORS
        self.value = perceptron(seen, outputs, hidden, activation)
        self.prices = perceptron(seen, 2 * outputs, hidden, activation)
        for layers in (self.value, self.prices):
            nn.init.zeros_(layers[-1].weight)
            nn.init.zeros_(layers[-1].bias)

    def observations(self) -> list[ObservationPart]:
        """See ``QNetwork``."""
        return [LookaheadObservation(exact=self.exact, price=self.at, at_once=self.at_once)]

    def forward(self, features: Tensor, action: Tensor, row_mask: Tensor, state: Tensor, action_mask: Tensor) -> Tensor:
        """Values of all actions."""
        factors, seen = state.split([FACTORS, state.shape[-1] - FACTORS], -1)
        spare, bid = self.prices(seen).unsqueeze(-2).split(self.outputs, -1)
        value = self.value(seen).unsqueeze(-2)
        # Never below zero; but the gradient goes on there, so that what fell to zero can rise again.
        spare = spare + (spare.clamp(min=0.0) - spare).detach()
        ways = [
            self.w_acc - self.w_cost * (cost - 1.0) - spare * regret
            for cost, regret in (
                (features[..., ROW.cost, None], features[..., ROW.priced_regret, None]),
                (features[..., ROW.spare_cost, None], features[..., ROW.spare_regret, None]),
            )
        ]
        gain = (
            torch.maximum(*ways)
            - self._paid(bid, *factors.unsqueeze(-2).split(1, -1))
            - TIE * (1.0 - features[..., ROW.planned, None])
        )
        dead = torch.full_like(gain, -DEAD)
        gain = torch.where(features[..., ROW.fits, None] > 0, gain, dead)
        gain = gain.masked_fill(features[..., ROW.reject, None] > 0, 0.0)
        return self._place(value + gain, action, row_mask, action_mask)

    def _paid(self, bid: Tensor, demand: Tensor, stay: Tensor) -> Tensor:
        """The bid price for demand and stay.

        What follows a request hardly tells a short stay from a long one. Fitted by least squares, a price that is paid
        in proportion to the stay comes out too low for the usual stay, the more so the more stays differ. So with
        ``at_once`` 0 the gradient leaves the factor out.
        """
        if self.at_once > 0.0:
            return demand * stay * bid
        once = demand * bid
        return once + (once * (stay - 1.0)).detach()

    def _place(self, scores: Tensor, action: Tensor, row_mask: Tensor, action_mask: Tensor) -> Tensor:
        """The rows' scores [..., C, outputs] at the places of their actions; padding writes to a column that is cut
        off."""
        actions = action_mask.shape[-1]
        place = action.masked_fill(~row_mask, actions).unsqueeze(-1).expand_as(scores)
        values = scores.new_zeros(*action_mask.shape[:-1], actions + 1, self.outputs)
        values = values.scatter(-2, place, scores)[..., :actions, :]
        return values.squeeze(-1) if self.outputs == 1 else values
