"""Means and intervals, compared with values computed by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lab.experiments.intervals import curve, interval, paired


def test_a_mean_lies_within_its_interval_and_the_interval_within_the_sample() -> None:
    found = interval([1.0, 2.0, 3.0, 4.0, 10.0])
    assert found.mean == 4.0
    assert 1.0 <= found.low < 4.0 < found.high <= 10.0
    assert found.values == [1.0, 2.0, 3.0, 4.0, 10.0]


def test_of_two_seeds_the_interval_is_the_two() -> None:
    # A resample of {0, 1} has mean 0, 1/2 or 1 with probability 1/4, 1/2, 1/4: both tails are past 2.5%.
    found = interval([0.0, 1.0])
    assert (found.mean, found.low, found.high) == (0.5, 0.0, 1.0)


def test_it_agrees_with_every_resample_enumerated() -> None:
    sample = [0.0, 1.0, 5.0, 6.0]
    means = [np.mean(resample) for resample in itertools.product(sample, repeat=4)]
    low, high = np.percentile(means, [2.5, 97.5])
    # Symmetric and without skew, so that BCa's corrections vanish.
    found = interval(sample)
    assert found.low == pytest.approx(low, abs=0.26)
    assert found.high == pytest.approx(high, abs=0.26)


@pytest.mark.parametrize("values", [[7.0], [7.0, 7.0, 7.0]])
def test_one_seed_or_equal_seeds_have_no_width(values: list[float]) -> None:
    found = interval(values)
    assert (found.mean, found.low, found.high) == (7.0, 7.0, 7.0)


def test_no_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="no values"):
        interval([])


def test_a_skewed_sample_gets_a_skewed_interval() -> None:
    found = interval([0.0] * 9 + [100.0])
    assert found.high - found.mean > found.mean - found.low


def test_the_same_numbers_give_the_same_interval() -> None:
    rng = np.random.default_rng(3)
    values = rng.poisson(100, 30).tolist()
    assert interval(values) == interval(values)
    assert paired("a", "b", "m", values, values[::-1]) == paired("a", "b", "m", values, values[::-1])


def test_a_constant_difference_is_certain_however_far_worlds_differ() -> None:
    difference, ratio = paired("a", "b", "m", [11.0, 101.0, 1001.0], [10.0, 100.0, 1000.0])
    assert (difference.kind, difference.mean, difference.low, difference.high) == ("difference", 1.0, 1.0, 1.0)
    assert ratio.kind == "ratio"
    assert ratio.mean == pytest.approx(1113 / 1110)


def test_a_constant_ratio_is_certain() -> None:
    _, ratio = paired("a", "b", "m", [20.0, 200.0, 6.0], [10.0, 100.0, 3.0])
    assert (ratio.mean, ratio.low, ratio.high) == pytest.approx((2.0, 2.0, 2.0))


def test_there_is_no_ratio_to_nothing() -> None:
    assert [p.kind for p in paired("a", "b", "m", [1.0, 2.0], [0.0, 0.0])] == ["difference"]
    # Half of the worlds lose nothing: a resample of those alone has no ratio.
    assert [p.kind for p in paired("a", "b", "m", [1.0, 2.0], [0.0, 3.0])] == ["difference"]


def test_a_curve_is_an_interval_a_step() -> None:
    found = curve([[0.0, 1.0, 2.0], [0.0, 3.0, 2.0]])
    assert found.mean == [0.0, 2.0, 2.0]
    assert (found.low[0], found.high[0]) == (0.0, 0.0)
    assert (found.low[1], found.high[1]) == (1.0, 3.0)
    assert (found.low[2], found.high[2]) == (2.0, 2.0)
