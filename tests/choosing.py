"""Policies of NFVdeep for tests: simple functions of what is seen."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule


def actor_of(function):
    """A policy from a function of (observation, mask) to actions."""
    return TensorDictModule(function, in_keys=["observation", "action_mask"], out_keys=["action"])


def last_valid(observation, mask):
    """The valid node with the largest index; N, to refuse, only where there is none."""
    nodes = mask[:, :-1].shape[1]
    reverse = mask[:, :-1].flip(-1).to(torch.int64).argmax(-1)
    return torch.where(mask[:, :-1].any(-1), nodes - 1 - reverse, nodes)


def hashed(observation, mask):
    """Some valid node that depends on what is seen, the same each time."""
    size = observation.shape[1]
    noise = torch.sin(observation @ torch.arange(1.0, size + 1).sin().outer(torch.arange(1.0, mask.shape[1] + 1)) * 37)
    return noise.masked_fill(~mask, -9.0).argmax(-1)


LAST, HASHED = actor_of(last_valid), actor_of(hashed)
