"""The paper's network: a multilayer perceptron from the flat observation to one value per action."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torchrl.modules import MLP

from nfv_torchrl.networks.base import QNetwork, Sizes, split_outputs


class MLPNetwork(QNetwork):
    """From ``observation`` float32 [..., P] to values float32 [..., A] (section "Computational complexity": P_i, P_h
    hidden layers of P_n neurons, P_o).

    Args:
        sizes: sizes of observation and actions.
        outputs: outputs per action.
        hidden: neurons of each hidden layer.
        activation: name of a ``torch.nn`` activation.
    """

    in_keys = ("observation",)

    def __init__(
        self, sizes: Sizes, outputs: int = 1, *, hidden: Sequence[int] = (256, 256), activation: str = "ReLU"
    ) -> None:
        super().__init__()
        self.outputs = outputs
        self.layers = flat_layers(sizes.observation, sizes.actions * outputs, hidden, activation)

    def forward(self, observation: Tensor) -> Tensor:
        """Values of all actions."""
        return split_outputs(self.layers(observation), self.outputs)


def flat_layers(inputs: int, outputs: int, hidden: Sequence[int], activation: str) -> MLP:
    """A perceptron with the activations named as in ``torch.nn``."""
    return MLP(
        in_features=inputs, out_features=outputs, num_cells=list(hidden), activation_class=getattr(nn, activation)
    )
