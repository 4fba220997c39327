"""The paper's network: a multilayer perceptron from the flat observation to one value per action."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from nfv_torchrl.networks.base import QNetwork, Sizes, split_outputs
from nfv_torchrl.networks.layers import perceptron
from nfv_torchrl.settings.values import Activation, Width


class MLPNetwork(QNetwork):
    """From ``observation`` float32 [..., P] to values float32 [..., A] (section "Computational complexity": P_i, P_h
    hidden layers of P_n neurons, P_o).

    Args:
        sizes: sizes of observation and actions.
        outputs: outputs per action.
        hidden: neurons of each hidden layer.
        activation: name of a ``torch.nn`` activation.
        noisy: learned noise on the weights instead of epsilon-greedy exploration, see ``NoisyLinear``.
    """

    in_keys = ("observation",)

    def __init__(
        self,
        sizes: Sizes,
        outputs: int = 1,
        *,
        hidden: Sequence[Width] = (256, 256),
        activation: Activation = "ReLU",
        noisy: bool = False,
    ) -> None:
        super().__init__()
        self.outputs = outputs
        self.layers = perceptron(sizes.observation, sizes.actions * outputs, hidden, activation, noisy=noisy)

    def forward(self, observation: Tensor) -> Tensor:
        """Values of all actions."""
        return split_outputs(self.layers(observation), self.outputs)
