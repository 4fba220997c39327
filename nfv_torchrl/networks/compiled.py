"""A small perceptron inside a compiled loop."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from torch import Tensor, nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks.layers import NoisyLinear
from nfv_torchrl.simulator.compiled import part

RELU, TANH = 0, 1
Layer = tuple[Tensor, Tensor]
"""Weights [inputs, outputs] and bias [outputs] of a linear layer."""


@part
def affine(weights, at, inputs, source, sums):
    """Fill ``sums`` with the outputs of the linear layer whose weights begin at ``at``; returns where the next's begin.

    It reads the first ``inputs`` numbers of ``source``.
    """
    outputs = sums.size
    end = at + inputs * outputs
    bias = weights[end : end + outputs]
    for o in range(outputs):
        sums[o] = bias[o]
    # Outputs innermost, and rows as arrays of their own: the compiler turns that loop into vector instructions. Half of
    # the inputs of a layer are zero.
    for i in range(inputs):
        value = source[i]
        if value != 0.0:
            row = weights[at + i * outputs : at + (i + 1) * outputs]
            for o in range(outputs):
                sums[o] += row[o] * value
    return end + outputs


@part
def activate(values, activation):
    """Apply RELU or TANH to each of ``values``."""
    for o in range(values.size):
        values[o] = max(values[o], np.float32(0.0)) if activation == RELU else np.tanh(values[o])


@part
def outputs_of(weights, sizes, activation, now, after):
    """Outputs of the perceptron for the inputs in ``now``, which are left in ``now``; ``after`` is room, too.

    Both are float32, as wide as its widest layer.
    """
    at = 0
    layers = sizes.size - 1
    for layer in range(layers):
        outputs = sizes[layer + 1]
        sums = after[:outputs]
        at = affine(weights, at, sizes[layer], now, sums)
        if layer < layers - 1:
            activate(sums, activation)
        for o in range(outputs):
            now[o] = sums[o]


@part
def score_row(weights, sizes, activation, row, now, after):
    """Output of the perceptron for ``row``; ``now`` and ``after`` are room for its widest layer."""
    for k in range(sizes[0]):
        now[k] = row[k]
    outputs_of(weights, sizes, activation, now, after)
    return now[0]


class CompiledPerceptron(NamedTuple):
    """The weights of a perceptron as ``score_row`` takes them, and its scratch."""

    weights: np.ndarray  # float32: [inputs, outputs] of each layer, then its bias
    sizes: np.ndarray  # int64 [layers + 1]
    activation: int  # RELU or TANH
    now: np.ndarray  # float32 [widest layer]
    after: np.ndarray


def compiled_perceptron(layers: Iterable[nn.Module]) -> CompiledPerceptron:
    """The weights of linear layers with one kind of activation between them, as they are now; noise is left out.

    Raises:
        ScenarioError: layers of another kind, or another activation than ReLU and Tanh.
    """
    return compiled_layers(layers_of(layers), activation_of(layers))


def activation_of(layers: Iterable[nn.Module]) -> int:
    """The one between linear layers: RELU or TANH.

    Raises:
        ScenarioError: layers of another kind, or another activation.
    """
    every = list(layers)
    others = {type(layer) for layer in every} - {nn.Linear, NoisyLinear}
    known = {nn.ReLU: RELU, nn.Tanh: TANH}
    if len(others) == len(every) or len(others) > 1 or not others <= set(known):
        raise ScenarioError("network: a compiled network has linear layers and ReLU or Tanh between them")
    return known[next(iter(others))] if others else RELU


def layers_of(modules: Iterable[nn.Module]) -> list[Layer]:
    """The linear ones of ``modules`` as they are now; noise is left out."""
    return [_weights(layer) for layer in modules if isinstance(layer, nn.Linear | NoisyLinear)]


def compiled_layers(layers: Sequence[Layer], activation: int) -> CompiledPerceptron:
    """The perceptron of such layers."""
    sizes = np.array([layers[0][0].shape[0], *(weights.shape[1] for weights, _ in layers)], np.int64)
    parts = [part.detach().cpu().numpy().ravel() for layer in layers for part in layer]
    scratch = np.zeros((2, int(sizes.max())), np.float32)
    return CompiledPerceptron(np.concatenate(parts).astype(np.float32), sizes, activation, scratch[0], scratch[1])


def _weights(layer: nn.Linear | NoisyLinear) -> Layer:
    """Weights [inputs, outputs] and bias [outputs] of a layer."""
    if isinstance(layer, NoisyLinear):
        return layer.weight_mu.T, layer.bias_mu  # type: ignore[return-value]  # every layer here has a bias
    return layer.weight.T, layer.bias
