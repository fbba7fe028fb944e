import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from brewster.metrics import psnr, ssim

pictures = arrays(np.uint8, (11, 13, 3))


@given(pictures, pictures)
def test_psnr_and_ssim_equal_scikit_image(one, other):
    if (one != other).any():
        assert psnr(one, other) == pytest.approx(peak_signal_noise_ratio(other, one), abs=1e-9)
    assert ssim(one, other) == pytest.approx(structural_similarity(other, one, channel_axis=2), abs=1e-9)


def test_equal_pictures_are_perfect(random):
    picture = random.integers(0, 256, (9, 9, 3), np.uint8)
    assert psnr(picture, picture) == float("inf")
    assert ssim(picture, picture) == pytest.approx(1)


def test_a_constant_offset_of_ten_is_28_decibels():
    picture = np.full((8, 8, 3), 100, np.uint8)
    assert psnr(picture + np.uint8(10), picture) == pytest.approx(28.1308, abs=1e-4)


@given(st.sampled_from([psnr, ssim]))
def test_pictures_of_different_shapes_are_refused(metric):
    with pytest.raises(ValueError, match="shape"):
        metric(np.zeros((8, 8, 3), np.uint8), np.zeros((8, 9, 3), np.uint8))


def test_a_picture_smaller_than_the_window_is_refused():
    with pytest.raises(ValueError, match="7x7"):
        ssim(np.zeros((6, 9, 3), np.uint8), np.zeros((6, 9, 3), np.uint8))
