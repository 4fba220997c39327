"""Series that never change are kept back, and what is written is the line of all points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.training.series import ChangingSeries


def written(series: ChangingSeries, values, tag="a", first=0):
    return [point for frame, value in enumerate(values, first) for point in series.points(tag, frame, value)]


def test_by_hand():
    series = ChangingSeries()
    assert written(series, [3, 3, 3, 5, 5]) == [(0, 3), (2, 3), (3, 5), (4, 5)]
    assert written(ChangingSeries(), [3, 5]) == [(0, 3), (1, 5)]
    assert written(ChangingSeries(), [float("nan")] * 4) == []
    assert written(ChangingSeries(lambda tag: tag == "b"), [1, 1], "b") == [(0, 1), (1, 1)]
    kept = ChangingSeries()
    assert written(kept, [7, 7]) == [] and kept.constants() == {"a": 7}


@given(st.lists(st.sampled_from([0.0, 1.0, 2.5]), min_size=1, max_size=20), st.integers(0, 20))
def test_the_line_is_that_of_all_points_and_a_resumed_one_the_same(values, stop):
    whole = written(ChangingSeries(), values)
    if len(set(values)) > 1:
        frames, heights = zip(*whole, strict=True)
        assert np.allclose(np.interp(range(len(values)), frames, heights), values)
        assert list(frames) == sorted(set(frames))
    else:
        assert whole == []
    before, after = ChangingSeries(), ChangingSeries()
    points = written(before, values[:stop])
    after.load_state_dict(before.state_dict())
    assert points + written(after, values[stop:], first=len(values[:stop])) == whole


@pytest.mark.parametrize(
    "state",
    [
        {"changed": ["a"]},
        {"changed": "a", "kept": {}},
        {"changed": [1], "kept": {}},
        {"changed": [], "kept": {"a": [0, 1.0]}},
        {"changed": [], "kept": {"a": [0.5, 1.0, 2]}},
        {"changed": [], "kept": {"a": [0, "1", 2]}},
    ],
)
def test_a_strange_state_is_refused(state):
    with pytest.raises(CheckpointError, match="logged"):
        ChangingSeries().load_state_dict(state)
