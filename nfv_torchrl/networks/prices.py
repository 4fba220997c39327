"""A network that prices VMs and links and judges requests, for the exact search (``planners/learned_prices.py``)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.learned_prices import ADMIT_FEATURES, LINK_FEATURES, VM_FEATURES, Head, PriceWeights


class PriceHead(nn.Module):
    r"""One function: :math:`f(x) = w \cdot (x, 1) + \sum_h v_h \tanh(u_h \cdot (x, 1))`.

    ``forward`` takes features float32 [..., F] to values [...]. ``w`` and ``v`` begin at zero, so f begins at zero.

    Args:
        features: F.
        hidden: neurons H of the hidden layer; 0 leaves a linear function.
    """

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Parameter(torch.zeros(features + 1))
        self.hidden = nn.Parameter(torch.randn(hidden, features + 1) / (features + 1) ** 0.5)
        self.out = nn.Parameter(torch.zeros(hidden))

    def forward(self, x: Tensor) -> Tensor:
        """Values."""
        x = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        return x @ self.linear + torch.tanh(x @ self.hidden.T) @ self.out


class PriceNetwork(nn.Module):
    """Prices of VMs and links and the refusal of requests, the same weights for all of them on networks of any size.

    Its inputs are ``VM_FEATURES``, ``LINK_FEATURES`` and ``ADMIT_FEATURES`` of ``planners/learned_prices.py``. At
    first all outputs are zero: no prices, nothing refused.

    Args:
        hidden: neurons of the hidden layer of each of the three functions.

    Raises:
        ScenarioError: ``hidden`` is negative.
    """

    any_size = True

    def __init__(self, *, hidden: int = 4) -> None:
        super().__init__()
        if hidden < 0:
            raise ScenarioError(f"network.hidden: {hidden}; use 0 (linear functions) or more")
        self.vm = PriceHead(len(VM_FEATURES), hidden)
        self.link = PriceHead(len(LINK_FEATURES), hidden)
        self.admit = PriceHead(len(ADMIT_FEATURES), hidden)

    def weights(self) -> PriceWeights:
        """The weights as the compiled search takes them."""

        def head(module: PriceHead) -> Head:
            parts = (module.linear, module.hidden, module.out)
            return Head(*(np.ascontiguousarray(part.detach().cpu().numpy(), np.float64) for part in parts))

        return PriceWeights(head(self.vm), head(self.link), head(self.admit))
