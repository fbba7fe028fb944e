"""Intervals have a coverage of 95 % and depend only on the scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster.evaluate.statistics import Stratum, differences, estimate


def make_stratum(values, scenes=None, name="set"):
    values = np.atleast_2d(np.asarray(values, float).T).T
    return Stratum(name, scenes or [str(i) for i in range(len(values))], values)


def estimate_one(strata):
    (estimated,) = estimate(strata)
    return estimated


def test_the_mean_is_over_all_images_with_a_score_not_over_benchmarks():
    estimated = estimate_one([make_stratum([1.0, 1.0, 1.0], name="a"), make_stratum([5.0], name="b")])
    assert estimated.mean == 2.0
    assert estimated.count == 4
    estimated = estimate_one([make_stratum([1.0, np.nan, 3.0])])
    assert (estimated.mean, estimated.count) == (2.0, 2)
    assert estimate_one([make_stratum([np.nan, np.nan])]) is None


def test_a_score_of_a_single_image_or_scene_has_no_interval():
    assert estimate_one([make_stratum([1.0, 2.0, 3.0], scenes=["x"] * 3)]).low is None
    assert estimate_one([make_stratum([1.0, np.nan, np.nan])]).low is None
    assert estimate_one([make_stratum([1.0], name="a"), make_stratum([2.0], name="b")]).low is None
    assert estimate_one([make_stratum([1.0], name="a"), make_stratum([2.0, 3.0], name="b")]).low is not None


def test_intervals_agree_with_normal_intervals_for_normal_values(rng):
    values = rng.normal(20, 3, 400)
    estimated = estimate_one([make_stratum(values)])
    half = 1.96 * values.std(ddof=1) / np.sqrt(400)
    assert estimated.high - estimated.mean == pytest.approx(half, rel=0.06)
    assert estimated.mean - estimated.low == pytest.approx(half, rel=0.06)


def test_intervals_contain_the_true_mean_in_95_percent_of_the_cases(rng):
    """The coverage of a percentile bootstrap is slightly below 95 % for 60 values."""
    covered = 0
    for i in range(200):
        estimated = estimate_one([make_stratum(rng.normal(0, 1, 60), name=str(i))])
        covered += estimated.low <= 0 <= estimated.high
    assert 0.90 <= covered / 200 <= 0.99


def test_ten_equal_images_of_each_scene_do_not_narrow_the_interval(rng):
    scenes = rng.normal(0, 1, 20)
    one = estimate_one([make_stratum(scenes)])
    ten = estimate_one([make_stratum(np.repeat(scenes, 10), scenes=[str(i // 10) for i in range(200)])])
    assert ten.high - ten.low == pytest.approx(one.high - one.low, rel=0.05)


def test_the_interval_of_a_benchmark_does_not_depend_on_the_order_of_its_images(rng):
    values, scenes = rng.normal(0, 1, 12), [f"s{i % 4}" for i in range(12)]
    order = rng.permutation(12)
    a = estimate_one([make_stratum(values, scenes)])
    b = estimate_one([make_stratum(values[order], [scenes[i] for i in order])])
    assert a.low == pytest.approx(b.low)
    assert a.high == pytest.approx(b.high)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=20))
def test_the_mean_is_in_its_interval_and_the_interval_between_minimum_and_maximum(values):
    estimated = estimate_one([make_stratum(values)])
    assert min(values) - 1e-9 <= estimated.low <= estimated.high <= max(values) + 1e-9
    assert estimated.mean == pytest.approx(np.mean(values), abs=1e-9)


def test_paired_differences_have_narrower_intervals_than_the_means(rng):
    baseline = rng.normal(22, 5, 50)
    values = np.stack([baseline, baseline + rng.normal(0.5, 0.1, 50)], axis=1)
    series = [("input", "psnr"), ("ours", "psnr")]
    (row,) = differences([make_stratum(values)], series, {"psnr": True})
    assert (row.method, row.reference, row.metric) == ("ours", "input", "psnr")
    assert row.estimate.mean == pytest.approx(0.5, abs=0.06)
    assert row.estimate.high - row.estimate.low < 0.1
    assert estimate([make_stratum(values)])[0].high - estimate([make_stratum(values)])[0].low > 2
    assert row.improved_count == 50


def test_better_uses_the_direction_of_the_metric_and_skips_images_without_both_scores():
    values = np.array([[0.2, 0.1], [0.2, 0.3], [0.2, 0.1], [0.2, np.nan]])
    (row,) = differences([make_stratum(values)], [("a", "lpips"), ("b", "lpips")], {"lpips": False})
    assert (row.improved_count, row.estimate.count) == (2, 3)
    assert row.estimate.mean == pytest.approx(-0.1 / 3)


def test_every_pair_of_methods_is_compared():
    series = [(method, "psnr") for method in "abc"]
    rows = differences([make_stratum(np.arange(6.0).reshape(2, 3))], series, {"psnr": True})
    assert [(row.method, row.reference) for row in rows] == [("b", "a"), ("c", "a"), ("c", "b")]
    assert differences([make_stratum([1.0])], series[:1], {"psnr": True}) == []


def test_each_benchmark_has_its_own_resamples():
    """With equal resamples, the errors of benchmarks would be added up in the interval of their average."""
    values = np.arange(12.0)
    one, other, same = (
        estimate_one([make_stratum(values, name=name)]) for name in ("nature", "real", "nature")
    )
    assert one == same
    assert (one.mean, one.count) == (other.mean, other.count)
    assert (one.low, one.high) != (other.low, other.high)


def test_the_interval_of_an_average_assumes_independent_benchmarks(rng):
    values = rng.normal(size=40)
    alone = estimate_one([make_stratum(values)])
    both = estimate_one([make_stratum(values, name=name) for name in ("a", "b")])
    assert both.high - both.low == pytest.approx((alone.high - alone.low) / 2**0.5, rel=0.1)
