"""Interquartile mean and performance profile: by hand, against scipy, and over many samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import trim_mean

from nfv_torchrl.evaluation.robust import interquartile_mean, performance_profile


def test_by_hand():
    # 8 scores: two are left out at either end, whichever run and workload they are of.
    scores = np.array([[0.0, 9.0, 3.0, 4.0], [1.0, 5.0, 6.0, 99.0]])
    assert interquartile_mean(scores).mean == (3 + 4 + 5 + 6) / 4
    shares = [point.mean for point in performance_profile(scores, np.array([-1.0, 0.0, 5.0, 98.0, 99.0]))]
    assert shares == [1, 7 / 8, 3 / 8, 1 / 8, 0]  # above, not at


def test_the_bootstrap_draws_runs_for_every_workload_by_itself():
    # Two runs: 0 and 1 on the one workload, 10 and 11 on the other. The mean of four is 5.5, with nothing left out but
    # one at either end: 1 and 10. Drawn anew, each workload is all low (1/4), all high (1/4) or mixed (1/2).
    scores = np.array([[0.0, 10.0], [1.0, 11.0]])
    found = interquartile_mean(scores)
    assert (found.mean, found.low, found.high, found.n) == (5.5, 5.0, 6.0, 2)
    (half,) = performance_profile(scores, np.array([0.5]))
    assert half.mean == 0.75 and (half.low, half.high) == (0.5, 1.0)


def test_one_run_has_no_interval():
    found = interquartile_mean(np.array([[1.0, 2.0, 3.0]]))
    assert found.mean == 2 and math.isnan(found.low) and math.isnan(found.high)
    assert math.isnan(performance_profile(np.array([[1.0]]), np.array([0.0]))[0].low)


@given(arrays(np.float64, st.tuples(st.integers(2, 5), st.integers(1, 6)), elements=st.floats(0, 1)))
def test_against_scipy_and_order(scores):
    found = interquartile_mean(scores)
    assert found.mean == pytest.approx(trim_mean(scores.ravel(), 0.25))
    assert found.low - 1e-12 <= found.high and scores.min() <= found.low + 1e-12 and found.high <= scores.max() + 1e-12
    profile = [point.mean for point in performance_profile(scores, np.linspace(-0.1, 1, 12))]
    assert profile[0] == 1 and profile[-1] == 0 and profile == sorted(profile, reverse=True)
    assert interquartile_mean(np.vstack([scores, scores])).mean == pytest.approx(
        trim_mean(np.r_[scores.ravel(), scores.ravel()], 0.25)
    )
