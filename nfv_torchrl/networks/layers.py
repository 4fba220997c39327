"""Layers that the networks are built from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchrl.modules import MLP

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.limits import check_memory

WEIGHT_BYTES = 20
"""Of each weight in training: itself, its gradient, its target network's twin and two averages of the optimiser."""


def perceptron(
    inputs: int, outputs: int, hidden: Sequence[int], activation: str = "ReLU", *, noisy: bool = False
) -> MLP:
    """Linear layers with an activation between them.

    Args:
        inputs: size of the last dimension of what it reads.
        outputs: size of the last dimension of what it returns.
        hidden: neurons of each hidden layer.
        activation: name of a ``torch.nn`` activation.
        noisy: ``NoisyLinear`` layers instead of ``torch.nn.Linear``.

    Raises:
        ScenarioError: there is too little memory for that many weights.
    """
    sizes = [inputs, *hidden, outputs]
    check_weights_fit(hidden, (1 + noisy) * sum(float(a) * b for a, b in pairwise(sizes)))
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(hidden),
        activation_class=activation_class(activation),
        layer_class=NoisyLinear if noisy else nn.Linear,
    )


def check_weights_fit(hidden: Sequence[int] | int, weights: float) -> None:
    """Refuse ``weights`` numbers that there is no memory for; ``hidden`` is the setting that they follow from.

    Raises:
        ScenarioError: so it is; the message names the GB.
    """
    check_memory({f"network.hidden={hidden if isinstance(hidden, int) else list(hidden)}": WEIGHT_BYTES * weights})


def activation_class(name: str) -> type[nn.Module]:
    """The activation of ``torch.nn`` with that name.

    Raises:
        ScenarioError: there is none.
    """
    found = getattr(nn.modules.activation, name, None) if isinstance(name, str) else None
    if not isinstance(found, type) or found.__module__ != nn.modules.activation.__name__:
        raise ScenarioError(f"network.activation: {name!r:.60} is no activation of torch.nn; use ReLU or Tanh, say")
    return found


class NoisyLinear(nn.Module):
    r"""A linear layer with learned noise on its weights, for exploration without epsilon.

    $$
    y = (\mu^w + \sigma^w \odot \varepsilon^w) x + \mu^b + \sigma^b \odot \varepsilon^b, \qquad
    \varepsilon^w_{ij} = f(\varepsilon_i) f(\varepsilon_j), \quad \varepsilon^b_i = f(\varepsilon_i), \quad
    f(z) = \mathrm{sgn}(z) \sqrt{|z|}
    $$

    with standard normal $\varepsilon$ (Fortunato et al., "Noisy Networks for Exploration", ICLR 2018, eqs. 9
    to 11). In training mode every forward pass draws new noise, one draw for each row of the first dimension: each
    environment explores with weights of its own at every step, and online and target network have noise of their own
    in every update. In evaluation mode the weights are their means.

    Args:
        in_features: size of the input's last dimension.
        out_features: size of the output's last dimension.
        bias: with a bias.
        std_init: sigma_0; the initial $\sigma$ is ``std_init / sqrt(in_features)``.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        bias: bool = True,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
        std_init: float = 0.5,
    ) -> None:
        super().__init__()
        bound, sigma = 1 / math.sqrt(in_features), std_init / math.sqrt(in_features)
        shape = (out_features, in_features)
        self.weight_mu = nn.Parameter(torch.empty(shape, device=device, dtype=dtype).uniform_(-bound, bound))
        self.weight_sigma = nn.Parameter(torch.full(shape, sigma, device=device, dtype=dtype))
        self.bias_mu = self.bias_sigma = None
        if bias:
            self.bias_mu = nn.Parameter(torch.empty(out_features, device=device, dtype=dtype).uniform_(-bound, bound))
            self.bias_sigma = nn.Parameter(torch.full((out_features,), sigma, device=device, dtype=dtype))

    def forward(self, x: Tensor) -> Tensor:
        """From [..., in_features] to [..., out_features]."""
        mean = functional.linear(x, self.weight_mu, self.bias_mu)
        if not self.training:
            return mean
        # (sigma * outer(f_out, f_in)) x = f_out * (sigma (f_in * x)): no matrix of noise is ever made.
        out_features, in_features = self.weight_sigma.shape
        noise_in = _factor(x, in_features)
        noise_out = _factor(x, out_features)
        return mean + noise_out * functional.linear(x * noise_in, self.weight_sigma, self.bias_sigma)


def _factor(x: Tensor, size: int) -> Tensor:
    """f(eps) of shape [B, 1, ..., size], one draw for each row of ``x``'s first dimension."""
    shape = (*x.shape[:1], *(1 for _ in x.shape[1:-1]), size) if x.ndim > 1 else (size,)
    noise = torch.randn(shape, device=x.device, dtype=x.dtype)
    return noise.sign() * noise.abs().sqrt()
