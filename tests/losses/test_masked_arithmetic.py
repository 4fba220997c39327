"""Sums over valid actions by hand; invalid entries may hold anything."""

import math

import pytest
import torch

from nfv_torchrl.losses import masked

MASK = torch.tensor([[True, False, True, False]])


@pytest.mark.parametrize("junk", [1e30, -1e30, math.inf, -math.inf, math.nan])
def test_results_and_gradients_ignore_invalid_entries(junk):
    values = torch.tensor([[1.0, junk, 2.0, junk]], requires_grad=True)
    log_probability = masked.masked_log_softmax(values, MASK)
    probability = masked.masked_softmax(values, MASK)
    # e / (e + e^2) = 1 / (1 + e)
    first = 1 / (1 + math.e)
    assert probability.tolist() == [[pytest.approx(first), 0, pytest.approx(1 - first), 0]]
    assert log_probability.tolist() == [[pytest.approx(math.log(first)), 0, pytest.approx(math.log(1 - first)), 0]]
    assert masked.masked_argmax(values, MASK).tolist() == [[2]]
    assert masked.masked_max(values, MASK).item() == 2
    total = masked.masked_logsumexp(values, MASK)
    assert total.item() == pytest.approx(math.log(math.e + math.e**2))
    expected = masked.masked_expectation(probability, values, MASK)
    assert expected.item() == pytest.approx(first + 2 * (1 - first))
    entropy = -masked.masked_expectation(probability, log_probability, MASK)
    (total + expected + entropy + masked.masked_max(values, MASK)).sum().backward()
    assert torch.isfinite(values.grad).all()
    assert values.grad[0, [1, 3]].tolist() == [0, 0]


def test_a_single_valid_action_is_certain():
    logits = torch.zeros(1, 4, requires_grad=True)
    mask = torch.tensor([[False, False, False, True]])
    log_probability, probability = masked.masked_log_softmax(logits, mask), masked.masked_softmax(logits, mask)
    entropy = -masked.masked_expectation(probability, log_probability, mask)
    assert entropy.item() == 0
    entropy.sum().backward()
    assert logits.grad.tolist() == [[0, 0, 0, 0]]
