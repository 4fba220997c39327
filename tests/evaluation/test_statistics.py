from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nfv_torchrl.evaluation.statistics import (
    Interval,
    mean_interval,
    paired_difference,
    ratio_of_means,
    relative_difference,
)

shares = st.floats(0.01, 1.0)


def leaves_out(interval: Interval, value: float) -> bool:
    """Whether the interval is defined and ``value`` lies outside it."""
    return value < interval.low or value > interval.high


def test_mean_and_interval_by_hand():
    # 1, 2, 3: mean 2, standard deviation 1, t for 2 degrees of freedom 4.302653.
    interval = mean_interval([1, 2, 3])
    half = 4.302652729911275 / math.sqrt(3)
    assert (interval.mean, interval.n) == (2, 3)
    assert (interval.low, interval.high) == pytest.approx((2 - half, 2 + half))
    assert interval.half_width == pytest.approx(half)
    assert leaves_out(interval, -1) and not leaves_out(interval, 0)


def test_one_seed_has_no_interval():
    for interval in (mean_interval([0.8]), paired_difference([0.8], [0.7]), ratio_of_means([0.8], [0.4])):
        assert interval.n == 1
        assert math.isnan(interval.low) and math.isnan(interval.half_width)
        assert not leaves_out(interval, 0)
    assert ratio_of_means([0.8], [0.4]).mean == 2


def test_no_value_at_all():
    assert mean_interval([]).n == 0
    assert math.isnan(mean_interval([math.nan]).mean)
    assert math.isnan(ratio_of_means([], []).mean)


def test_seeds_without_the_metric_are_left_out():
    assert mean_interval([1, math.nan, 3]).n == 2
    assert paired_difference([1, math.nan, 3, 5], [0, 0, 2, math.nan]).mean == 1


def test_equal_values_have_an_interval_of_no_width():
    interval = mean_interval([0.1] * 7)
    assert (interval.mean, interval.low, interval.high) == (0.1, 0.1, 0.1)


def test_pairing_removes_what_seeds_share():
    a = np.array([0.50, 0.71, 0.90, 0.62])
    b = a - [0.05, 0.06, 0.05, 0.06]
    assert leaves_out(paired_difference(a, b), 0)
    assert paired_difference(a, b).mean == pytest.approx(0.055)
    assert relative_difference(a, b).mean == pytest.approx(0.055 / np.mean(b))


def test_ratio_of_a_constant_denominator_is_the_scaled_mean():
    ratio, mean = ratio_of_means([1, 2, 3], [4, 4, 4]), mean_interval([1, 2, 3])
    assert (ratio.mean, ratio.low, ratio.high) == pytest.approx((mean.mean / 4, mean.low / 4, mean.high / 4))


def test_ratio_with_a_denominator_that_may_be_zero_has_no_interval():
    ratio = ratio_of_means([1.0, 2.0, 1.5], [-1.0, 1.0, 0.5])
    assert ratio.mean == pytest.approx(9)
    assert math.isnan(ratio.low) and math.isnan(ratio.high)
    assert math.isnan(ratio_of_means([1, 2], [1, -1]).mean)


@given(st.lists(st.tuples(shares, shares), min_size=2, max_size=12))
def test_fieller_ends_are_where_the_paired_test_turns(pairs):
    a, b = np.array(pairs).T
    ratio = ratio_of_means(a, b)
    if math.isnan(ratio.low) or ratio.high - ratio.low < 1e-6 or ratio.high > 1e3:
        return
    for end in (ratio.low, ratio.high):
        at_end = mean_interval(a - end * b)
        assert abs(at_end.mean) == pytest.approx(at_end.half_width, rel=1e-5, abs=1e-9)
    assert ratio.low <= ratio.mean <= ratio.high


@given(st.lists(st.tuples(shares, shares), min_size=2, max_size=12))
def test_absolute_and_relative_differences_agree_on_zero(pairs):
    a, b = np.array(pairs).T
    absolute, relative = paired_difference(a, b), relative_difference(a, b)
    clearance = min(abs(absolute.low), abs(absolute.high))
    if not math.isnan(relative.low) and clearance > 1e-9:
        assert leaves_out(absolute, 0) == leaves_out(relative, 0)


def test_coverage_of_fieller_is_what_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(1000):
        b = rng.normal(0.8, 0.1, 8)
        a = 1.1 * b + rng.normal(0, 0.05, 8)
        interval = ratio_of_means(a, b)
        hits += interval.low <= 1.1 <= interval.high
    assert 0.93 < hits / 1000 < 0.97


def test_samples_of_other_seeds_are_refused():
    with pytest.raises(ValueError, match="same seeds"):
        paired_difference([1, 2], [1])
