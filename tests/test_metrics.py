"""PSNR, SSIM and the table of metrics, compared with scikit-image and with values computed by
hand.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from brewster.errors import BrewsterError
from brewster.metrics import (
    METRICS,
    Metric,
    find_metric,
    linear_rmse,
    psnr,
    psnr_of_channels,
    reflection_region,
    ssim,
)
from brewster.metrics.metric import CachedImage, Comparison
from brewster.photo.srgb import to_linear

GAUSSIAN = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 255,
}
SCIKIT_ARGUMENTS = {"uniform": {"channel_axis": 2}, "gaussian": {"channel_axis": 2, **GAUSSIAN}}
BORDERS = {"uniform": 3, "gaussian": 5}

images = arrays(np.uint8, (13, 17, 3))
masks = arrays(np.bool_, (13, 17))
windows = st.sampled_from(sorted(SCIKIT_ARGUMENTS))


@given(images, images)
def test_psnr_equals_scikit_image(one, other):
    if (one != other).any():
        assert psnr(one, other) == pytest.approx(peak_signal_noise_ratio(other, one), abs=1e-9)


@given(images, images, windows)
def test_ssim_equals_scikit_image_with_either_window(one, other, window):
    expected = structural_similarity(other, one, **SCIKIT_ARGUMENTS[window])
    assert ssim(one, other, window=window) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("window", SCIKIT_ARGUMENTS)
@pytest.mark.parametrize("size", [(11, 11), (11, 40), (40, 12), (33, 47)])
def test_ssim_equals_scikit_image_at_any_size_and_near_white(rng, size, window):
    one, other = rng.integers(230, 256, (2, *size, 3), np.uint8)
    expected = structural_similarity(other, one, **SCIKIT_ARGUMENTS[window])
    assert ssim(one, other, window=window) == pytest.approx(expected, abs=1e-9)


def test_equal_images_have_infinite_psnr_and_an_ssim_of_one(rng):
    image = rng.integers(0, 256, (12, 12, 3), np.uint8)
    assert psnr(image, image) == float("inf")
    assert ssim(image, image) == ssim(image, image, window="gaussian") == pytest.approx(1)


def test_images_may_have_any_memory_layout(rng):
    one, other = rng.integers(0, 256, (2, 20, 26, 3), np.uint8)
    for a, b in (
        (one[::-1, ::2], other[::-1, ::2]),
        (one.transpose(1, 0, 2), other.transpose(1, 0, 2)),
    ):
        assert psnr(a, b) == psnr(a.copy(), b.copy())
        assert ssim(a, b) == pytest.approx(ssim(a.copy(), b.copy()), abs=1e-12)


@given(images, images, windows)
def test_a_region_that_is_the_whole_image_changes_nothing(one, other, window):
    whole = np.ones(one.shape[:2], bool)
    assert psnr(one, other, region=whole) == psnr(one, other)
    assert ssim(one, other, window=window, region=whole) == pytest.approx(
        ssim(one, other, window=window)
    )


@given(images, images, masks, windows)
def test_ssim_in_a_region_is_the_mean_of_the_map_of_scikit_image(one, other, mask, window):
    border = BORDERS[window]
    _, ssim_map = structural_similarity(other, one, full=True, **SCIKIT_ARGUMENTS[window])
    inner = (slice(border, -border),) * 2
    if mask[inner].any():
        expected = ssim_map[inner][mask[inner]].mean()
        assert ssim(one, other, window=window, region=mask) == pytest.approx(expected, abs=1e-9)
    else:
        with pytest.raises(ValueError, match="region"):
            ssim(one, other, window=window, region=mask)


def test_psnr_in_a_region_ignores_all_other_pixels(rng):
    truth = rng.integers(0, 200, (9, 9, 3), np.uint8)
    image = truth.copy()
    region = np.zeros((9, 9), bool)
    image[:3] += np.uint8(10)
    region[:3, 2:5] = True
    assert psnr(image, truth, region=region) == pytest.approx(28.1308, abs=1e-4)
    assert psnr(image, truth, region=~region & (image == truth).all(2)) == float("inf")


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_an_empty_region_and_one_of_another_shape_are_refused(metric):
    image = np.zeros((9, 9, 3), np.uint8)
    with pytest.raises(ValueError, match="empty"):
        metric(image, image, region=np.zeros((9, 9), bool))
    for wrong in (np.ones((9, 8), bool), np.ones((9, 9), np.uint8), np.ones((9, 9, 1), bool)):
        with pytest.raises(ValueError, match=r"must be bool \(9, 9\)"):
            metric(image, image, region=wrong)


def test_a_region_at_the_border_has_no_ssim():
    image = np.zeros((9, 9, 3), np.uint8)
    region = np.zeros((9, 9), bool)
    region[:3] = True
    with pytest.raises(ValueError, match="within 3 pixels of the border"):
        ssim(image, image, region=region)


@pytest.mark.parametrize("metric", [psnr, psnr_of_channels, linear_rmse, ssim, reflection_region])
@pytest.mark.parametrize(("image", "why"), [
    (np.zeros((8, 9, 3), np.uint8), "shape"),
    (np.zeros((8, 8, 4), np.uint8), r"must be uint8 \(H, W, 3\), not uint8 \(8, 8, 4\)"),
    (np.zeros((8, 8), np.uint8), "must be uint8"), (np.zeros((8, 8, 3)), "not float64"),
    (np.zeros((8, 8, 3), np.uint16), "not uint16"), (np.zeros((0, 8, 3), np.uint8), "must be"),
])  # fmt: skip
def test_images_of_another_type_or_shape_are_refused(metric, image, why):
    truth = np.zeros((8, 8, 3), np.uint8)
    for pair in ((image, truth), (truth, image)):
        with pytest.raises(ValueError, match=why):
            metric(*pair)


@pytest.mark.parametrize(("window", "side"), [("uniform", 7), ("gaussian", 11)])
def test_an_image_smaller_than_the_window_is_refused(window, side):
    with pytest.raises(ValueError, match=f"at least {side}x{side} pixels, not {side - 1}x20"):
        ssim(*np.zeros((2, side - 1, 20, 3), np.uint8), window=window)
    assert ssim(*np.zeros((2, side, side, 3), np.uint8), window=window) == 1


def test_the_linear_rmse_is_the_rms_of_the_light(rng):
    prediction, truth = rng.integers(0, 256, (2, 9, 12, 3)).astype(np.uint8)
    light, true_light = (to_linear(image / 255) for image in (prediction, truth))
    expected = ((light - true_light) ** 2).mean() ** 0.5
    assert linear_rmse(prediction, truth) == pytest.approx(expected, rel=1e-5)
    black = np.zeros((2, 2, 3), np.uint8)
    white = np.full((2, 2, 3), 255, np.uint8)
    assert linear_rmse(black, white) == pytest.approx(1)
    assert linear_rmse(white, white) == 0
    region = np.array([[True, False], [False, False]])
    black[0, 0] = 255
    assert linear_rmse(black, white, region=region) == 0
    assert linear_rmse(black, white) == pytest.approx(0.75**0.5)


def test_the_psnr_of_channels_is_the_mean_of_three_psnrs(rng):
    prediction, truth = rng.integers(0, 256, (2, 9, 12, 3)).astype(np.uint8)
    prediction[..., 0] = truth[..., 0] // 2
    channels = [
        np.repeat(image[..., i : i + 1], 3, 2) for i in range(3) for image in (prediction, truth)
    ]
    expected = np.mean([psnr(*channels[i : i + 2]) for i in (0, 2, 4)])
    assert psnr_of_channels(prediction, truth) == pytest.approx(expected)
    assert psnr_of_channels(prediction, truth) >= psnr(prediction, truth)
    assert psnr_of_channels(truth, truth) == float("inf")


def test_a_prediction_that_is_wrong_in_one_channel_only_is_not_perfect(rng):
    truth = rng.integers(0, 200, (9, 12, 3)).astype(np.uint8)
    prediction = truth.copy()
    prediction[..., 1] += 10
    case = Comparison(CachedImage(prediction), CachedImage(truth), truth)
    one_channel = 10 * np.log10(255**2 / 100)
    assert METRICS["psnr_channels"].score(case) == pytest.approx((100 + 100 + one_channel) / 3)
    assert (
        METRICS["psnr_channels"].score(Comparison(CachedImage(truth), CachedImage(truth), truth))
        == 100
    )


def test_a_metric_is_found_by_name_and_a_typing_error_gets_a_suggestion():
    assert find_metric("ssim_gaussian") is METRICS["ssim_gaussian"]
    assert isinstance(find_metric("lpips"), Metric)
    with pytest.raises(BrewsterError, match=r"no metric 'lpisp'.*did you mean lpips\?"):
        find_metric("lpisp")
    with pytest.raises(BrewsterError, match=r"expected one of psnr, ssim, .* choose one"):
        find_metric("sharpness")
