"""CMA-ES: it climbs, and a resumed search goes on as if it had never stopped."""

from __future__ import annotations

import numpy as np
import pytest

from nfv_torchrl.evolution import Strategy

GOAL = np.array([1.0, -2.0, 0.5])


def climb(strategy: Strategy, generations: int) -> Strategy:
    for _ in range(generations):
        strategy.tell([-float(np.square(x - GOAL).sum()) for x in strategy.ask()])
    return strategy


def new(seed: int = 0, **changes) -> Strategy:
    return Strategy(np.zeros(3), seed=seed, **{"sigma": 0.5, "population": 8, **changes})


@pytest.mark.parametrize("diagonal", [False, True])
def test_it_climbs(diagonal):
    strategy = climb(new(diagonal=diagonal), 60)
    assert np.abs(strategy.mean - GOAL).max() < 1e-2 and strategy.generation == 60 and strategy.population == 8


def test_a_resumed_search_is_the_same_to_the_bit():
    whole = climb(new(), 20)
    resumed = new()
    resumed.load_state_dict(climb(new(), 9).state_dict())
    assert resumed.generation == 9
    assert (climb(resumed, 11).mean == whole.mean).all() and resumed.sigma == whole.sigma


def test_the_seed_decides_what_is_drawn_and_the_global_random_numbers_do_not():
    first = new().ask()
    np.random.seed(5)  # noqa: NPY002  the package's default draws from the global state
    assert (np.array(first) == np.array(new().ask())).all()
    assert (np.array(first) != np.array(new(seed=1).ask())).any()
