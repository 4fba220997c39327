"""When a run is evaluated, for the recipes as they are and for any numbers."""

import math
from itertools import pairwise

import pytest
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st
from tiny import ROOT

from nfv_torchrl.training.occasions import Evaluations


def times(interval: int, last: int) -> list[int]:
    return [done for done in range(last + 1) if Evaluations(interval, last).due(done)]


def test_by_hand():
    assert times(45, 586) == [*range(0, 541, 45), 586]  # 585 would say what 586 says
    assert times(10, 30) == [0, 10, 20, 30]
    assert times(10, 31) == [0, 10, 20, 30, 31] and times(11, 34) == [0, 11, 22, 34]
    assert times(50, 7) == [0, 7]
    assert times(0, 7) == []


@given(st.integers(0, 60), st.integers(1, 200))
def test_begins_and_ends_with_one_and_counts_them(interval, last):
    found = times(interval, last)
    assert len(found) == Evaluations(interval, last).count
    if interval:
        assert found[0] == 0 and found[-1] == last
        gaps = [after - before for before, after in pairwise(found)]
        assert all(gap <= interval * 1.1 for gap in gaps) and not {*found[:-1]} - {*range(0, last, interval)}


@pytest.mark.parametrize(("recipe", "unit"), [("dqn", "frames"), ("policy_gradient", "frames"), ("offline", "updates")])
def test_default_runs_have_twelve_and_none_beside_the_last(recipe, unit):
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = compose(recipe)
    if unit == "updates":
        last = config.learner.updates
    else:
        last = math.ceil(config.collector.total_frames / (config.collector.num_envs * config.collector.steps))
    found = times(config.eval.interval, last)
    assert len(found) >= 13 and found[-1] - found[-2] > config.eval.interval / 10
