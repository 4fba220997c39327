"""A network that sets prices of VMs and links and refuses requests, for the exact search of learned prices."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.planners.learned_prices import ADMIT, LINK, VM, Head, PriceWeights
from nfv_torchrl.settings.values import Neurons, OneOf, Positive


class Rule(NamedTuple):
    """A hand-tuned rule, in multiples of the mean unit cost of VMs (50 $ in the paper's ranges)."""

    price: float  # p
    threshold: float | None  # priced cost above which the reference load (4.3 Mcycles/s in the paper) is refused


STEEPNESS = 3000.0
RULES = {"priced": Rule(64.0, None), "priced_admit": Rule(32.0, 75.0)}
"""p = 3200 $ without refusal; p = 1600 $ and refusal above 16,000 $."""

BEGINNINGS = ("myopic_optimal", *RULES)
Beginning = Annotated[str, OneOf(*BEGINNINGS)]

LARGEST_UNIT = 1e9
"""Prices from any float32 weights stay finite in float64."""


class PriceHead(nn.Module):
    r"""One function: $f(x) = w \cdot (x, 1) + \sum_h v_h \tanh(u_h \cdot (x, 1))$.

    ``forward`` takes features float32 [..., F] to values [...]. ``w`` and ``v`` begin at zero, so f begins at zero.

    Args:
        features: F.
        hidden: neurons H of the hidden layer; 0 leaves a linear function.
        learned: whether its weights are parameters; otherwise they stay as they begin, or as a policy file has them.
    """

    linear: Tensor
    hidden: Tensor
    out: Tensor

    def __init__(self, features: int, hidden: int, *, learned: bool = True) -> None:
        super().__init__()
        weights = {
            "linear": torch.zeros(features + 1),
            "hidden": torch.randn(hidden, features + 1) / (features + 1) ** 0.5,
            "out": torch.zeros(hidden),
        }
        for name, values in weights.items():
            if learned:
                self.register_parameter(name, nn.Parameter(values))
            else:
                self.register_buffer(name, values)

    def forward(self, x: Tensor) -> Tensor:
        """The values of the function."""
        x = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        return x @ self.linear + torch.tanh(x @ self.hidden.T) @ self.out


class PriceNetwork(nn.Module):
    """Prices of VMs and links and the refusal of requests, with the same weights on networks of any size.

    Its inputs are ``VmFeatures``, ``LinkFeatures`` and ``AdmitFeatures`` of ``planners/learned_prices.py``. At
    first all outputs are zero: no prices, nothing refused.

    Args:
        hidden: neurons of the hidden layer of each of the three functions.
        begin: ``myopic_optimal`` (all zero), ``priced`` or ``priced_admit``: near the hand-tuned rule of that name.
        learn_prices: whether prices are learned too. If not, they stay as they begin and only the refusal is learned:
            far less work where searches at raised prices are slow.
        price_unit: prices and priced costs are in this many mean unit costs of the network's VMs, so it says how large
            the steps of a search are.

    Raises:
        ScenarioError: ``hidden`` is negative, ``price_unit`` not in (0, 1e9], or there is no such ``begin``.
    """

    any_size = True
    any_services = True

    def __init__(
        self,
        *,
        hidden: Neurons = 0,
        begin: Beginning = "myopic_optimal",
        learn_prices: bool = True,
        price_unit: Positive = 4.0,
    ) -> None:
        super().__init__()
        if hidden < 0:
            raise ScenarioError(f"network.hidden: {hidden}; use 0 (linear functions) or more")
        if not 0 < price_unit <= LARGEST_UNIT:
            raise ScenarioError(f"network.price_unit: {price_unit}; use a number above 0, at most {LARGEST_UNIT:g}")
        if begin not in BEGINNINGS:
            raise ScenarioError(f"network.begin: {begin!r}; use one of {', '.join(BEGINNINGS)}")
        self.price_unit = float(price_unit)
        self.vm = PriceHead(len(VM), hidden, learned=learn_prices)
        self.link = PriceHead(len(LINK), hidden, learned=learn_prices)
        self.admit = PriceHead(len(ADMIT), hidden)
        if begin in RULES:
            self._begin_at(RULES[begin])

    @torch.no_grad()
    def _begin_at(self, rule: Rule) -> None:
        """Prices p (M^u - 1) / (M - 1), and refusal above a priced cost if the rule refuses."""
        used = np.linspace(0.01, 1.0, 100)
        price = rule.price / self.price_unit * (STEEPNESS**used - 1.0) / (STEEPNESS - 1.0)
        powers = np.stack([used, used**4, used**16, np.ones_like(used)], axis=1)
        # A price is used share times f, so f is fitted to price / used, weighted by used.
        fitted = np.linalg.lstsq(powers * used[:, None], price, rcond=None)[0]
        for head, at in ((self.vm, VM), (self.link, LINK)):
            for column, weight in zip((at.used, at.used_pow4, at.used_pow16), fitted[:3], strict=True):
                head.linear[column] = float(weight)
            head.linear[-1] = float(fitted[3])
        if rule.threshold is not None:
            self.admit.linear[ADMIT.priced] = 3.0 / float(np.log(rule.threshold / self.price_unit))

    def weights(self) -> PriceWeights:
        """The weights as the compiled search takes them."""

        def head(module: PriceHead) -> Head:
            parts = (module.linear, module.hidden, module.out)
            return Head(*(np.ascontiguousarray(part.detach().cpu().numpy(), np.float64) for part in parts))

        return PriceWeights(head(self.vm), head(self.link), head(self.admit), self.price_unit)
