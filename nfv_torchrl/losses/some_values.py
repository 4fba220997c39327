"""Q-values of a perceptron for the actions that a loss asks about, and no others.

On a network of N nodes the perceptron of the paper has 2 N V + 1 outputs, and a loss asks for one of them at s, for the
few valid ones at s', and for one of the target network's at s'. So the last layer, the widest, is left out but for
these. And s' differs from s in a few numbers, so its first layer is that of s and what they change.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import linear

from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.simulator.compiled import kernel

_LAYERS = ("module", "0", "module", "layers")
"""Where the parameters of the network's layers are in those of its actor."""


@kernel
def _add_changes(before, after, across, sums):
    """Add (after - before) [R, P] times ``across`` [P, H] to ``sums`` [R, H]; float32, few numbers differ."""
    for r in range(before.shape[0]):
        total = sums[r]
        for p in range(before.shape[1]):
            change = after[r, p] - before[r, p]
            if change != 0.0:
                row = across[p]
                for o in range(total.size):
                    total[o] += change * row[o]


@kernel
def _find_best(hidden, weight, bias, mask, best):
    """Fill ``best`` int64 [R] with the action of the highest value among those of ``mask`` bool [R, A].

    Values are ``hidden`` [R, H] times ``weight`` [A, H] transposed, and ``bias`` [A]; H is a multiple of 8, float32.
    """
    for r in range(mask.shape[0]):
        best[r] = 0
        highest = np.float32(-np.inf)
        row = hidden[r]
        for action in range(mask.shape[1]):
            if not mask[r, action]:
                continue
            of = weight[action]
            # Eight sums, which need not wait for one another.
            a = b = c = d = e = f = g = h = np.float32(0.0)
            for o in range(0, row.size, 8):
                a += row[o] * of[o]
                b += row[o + 1] * of[o + 1]
                c += row[o + 2] * of[o + 2]
                d += row[o + 3] * of[o + 3]
                e += row[o + 4] * of[o + 4]
                f += row[o + 5] * of[o + 5]
                g += row[o + 6] * of[o + 6]
                h += row[o + 7] * of[o + 7]
            value = bias[action] + (((a + b) + (c + d)) + ((e + f) + (g + h)))
            if value > highest:
                best[r], highest = action, value


class SomeValues(NamedTuple):
    """A perceptron with some parameters, asked for some of its values.

    Made by ``some_values``. States are float32 [R, P], actions int64 [R], values float32 [R].
    """

    weights: list[tuple[Tensor, Tensor]]  # of each layer, with its bias
    activation: nn.Module

    def first(self, observation: Tensor) -> Tensor:
        """What the first layer makes of states, [R, H], before the activation."""
        return linear(observation, *self.weights[0])

    def first_after(self, first: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """``first(after)`` without a gradient, from ``first`` of the states ``before``, of which little has changed."""
        sums = first.detach().clone()
        across = self.weights[0][0].detach().t().contiguous()
        _add_changes(before.numpy(), after.numpy(), across.numpy(), sums.numpy())
        return sums

    def hidden(self, first: Tensor) -> Tensor:
        """What the last layer reads, from ``first`` of some states."""
        values = self.activation(first)
        for weight, bias in self.weights[1:-1]:
            values = self.activation(linear(values, weight, bias))
        return values

    def of(self, hidden: Tensor, action: Tensor) -> Tensor:
        """The values of one action each."""
        weight, bias = self.weights[-1]
        return (hidden * weight.index_select(0, action)).sum(-1) + bias.index_select(0, action)

    def best(self, hidden: Tensor, mask: Tensor) -> Tensor:
        """The valid action of the highest value, by ``mask`` bool [R, A]."""
        weight, bias = (weights.detach().numpy() for weights in self.weights[-1])
        best = torch.empty(len(mask), dtype=torch.int64)
        _find_best(hidden.detach().numpy(), weight, bias, mask.numpy(), best.numpy())
        return best


def some_values(network: nn.Module, params: TensorDictBase) -> SomeValues:
    """``network`` with the parameters that are ``params`` of its actor; see ``serves``."""
    own: Any = params.get(_LAYERS)
    layers: Any = network.layers
    weights = []
    for number, layer in enumerate(layers):
        if isinstance(layer, nn.Linear):
            of_layer = own.get(str(number))
            weights.append((of_layer.get("weight"), of_layer.get("bias")))
    return SomeValues(weights, layers[1])


def serves(network: nn.Module, tensordict: TensorDictBase) -> bool:
    """Whether ``some_values`` may be asked for the values of ``tensordict``: of a plain perceptron, on the CPU."""
    if type(network) is not MLPNetwork or network.outputs != 1 or torch.compiler.is_compiling():
        return False
    layers: list[Any] = list(network.layers)
    linears, others = layers[::2], layers[1::2]
    if len(linears) < 2 or not all(type(layer) is nn.Linear for layer in linears):
        return False
    if any(True for layer in others for _ in layer.parameters()) or layers[-1].in_features % 8:
        return False
    observation = tensordict.get("observation")
    plain = observation.ndim == 2 and observation.dtype == torch.float32
    return plain and observation.device.type == "cpu"
