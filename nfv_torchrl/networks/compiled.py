"""A small perceptron inside a compiled loop."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from torch import nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.simulator.compiled import part

RELU, TANH = 0, 1


@part
def score_row(weights, sizes, activation, row, now, after):
    """Output of the perceptron for ``row``; ``now`` and ``after`` are room for its widest layer."""
    for k in range(sizes[0]):
        now[k] = row[k]
    at = 0
    layers = sizes.size - 1
    for layer in range(layers):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        bias = at + inputs * outputs
        for o in range(outputs):
            after[o] = weights[bias + o]
        # Outputs innermost: the compiler turns that loop into vector instructions, and half of the inputs are zero.
        for i in range(inputs):
            value = now[i]
            if value != 0.0:
                first = at + i * outputs
                for o in range(outputs):
                    after[o] += weights[first + o] * value
        at = bias + outputs
        for o in range(outputs):
            if layer == layers - 1:
                now[o] = after[o]
            elif activation == RELU:
                now[o] = max(after[o], np.float32(0.0))
            else:
                now[o] = np.tanh(after[o])
    return now[0]


class CompiledPerceptron(NamedTuple):
    """The weights of a perceptron as ``score_row`` takes them, and its scratch."""

    weights: np.ndarray  # float32: [inputs, outputs] of each layer, then its bias
    sizes: np.ndarray  # int64 [layers + 1]
    activation: int  # RELU or TANH
    now: np.ndarray  # float32 [widest layer]
    after: np.ndarray


def compiled_perceptron(layers: Iterable[nn.Module]) -> CompiledPerceptron:
    """The weights of linear layers with one kind of activation between them, as they are now.

    Raises:
        ScenarioError: layers of another kind, or another activation than ReLU and Tanh.
    """
    every = list(layers)
    linear = [layer for layer in every if isinstance(layer, nn.Linear)]
    others = {type(layer) for layer in every} - {nn.Linear}
    known = {nn.ReLU: RELU, nn.Tanh: TANH}
    if len(others) > 1 or not others <= set(known):
        raise ScenarioError("network: a compiled network has linear layers and ReLU or Tanh between them")
    sizes = np.array([linear[0].in_features, *(layer.out_features for layer in linear)], np.int64)
    parts = [part.detach().cpu().numpy().ravel() for layer in linear for part in (layer.weight.T, layer.bias)]
    scratch = np.zeros((2, int(sizes.max())), np.float32)
    activation = known[next(iter(others))] if others else RELU
    return CompiledPerceptron(np.concatenate(parts).astype(np.float32), sizes, activation, scratch[0], scratch[1])
