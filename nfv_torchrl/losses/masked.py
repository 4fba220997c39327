"""Arithmetic over the valid actions A_p(s) alone.

Everywhere ``values`` is float32 [..., A] and ``mask`` bool [..., A] with at least one valid action; results are
[..., 1] unless said otherwise. Invalid entries, infinite and NaN ones included, change neither a result nor a gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor


def masked_argmax(values: Tensor, mask: Tensor) -> Tensor:
    """The valid action of the highest value, int64 [..., 1]."""
    return values.masked_fill(~mask, -torch.inf).argmax(-1, keepdim=True)


def masked_max(values: Tensor, mask: Tensor) -> Tensor:
    """The highest value of a valid action."""
    return values.masked_fill(~mask, -torch.inf).amax(-1, keepdim=True)


def masked_logsumexp(values: Tensor, mask: Tensor) -> Tensor:
    """log of the sum of exp over the valid actions."""
    return values.masked_fill(~mask, -torch.inf).logsumexp(-1, keepdim=True)


def masked_log_softmax(logits: Tensor, mask: Tensor) -> Tensor:
    """Log-probabilities over the valid actions, [..., A]; 0, not -inf, for invalid ones, so that 0 * log 0 is 0."""
    return logits.masked_fill(~mask, -torch.inf).log_softmax(-1).masked_fill(~mask, 0.0)


def masked_softmax(logits: Tensor, mask: Tensor) -> Tensor:
    """Probabilities over the valid actions, [..., A]; 0 for invalid ones."""
    return logits.masked_fill(~mask, -torch.inf).softmax(-1)


def masked_expectation(probabilities: Tensor, values: Tensor, mask: Tensor) -> Tensor:
    """Sum of ``probabilities * values`` over the valid actions."""
    return (probabilities * values.masked_fill(~mask, 0.0)).sum(-1, keepdim=True)
