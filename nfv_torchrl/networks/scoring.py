"""Networks that score every action from the flat observation, inside a compiled loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.networks.base import QNetwork
from nfv_torchrl.networks.compiled import (
    RELU,
    Layer,
    activate,
    activation_of,
    affine,
    compiled_layers,
    layers_of,
    outputs_of,
)
from nfv_torchrl.networks.dueling import DuelingNetwork
from nfv_torchrl.networks.gru import GRUNetwork
from nfv_torchrl.networks.implicit import ImplicitQuantileNetwork, middles
from nfv_torchrl.networks.mlp import MLPNetwork
from nfv_torchrl.simulator.compiled import part


class CompiledScorer(NamedTuple):
    """The weights of such a network as they were, the memory of each environment, and scratch.

    ``memory`` with H > 0 is that of a ``GRUNetwork``. ``levels`` with M > 0 are those of an
    ``ImplicitQuantileNetwork``. Without either it is a perceptron.
    """

    weights: np.ndarray  # float32: [inputs, outputs] of each layer, then its bias
    sizes: np.ndarray  # int64: of the perceptron's layers, or of observation, memory and actions
    activation: int  # of the perceptron, see ``outputs_of``
    memory: np.ndarray  # float32 [B, H]
    levels: np.ndarray  # float32 [M, W]: what features of the state are multiplied with at each level
    now: np.ndarray  # float32, see ``scores_of``
    after: np.ndarray


def compiled_scorer(network: QNetwork, output: int | None = None) -> CompiledScorer:
    """A network that scores every action; noise is left out, and a memory is that of one environment, zero.

    Args:
        network: an ``MLPNetwork``, ``DuelingNetwork``, ``ImplicitQuantileNetwork`` or ``GRUNetwork``.
        output: which of several outputs per action is the score; None: their mean.

    Raises:
        ScenarioError: another network, or another activation than ReLU and Tanh.
    """
    if type(network) is GRUNetwork:  # and no class derived from it, which may compute something else
        return _remembering(network, output)
    if type(network) is ImplicitQuantileNetwork and output is None:
        return _implicit(network)
    if type(network) is MLPNetwork:
        *hidden, last = layers_of(network.layers)
        layers = [*hidden, _scoring(last, network.outputs, output)]
        return _perceptron(layers, activation_of(network.layers))
    if type(network) is DuelingNetwork:
        return _perceptron(_joined(network, output), activation_of(network.advantage))
    raise ScenarioError(f"network: {type(network).__name__} has no compiled form")


def _perceptron(layers: list[Layer], activation: int) -> CompiledScorer:
    made = compiled_layers(layers, activation)
    memory, levels = np.zeros((1, 0), np.float32), np.zeros((0, 0), np.float32)
    return CompiledScorer(made.weights, made.sizes, made.activation, memory, levels, made.now, made.after)


def _scoring(last: Layer, outputs: int, output: int | None) -> Layer:
    """The last layer for one score per action instead of several outputs; a mean of linear outputs is linear."""
    weights, bias = (part.unflatten(-1, (-1, outputs)) for part in last)
    return (weights.mean(-1), bias.mean(-1)) if output is None else (weights[..., output], bias[..., output])


def _joined(network: DuelingNetwork, output: int | None) -> list[Layer]:
    """Both heads side by side: outputs are the advantage of each action and, last, V."""
    trunk = [] if isinstance(network.trunk, nn.Identity) else layers_of(network.trunk[0])  # type: ignore[index]
    (first_a, last_a), (first_v, last_v) = (layers_of(head) for head in (network.advantage, network.value))
    advantage, value = (_scoring(last, network.outputs, output) for last in (last_a, last_v))
    width, actions = advantage[0].shape
    weights = advantage[0].new_zeros((2 * width, actions + 1))
    weights[:width, :actions], weights[width:, actions:] = advantage[0], value[0]
    first = tuple(_side_by_side(a, v) for a, v in zip(first_a, first_v, strict=True))
    return [*trunk, first, (weights, _side_by_side(advantage[1], value[1]))]  # type: ignore[list-item]


def _side_by_side(left: Tensor, right: Tensor) -> Tensor:
    return nn.functional.pad(left, (0, right.shape[-1])) + nn.functional.pad(right, (left.shape[-1], 0))


def _implicit(network: ImplicitQuantileNetwork) -> CompiledScorer:
    """As a perceptron whose last hidden layer is run at each level; its mean goes into the last layer, once."""
    made = _perceptron(
        [*layers_of(network.state[0]), *layers_of(network.quantiles)],  # type: ignore[arg-type]
        activation_of(network.quantiles),
    )
    with torch.no_grad():
        levels = network.embed(middles(network.number)).cpu().numpy()
    room = max(int(made.sizes.max()), (len(levels) + 1) * int(made.sizes[-2]))
    return made._replace(levels=levels, after=np.zeros(room, np.float32))


def _remembering(network: GRUNetwork, output: int | None) -> CompiledScorer:
    cell = network.cell
    gates = [(cell.weight_ih.T, cell.bias_ih), (cell.weight_hh.T, cell.bias_hh)]
    values = _scoring(layers_of([network.values])[0], network.outputs, output)
    made = _perceptron([*layers_of(network.encode), *gates, values], RELU)
    observation, hidden, actions = made.sizes[0], network.hidden, made.sizes[-1]
    return made._replace(
        sizes=np.array([observation, hidden, actions]),
        memory=np.zeros((1, hidden), np.float32),
        now=np.zeros(max(observation, 6 * hidden, actions), np.float32),
        after=np.zeros(2 * hidden, np.float32),
    )


@part
def scores_of(world, b, scorer):
    """Leave the scores of environment b's actions in ``scorer.now``; a memory goes on by a step.

    Those of a dueling network are less what all actions share: see ``shared_score``.
    """
    for i in range(scorer.sizes[0]):
        scorer.now[i] = world.seen.flat[b, i]
    if scorer.memory.shape[1] > 0:
        _remembered(scorer.weights, scorer.sizes, scorer.now, scorer.after, scorer.memory[b])
    elif scorer.levels.shape[0] > 0:
        _mean_over_levels(scorer)
    else:
        outputs_of(scorer.weights, scorer.sizes, scorer.activation, scorer.now, scorer.after)


@part
def shared_score(world, b, scorer):
    """What a dueling network adds to the scores of all actions: V less the mean advantage of the valid ones."""
    actions = world.seen.mask.shape[1]
    if scorer.sizes[-1] == actions:
        return np.float32(0.0)
    count = world.env[b].mask_count
    total = np.float32(0.0)
    for k in range(count):
        total += scorer.now[world.seen.valid[b, k]]
    return scorer.now[actions] - total / np.float32(max(count, 1))


@part
def _mean_over_levels(scorer):
    """Mean quantiles of an ``ImplicitQuantileNetwork`` for the observation in ``now``, left there.

    ``after`` has room for a layer, for the last hidden layer at each level, and for the mean of these.
    """
    weights, sizes, now, after = scorer.weights, scorer.sizes, scorer.now, scorer.after
    layers, number = sizes.size - 1, scorer.levels.shape[0]
    at = 0
    for layer in range(layers - 2):
        outputs = after[: sizes[layer + 1]]
        at = affine(weights, at, sizes[layer], now, outputs)
        activate(outputs, scorer.activation)
        for o in range(outputs.size):
            now[o] = outputs[o]
    width, last, actions = sizes[layers - 2], sizes[layers - 1], sizes[layers]
    end = at + width * last
    hidden = after[: number * last].reshape(number, last)
    for level in range(number):
        for o in range(last):
            hidden[level, o] = weights[end + o]
    # A row of weights serves all levels while it is at hand.
    for i in range(width):
        if now[i] != 0.0:
            row = weights[at + i * last : at + (i + 1) * last]
            for level in range(number):
                value = now[i] * scorer.levels[level, i]
                if value != 0.0:
                    sums = hidden[level]
                    for o in range(last):
                        sums[o] += row[o] * value
    mean = after[number * last : (number + 1) * last]
    mean[:] = np.float32(0.0)
    for level in range(number):
        activate(hidden[level], scorer.activation)
        for o in range(last):
            mean[o] += hidden[level, o] / np.float32(number)
    affine(weights, end + last, last, mean, now[:actions])


@part
def _remembered(weights, sizes, now, after, memory):
    """Outputs of a ``GRUNetwork`` for the observation in ``now``, left there; ``memory`` becomes that after the step.

    ``now`` has room for 6 H numbers: the three gates by the encoded observation, and by the memory. ``after`` has 2 H.
    """
    observation, hidden, actions = sizes[0], sizes[1], sizes[2]
    at = affine(weights, 0, observation, now, after[:hidden])
    for j in range(hidden):
        after[j] = max(after[j], np.float32(0.0))
    at = affine(weights, at, hidden, after, now[: 3 * hidden])
    at = affine(weights, at, hidden, memory, now[3 * hidden : 6 * hidden])
    for j in range(hidden):
        reset = _sigmoid(now[j] + now[3 * hidden + j])
        keep = _sigmoid(now[hidden + j] + now[4 * hidden + j])
        new = np.tanh(now[2 * hidden + j] + reset * now[5 * hidden + j])
        memory[j] = (np.float32(1.0) - keep) * new + keep * memory[j]
        after[hidden + j] = memory[j]
    affine(weights, at, 2 * hidden, after, now[:actions])


@part
def _sigmoid(x):
    return np.float32(1.0) / (np.float32(1.0) + np.exp(-x))
