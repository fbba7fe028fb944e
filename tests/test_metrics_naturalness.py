"""NIQE: laws, and the value of another implementation."""

from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from brewster.metrics import niqe
from brewster.metrics.naturalness import BLOCK_SIDE

PHOTO = Path(__file__).with_name("pictures") / "plain-astronaut.jpg"


@pytest.fixture(scope="module")
def photo():
    return Photo.open(PHOTO).srgb_8bit()


def test_noise_and_blur_raise_niqe(photo, rng):
    noisy = np.clip(photo + rng.normal(0, 25, photo.shape), 0, 255).astype(np.uint8)
    sums = sum(np.roll(photo.astype(int), (i, j), (0, 1)) for i in range(-3, 4) for j in range(-3, 4))
    assert 2 < niqe(photo) < 6
    assert niqe(noisy) > niqe(photo) + 1
    assert niqe((sums // 49).astype(np.uint8)) > niqe(photo) + 1


def test_only_whole_blocks_count(photo):
    rows, columns = (side // BLOCK_SIDE * BLOCK_SIDE for side in photo.shape[:2])
    assert niqe(photo) == pytest.approx(niqe(photo[:rows, :columns]), abs=1e-9)


def test_images_without_two_blocks_of_texture_have_no_niqe(photo, rng):
    with pytest.raises(ValueError, match="two blocks of 96x96"):
        niqe(photo[:96, :191])
    with pytest.raises(ValueError, match="two blocks of 96x96"):
        niqe(np.full((200, 300, 3), 80, np.uint8))
    with pytest.raises(ValueError, match="uint8"):
        niqe(photo.astype(float))
    assert niqe(rng.integers(0, 256, (96, 192, 3)).astype(np.uint8)) > 10


def test_a_negative_is_as_natural_as_the_photo(photo):
    """The negative swaps the left and the right half of each distribution."""
    assert niqe(255 - photo) == pytest.approx(niqe(photo), abs=1e-6)
