"""Randomness by stream: one seed, independent generators for what should not disturb each other."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from nfv_torchrl.errors import ScenarioError


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


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """The generator of ``stream`` under ``seed``; ``key`` (an env's index, an episode's number) splits it further.

    Depends on the arguments alone: not on what was drawn before, nor on how many envs there are.

    Raises:
        ScenarioError: the seed is negative or not an integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ScenarioError(f"seed: {seed!r} is not a seed; use an integer >= 0")
    return np.random.default_rng(np.random.SeedSequence(entropy=int(seed), spawn_key=(int(stream), *key)))
