"""Flipped and shifted predictions are noticed, and others are not."""

import numpy as np
import pytest

from brewster.evaluate.registration import find_misregistration


def scene(rng, height=200, width=270):
    """Noise with the spectrum of photographs, uint8 (H, W, 3)."""
    squares = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.fftfreq(width) ** 2
    spectrum = np.fft.fft2(rng.standard_normal((height, width, 3)), axes=(0, 1))
    values = np.fft.ifft2(spectrum / (squares + 1e-4)[..., None] ** 0.5, axes=(0, 1)).real
    return (255 * (values - values.min()) / (values.max() - values.min())).astype(np.uint8)


@pytest.fixture
def photo(rng):
    return scene(rng)


@pytest.mark.parametrize(("flip", "found"), [
    (np.s_[:, ::-1], "mirrored left to right"), (np.s_[::-1], "mirrored top to bottom"),
    (np.s_[::-1, ::-1], "rotated by 180 degrees"),
])  # fmt: skip
def test_a_flip_is_found_with_the_changes_of_a_good_method(photo, rng, flip, found):
    prediction = (0.7 * photo + 0.3 * scene(rng)).astype(np.uint8)
    assert find_misregistration(prediction, photo) == ""
    assert find_misregistration(prediction[flip], photo) == found


@pytest.mark.parametrize(("rows", "columns", "found"), [
    (0, 12, "shifted by about 12 px to the right"), (-8, 0, "shifted by about 8 px up"),
    (6, -10, "shifted by about 6 px down and 10 px to the left"),
])  # fmt: skip
def test_a_shift_is_found_with_its_direction(photo, rows, columns, found):
    assert find_misregistration(np.roll(photo, (rows, columns), axis=(0, 1)), photo) == found


def test_small_shifts_other_images_and_flat_images_give_no_remark(photo, rng):
    assert find_misregistration(np.roll(photo, 1, axis=1), photo) == ""
    assert find_misregistration(scene(rng), photo) == ""
    assert find_misregistration(np.full_like(photo, 90), photo) == ""
    for size in (8, 16, 24):
        noise = rng.integers(0, 256, (2, size, size, 3)).astype(np.uint8)
        assert find_misregistration(*noise) == ""
    assert find_misregistration(photo[:3, :3], photo[:3, :3]) == ""
