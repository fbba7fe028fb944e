"""Hints: what a person paints, and how it reaches the network."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from brewster.errors import MaskError
from brewster.photo import Hints, Photo
from brewster.separation.separator import Separator
from brewster.training.data.hints import simulate_hints
from brewster.training.data.mixtures import TrainingBatch

RED = (255, 0, 0)
GREEN = (0, 255, 0)
PHOTO = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"


def painted(width=40, height=30, background=(0, 0, 0)):
    image = np.full((height, width, 3), background, np.uint8)
    image[:10, :20] = RED
    image[20:, 20:] = GREEN
    return image


@pytest.mark.parametrize("background", [(0, 0, 0), (255, 255, 255), (90, 90, 90), (0, 0, 255)])
def test_red_is_reflection_green_is_scene_and_other_colours_are_no_hint(background):
    hints = Hints.open(painted(background=background), (40, 30)).sampled(40, 30)
    expected = np.zeros((30, 40, 2))
    expected[:10, :20, 0] = expected[20:, 20:, 1] = 1
    np.testing.assert_array_equal(hints, expected)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint16, 65535), (np.float32, 1.0)])
def test_hints_of_other_depths_are_the_same(dtype, white):
    image = (painted() / 255 * white).astype(dtype)
    assert (Hints.open(image, (40, 30)).values == Hints.open(painted(), (40, 30)).values).all()


def test_transparent_paint_is_a_soft_hint(tmp_path):
    alpha = np.full((30, 40, 1), 51, np.uint8)
    Image.fromarray(np.concatenate([painted(), alpha], axis=2)).save(tmp_path / "hints.png")
    assert Hints.open(tmp_path / "hints.png", (40, 30)).sampled(4, 3).max() == pytest.approx(
        0.2, abs=0.01
    )


@pytest.mark.parametrize(
    "image", [np.zeros((30, 40, 3), np.uint8), painted(41), np.zeros((30, 40), np.uint8)]
)
def test_an_image_without_paint_or_of_another_size_is_an_error(image):
    with pytest.raises(MaskError):
        Hints.open(image, (40, 30))


def test_strokes_may_be_painted_over_a_copy_of_the_photo():
    photo = np.asarray(Image.open(PHOTO).convert("RGB"))
    image = photo.copy()
    image[:40, :50] = RED
    values = Hints.open(image, photo.shape[1::-1]).values
    assert (values[:40, :50, 0] == 255).all()
    assert (values[40:] > 80).mean() < 0.01
    with pytest.raises(MaskError):
        Hints.open(np.full_like(photo, (150, 60, 50)), photo.shape[1::-1])


class Eraser:
    """Removes all light where the hint says reflection. Stores the hints of each call."""

    takes_hints = True

    def __init__(self):
        self.calls = []

    def __call__(self, tile, hints=None):
        self.calls.append(hints)
        share = np.zeros_like(tile[..., :1]) if hints is None else hints[..., :1]
        return tile * (1 - share), tile * share


def test_hints_reach_the_model_at_every_scale_and_in_place_together_with_a_mask():
    eraser = Eraser()
    photo = np.full((300, 400, 3), 120, np.uint8)
    image = np.zeros_like(photo)
    image[:, :200] = RED
    mask = np.zeros(photo.shape[:2], np.uint8)
    mask[:150] = 255
    separate = Separator(eraser)
    transmission = separate(photo, encoding="srgb", hints=image, mask=mask).transmission.pixels
    assert all(call is not None for call in eraser.calls)
    assert transmission[20:130, 20:180].max() < 20  # hinted and inside the mask
    assert (transmission[:130, 220:] > 110).all()  # no hint
    assert (transmission[170:] == 120).all()  # outside the mask
    without = separate(photo, encoding="srgb").transmission.pixels
    assert (without == 120).all()


def test_a_glint_that_is_marked_as_reflection_is_removed_although_the_model_removes_half_of_it():
    photo = np.full((200, 240, 3), 60, np.uint8)
    photo[85:99, 110:125] = 255
    hints = np.zeros_like(photo)
    hints[80:110, 100:140] = RED

    def half(tile, hints=None):
        is_lamp = tile.max(axis=2, keepdims=True) > 0.9
        return np.where(is_lamp, 0.5 * tile, tile), np.where(is_lamp, 0.5 * tile, 0)

    half.takes_hints = True
    separator = Separator(half)
    marked = separator(photo, encoding="srgb", hints=hints).transmission.pixels
    assert marked[90:95, 114:120].max() < 200
    np.testing.assert_array_equal(separator(photo, encoding="srgb").transmission.pixels, photo)


def test_a_model_without_hints_refuses_them():
    separator = Separator(lambda tile: (tile, 0 * tile))
    with pytest.raises(MaskError, match="takes none"):
        separator(np.zeros((30, 40, 3), np.uint8), encoding="srgb", hints=painted())


def batch_with_reflection_on_the_left(count=64, side=128):
    transmission = torch.full((count, 3, side, side), 0.5)
    reflection = torch.zeros_like(transmission)
    reflection[..., : side // 2] = 0.6
    return TrainingBatch(transmission, transmission, reflection, torch.ones(count, 1, 1, 1))


def test_simulated_hints_lie_mostly_where_they_are_true_and_half_of_the_samples_have_none():
    batch = batch_with_reflection_on_the_left()
    hints = simulate_hints(batch, probability=0.5, seed=1, step=3)
    assert torch.equal(hints, simulate_hints(batch, probability=0.5, seed=1, step=3))
    assert not torch.equal(hints, simulate_hints(batch, probability=0.5, seed=1, step=4))
    has_hints = hints.flatten(1).any(dim=1)
    assert 16 < has_hints.sum() < 48
    reflection_hint, scene_hint = hints.sum(dim=0)
    assert reflection_hint[:, :64].sum() > 5 * reflection_hint[:, 64:].sum()
    assert scene_hint[:, 64:].sum() > 5 * scene_hint[:, :64].sum()


def test_the_shipped_model_removes_more_under_a_hint_and_hardly_anything_far_from_it():
    photo = np.asarray(Image.open(PHOTO).convert("RGB"))
    image = np.zeros_like(photo)
    rows, columns = slice(0, photo.shape[0] // 2), slice(0, photo.shape[1] // 4)
    image[rows, columns] = RED
    separator = Separator.load()
    plain, hinted = (separator(photo, hints=hints).transmission.linear() for hints in (None, image))
    assert hinted[rows, columns].mean() < 0.95 * plain[rows, columns].mean()
    far = slice(photo.shape[1] // 2, None)
    change = np.abs(hinted - plain)
    assert change[:, far].mean() < 0.1 * change[rows, columns].mean()
    np.testing.assert_allclose(hinted[:, far], plain[:, far], atol=0.035)


# --- ordinary photos are no hints

FLOWERS = np.random.default_rng(3).integers(0, 60, (90, 120, 3)).astype(np.uint8) + np.uint8(40)
FLOWERS[20:60, 30:80] = np.random.default_rng(4).integers(
    (130, 0, 0), (215, 30, 30), (40, 50, 3), np.uint8
)
"""A photo with red flowers: saturated, of uneven brightness."""


def jpeg_of(array, quality):
    file = io.BytesIO()
    Image.fromarray(array).save(file, "JPEG", quality=quality)
    return file.getvalue()


def test_a_photo_with_red_things_is_no_image_of_strokes():
    with pytest.raises(MaskError, match="like a photo"):
        Hints.open(FLOWERS, (120, 90))
    other = Photo.from_array(FLOWERS[::-1].copy())
    with pytest.raises(MaskError, match="like a photo"):
        Hints.open(FLOWERS, (120, 90), other)


def test_the_photo_itself_has_no_strokes_also_after_compression():
    photo = Photo.from_array(FLOWERS)
    for source in (FLOWERS, jpeg_of(FLOWERS, 90)):
        with pytest.raises(MaskError):
            Hints.open(source, (120, 90), photo)


@pytest.mark.parametrize("quality", [None, 95, 60])
def test_strokes_over_a_photo_with_red_things_are_hints_and_the_things_are_not(quality):
    painted = FLOWERS.copy()
    painted[5:13, 10:110] = RED
    painted[70:80, 5:60] = GREEN
    source = painted if quality is None else jpeg_of(painted, quality)
    values = Hints.open(source, (120, 90), Photo.from_array(FLOWERS)).values
    assert (values[7:11, 15:105, 0] > 220).mean() > 0.98
    assert (values[72:78, 10:55, 1] > 220).mean() > 0.98
    assert (values[24:56, 34:76] > 0).mean() < 0.05


@pytest.mark.parametrize("level", [90, 160, 255])
@pytest.mark.parametrize("is_transparent", [False, True])
def test_soft_or_dark_strokes_on_nothing_are_hints(level, is_transparent):
    image = np.zeros((90, 120, 4), np.uint8)
    image[20:40, 20:100, 0] = np.linspace(20, level, 80).astype(np.uint8)
    image[..., 3] = 255 if not is_transparent else np.where(image[..., 0] > 0, 128, 0)
    assert Hints.open(image, (120, 90)).values.any()
