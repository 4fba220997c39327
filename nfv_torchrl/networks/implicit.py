"""The implicit quantile network: a quantile of the return at any level that it is asked for."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks.base import QNetwork, Sizes
from nfv_torchrl.networks.layers import activation_class, check_weights_fit, perceptron
from nfv_torchrl.settings.values import Activation, Count, Widths

FIXED_LEVELS = 32
"""Whose mean is the value of an action; 32 as in the paper's policy."""


class ImplicitQuantileNetwork(QNetwork):
    r"""Features of the state times features of the level, and from their product a quantile for each action.

    $$
    Z_\tau(s, \cdot) = f\big(\psi(s) \odot \phi(\tau)\big), \qquad
    \phi_j(\tau) = \mathrm{ReLU}\Big(\sum_{i=0}^{n-1} \cos(\pi i \tau) w_{ij} + b_j\Big)
    $$

    (Dabney, Ostrovski, Silver, Munos, "Implicit Quantile Networks for Distributional Reinforcement Learning", ICML
    2018, eq. 4 and section 3). $\psi$ is all hidden layers but the last, f the last one and a linear layer.

    Reads ``observation`` float32 [..., P] and, as a further input, levels float32 [..., N] or [N] between 0 and 1;
    returns quantiles float32 [..., A, N]. Without levels it answers at the fixed ones $(2 i - 1) / 2 M$, i = 1 ... M:
    with M = ``outputs`` as float32 [..., A, M], or, where one output is wanted, their mean over M = 32 as value
    [..., A]. So its choice of actions is not random, and ``loss=dqn`` or ``loss=distributional`` can use it, too.

    Args:
        sizes: sizes of observation and actions.
        outputs: outputs per action where no levels are given.
        hidden: neurons of each hidden layer, at least two layers.
        cosines: n.
        activation: name of a ``torch.nn`` activation; that of the levels' features is ReLU.
        noisy: learned noise on the weights of $\psi$ and f instead of epsilon-greedy exploration, see ``NoisyLinear``.

    Raises:
        ScenarioError: fewer than two hidden layers.
    """

    in_keys = ("observation",)
    takes_levels = True

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Widths = (256, 256),
        cosines: Count = 64,
        activation: Activation = "ReLU",
        noisy: bool = False,
    ) -> None:
        super().__init__()
        if len(hidden) < 2:
            raise ScenarioError(f"network.hidden: {list(hidden)}; an implicit quantile network has at least two layers")
        *first, width, last = hidden
        check_weights_fit(cosines, float(cosines) * width)
        self.outputs = outputs
        state = perceptron(sizes.observation, width, first, activation, noisy=noisy)
        self.state = nn.Sequential(state, activation_class(activation)())
        self.level = nn.Linear(cosines, width)
        self.quantiles = perceptron(width, sizes.actions, [last], activation, noisy=noisy)
        self.number = FIXED_LEVELS if outputs == 1 else outputs

    def forward(self, observation: Tensor, levels: Tensor | None = None) -> Tensor:
        """Quantiles of all actions at ``levels``, or at the fixed levels."""
        at = middles(self.number, observation.device) if levels is None else levels
        values = self.quantiles(self.state(observation).unsqueeze(-2) * self.embed(at)).transpose(-1, -2)
        return values.mean(-1) if levels is None and self.outputs == 1 else values

    def embed(self, levels: Tensor) -> Tensor:
        """Features of ``levels`` [..., N], float32 [..., N, W]."""
        waves = math.pi * torch.arange(self.level.in_features, device=levels.device)
        return functional.relu(self.level(torch.cos(levels.unsqueeze(-1) * waves)))


def middles(number: int, device: torch.device | None = None) -> Tensor:
    """The middles of ``number`` equal parts of the interval from 0 to 1, float32 [number]."""
    return (2 * torch.arange(number, device=device) + 1) / (2 * number)
