"""Randomness by stream: one seed, independent generators for what should not disturb each other."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import shown


class Stream(IntEnum):
    """What a random generator is for. The numbers are part of the seeding: append, never reorder."""

    TOPOLOGY = 0
    RESOURCES = 1
    CATALOGUE = 2
    WORKLOAD = 3
    FAILURES = 4
    START = 5
    EXPLORATION = 6
    NETWORKS = 7
    EVOLUTION = 8
    REQUESTS = 9


LARGEST_SEED = 2**63 - 1
"""So that a seed fits where integers have 64 bits."""


def check_seed(seed: object) -> None:
    """Raise unless ``seed`` is an integer from 0 to ``LARGEST_SEED``.

    Raises:
        ScenarioError: it is not.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= int(seed) <= LARGEST_SEED:
        raise ScenarioError(f"seed: {shown(seed)} is not a seed; use an integer >= 0, and of 63 bits at most")


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """The generator of ``stream`` under ``seed``; ``key`` (an env's index, an episode's number) splits it further.

    Depends on the arguments alone: not on what was drawn before, nor on how many envs there are.

    Raises:
        ScenarioError: the seed is out of range or not an integer.
    """
    check_seed(seed)
    return np.random.default_rng(np.random.SeedSequence(entropy=int(seed), spawn_key=(int(stream), *key)))
