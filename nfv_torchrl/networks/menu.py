"""A network that values the walks of a menu, with the same weights on networks of any size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from nfv_torchrl.networks.base import QNetwork, Sizes
from nfv_torchrl.networks.layers import perceptron
from nfv_torchrl.observations.menu_layout import FACTORS, ROW, MenuShape
from nfv_torchrl.settings.values import Activation, NotNegative, OneOf, Width

FORMS = ("price", "free")


class MenuNetwork(QNetwork):
    r"""Q-values made of what is known, and of two perceptrons for what has to be learned.

    $$
    Q(s, k) = w_{acc} - w_{cost} \Big(\frac{\phi_k}{\phi_0} - 1\Big) + V(s) - \frac{l(s)}{\bar l} \, \tau(s) \, g(s, k),
    \qquad Q(s, \mathrm{reject}) = V(s)
    $$

    The first two terms are the reward of ``admission_regret`` for walk k, whose cost is $\phi_k$. V says how good the
    state of the network is, with this request in hand. The last term is what the walk does to later requests: a bid
    price g for each unit that the request holds, times its demand, the load l of its chain over the mean over services,
    and what its lifetime makes of it, $\tau$: 1 where lifetimes are hidden, else as ``PlanEnv`` (in training) or
    ``MenuPlanner`` (when it acts) charges for a stay. So a light request is hardly ever refused, whatever g says. The
    form ``free`` leaves out both factors.

    V and g begin at zero. An untrained network takes the cheapest walk, as ``myopic_optimal`` does.

    Reads ``observation`` float32 [..., P] of ``PlanEnv``.

    Args:
        sizes: observation, actions and services of ``PlanEnv``.
        outputs: outputs per action.
        hidden: neurons of each hidden layer, of both perceptrons.
        activation: name of a ``torch.nn`` activation.
        form: ``price`` or ``free``.
        w_acc: of the reward.
        w_cost: of the reward.
    """

    in_keys = ("observation",)
    any_size = True

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Sequence[Width] = (64, 64),
        activation: Activation = "ReLU",
        form: Annotated[str, OneOf(*FORMS)] = "price",
        w_acc: NotNegative = 1.0,
        w_cost: NotNegative = 0.1,
    ) -> None:
        super().__init__()
        self.outputs, self.form = outputs, form
        self.w_acc, self.w_cost = float(w_acc), float(w_cost)
        self.shape = MenuShape.of(sizes.services, sizes.actions - 1, asked=sizes.candidate_features > 0)
        seen = self.shape.state - FACTORS
        self.value = perceptron(seen, outputs, hidden, activation)
        self.price = perceptron(seen + self.shape.row, outputs, hidden, activation)
        for layers in (self.value, self.price):
            nn.init.zeros_(layers[-1].weight)
            nn.init.zeros_(layers[-1].bias)

    def forward(self, observation: Tensor) -> Tensor:
        """Values of all walks and of reject, last."""
        state, rows = self._split(observation)
        value = self.value(state[..., FACTORS:]).unsqueeze(-2)
        values = torch.cat([self._known(rows) + value - self._price(state, rows), value], -2)
        return values.squeeze(-1) if self.outputs == 1 else values

    def values_of(self, observation: Tensor, action: Tensor) -> Tensor:
        """The values of one action each, to within rounding, without those of the other walks.

        Args:
            observation: float32 [B, P].
            action: int64 [B, 1].

        Returns:
            float32 [B, outputs].
        """
        state, rows = self._split(observation)
        walk = action.clamp(max=self.shape.rows - 1).unsqueeze(-1).expand(-1, -1, rows.shape[-1])
        row = rows.gather(-2, walk)
        beyond = (self._known(row) - self._price(state, row)).squeeze(-2)
        return self.value(state[..., FACTORS:]) + beyond.masked_fill(action == self.shape.rows, 0.0)

    def _known(self, rows: Tensor) -> Tensor:
        """The reward of walks [..., K, 1]."""
        return self.w_acc - self.w_cost * rows[..., ROW.regret, None]

    def _price(self, state: Tensor, rows: Tensor) -> Tensor:
        """The last term of the values of walks, [..., K, outputs]."""
        factors, seen = state.split([FACTORS, self.shape.state - FACTORS], -1)
        # The first layer sees the state and a walk. What it makes of the state is the same for all walks.
        first, *later = self.price
        of_state, of_rows = first.weight.split([seen.shape[-1], rows.shape[-1]], -1)
        price = linear(seen, of_state, first.bias).unsqueeze(-2) + linear(rows, of_rows)
        for layer in later:
            price = layer(price)
        if self.form == "price":
            price = price * factors.prod(-1, keepdim=True).unsqueeze(-1)
        return price

    def _split(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers of the state [..., S] and of the walks [..., K, R]."""
        state, rows = observation.split([self.shape.state, self.shape.rows * self.shape.row], -1)
        return state, rows.unflatten(-1, (self.shape.rows, self.shape.row))
