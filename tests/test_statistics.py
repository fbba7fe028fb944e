"""Intervals have their stated coverage and depend on the pictures alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster.evaluate.statistics import Stratum, differences, estimate


def stratum(values, scenes=None, name="set"):
    values = np.atleast_2d(np.asarray(values, float).T).T
    return Stratum(name, scenes or [str(i) for i in range(len(values))], values)


def only(strata):
    (estimated,) = estimate(strata)
    return estimated


def test_the_mean_is_over_all_pictures_not_over_benchmarks():
    estimated = only([stratum([1.0, 1.0, 1.0], name="a"), stratum([5.0], name="b")])
    assert estimated.mean == 2.0
    assert estimated.count == 4


def test_the_interval_of_a_constant_has_no_width():
    estimated = only([stratum([3.0] * 10)])
    assert (estimated.low, estimated.mean, estimated.high) == (3.0, 3.0, 3.0)


def test_one_scene_has_no_interval():
    assert only([stratum([1.0, 2.0, 3.0], scenes=["x"] * 3)]).low is None


def test_a_score_of_a_single_picture_has_no_interval():
    assert only([stratum([1.0, np.nan, np.nan])]).low is None
    assert only([stratum([1.0], name="a"), stratum([2.0], name="b")]).low is None
    assert only([stratum([1.0], name="a"), stratum([2.0, 3.0], name="b")]).low is not None


def test_missing_values_are_not_counted():
    estimated = only([stratum([1.0, np.nan, 3.0])])
    assert (estimated.mean, estimated.count) == (2.0, 2)
    assert only([stratum([np.nan, np.nan])]) is None


def test_intervals_agree_with_the_normal_ones_where_those_hold(random):
    values = random.normal(20, 3, 400)
    estimated = only([stratum(values)])
    half = 1.96 * values.std(ddof=1) / np.sqrt(400)
    assert estimated.high - estimated.mean == pytest.approx(half, rel=0.06)
    assert estimated.mean - estimated.low == pytest.approx(half, rel=0.06)


def test_intervals_cover_the_truth_at_their_stated_rate(random):
    """95 % of intervals of means of 60 pictures; a percentile bootstrap is a little short of it at such sizes."""
    hits = 0
    for i in range(200):
        estimated = only([stratum(random.normal(0, 1, 60), name=str(i))])
        hits += estimated.low <= 0 <= estimated.high
    assert 0.90 <= hits / 200 <= 0.99


def test_ten_variants_of_a_scene_hardly_narrow_the_interval(random):
    scenes = random.normal(0, 1, 20)
    one = only([stratum(scenes)])
    ten = only([stratum(np.repeat(scenes, 10), scenes=[str(i // 10) for i in range(200)])])
    assert ten.high - ten.low == pytest.approx(one.high - one.low, rel=0.05)


def test_a_benchmarks_interval_does_not_depend_on_its_order_nor_on_its_neighbours(random):
    values, scenes = random.normal(0, 1, 12), [f"s{i % 4}" for i in range(12)]
    turned = random.permutation(12)
    a = only([stratum(values, scenes)])
    b = only([stratum(values[turned], [scenes[i] for i in turned])])
    assert a.low == pytest.approx(b.low)
    assert a.high == pytest.approx(b.high)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=20))
def test_the_mean_lies_in_its_interval_and_that_between_the_extremes(values):
    estimated = only([stratum(values)])
    assert min(values) - 1e-9 <= estimated.low <= estimated.high <= max(values) + 1e-9
    assert estimated.mean == pytest.approx(np.mean(values), abs=1e-9)


def test_paired_differences_have_narrower_intervals_than_the_means(random):
    pictures = random.normal(22, 5, 50)
    values = np.stack([pictures, pictures + random.normal(0.5, 0.1, 50)], axis=1)
    series = [("nothing", "psnr"), ("ours", "psnr")]
    (row,) = differences([stratum(values)], series, {"psnr": True})
    assert (row.method, row.than, row.metric) == ("ours", "nothing", "psnr")
    assert row.estimate.mean == pytest.approx(0.5, abs=0.06)
    assert row.estimate.high - row.estimate.low < 0.1
    assert estimate([stratum(values)])[0].high - estimate([stratum(values)])[0].low > 2
    assert row.better == 50


def test_better_follows_the_metrics_direction_and_skips_pictures_that_one_of_the_two_lacks():
    values = np.array([[0.2, 0.1], [0.2, 0.3], [0.2, 0.1], [0.2, np.nan]])
    (row,) = differences([stratum(values)], [("a", "lpips"), ("b", "lpips")], {"lpips": False})
    assert (row.better, row.estimate.count) == (2, 3)
    assert row.estimate.mean == pytest.approx(-0.1 / 3)


def test_every_pair_of_methods_is_compared():
    series = [(method, "psnr") for method in "abc"]
    rows = differences([stratum(np.arange(6.0).reshape(2, 3))], series, {"psnr": True})
    assert [(row.method, row.than) for row in rows] == [("b", "a"), ("c", "a"), ("c", "b")]
    assert differences([stratum([1.0])], series[:1], {"psnr": True}) == []
