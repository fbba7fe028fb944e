"""Clipped light is left alone or removed whole, region by region, and all other predictions are
kept.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster import Separator
from brewster.photo import Photo
from brewster.photo.mask import label_regions
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation import tiles
from brewster.separation.clipping import keep_clipped_light
from brewster.separation.predictor import Prediction

SIZE = (64, 80)
LAMP = np.s_[16:28, 20:34]
COLOURS = {
    "white": (255,) * 3,
    "warm": (253, 254, 178),
    "red": (254, 60, 40),
    "unclipped": (225, 220, 210),
}


def lamp_photo(colour=(253, 254, 178), wall=(60, 50, 40), size=SIZE, lamp=LAMP):
    pixels = np.empty((*size, 3), np.uint8)
    pixels[:] = wall
    pixels[lamp] = colour
    return pixels


def linear(pixels):
    return to_linear(pixels.astype(np.float32) / 255)


def predict(photo, transmission):
    confidence = np.ones((*photo.shape[:2], 1), np.float32)
    return Prediction(transmission - photo, photo - transmission, confidence)


def separate(pixels, keeps, **options):
    """Separates a photo with a model that keeps a share of the light of all pixels brighter than
    the wall.
    """

    def model(tile):
        is_lamp = tile.max(axis=2, keepdims=True) > 0.2
        transmission = np.where(is_lamp, keeps * tile, tile).astype(np.float32)
        return transmission, tile - transmission

    return Separator(model, name="lamp")(Photo.from_array(pixels, encoding="srgb"), **options)


@pytest.mark.parametrize("colour", COLOURS.values(), ids=COLOURS)
def test_a_half_removed_lamp_is_left_alone_in_all_channels(colour):
    pixels = lamp_photo(colour)
    separation = separate(pixels, 0.6)
    np.testing.assert_array_equal(separation.transmission.pixels, pixels)
    assert separation.reflection.pixels.max() == 0


def test_a_region_that_ends_within_a_veil_leaves_no_outline_there():
    columns = np.linspace(-1, 1, 160, dtype=np.float32)
    veil = 0.75 * np.exp(-12 * (columns[None, :, None] ** 2 + columns[:120, None, None] ** 2))
    photo = np.repeat(0.05 + veil, 3, axis=2)
    transmission = photo + keep_clipped_light(photo, predict(photo, 0.5 * photo)).change
    assert transmission.max() > 0.9 * photo.max()
    steps = [np.abs(np.diff(to_encoded(image), axis=1)).max() for image in (photo, transmission)]
    assert steps[1] < 2 * steps[0]


@pytest.mark.parametrize("colour", COLOURS.values(), ids=COLOURS)
def test_a_bright_reflection_that_disappears_is_removed_whole(colour):
    photo = linear(lamp_photo(colour))
    prediction = predict(photo, linear(lamp_photo((66, 56, 46))))
    np.testing.assert_array_equal(keep_clipped_light(photo, prediction).change, prediction.change)


def test_each_region_has_its_own_decision():
    pixels = lamp_photo(size=(64, 96))
    pixels[16:28, 60:74] = 255
    transmission = linear(pixels)
    transmission[LAMP] *= 0.5
    transmission[16:28, 60:74] = transmission[0, 0]
    photo = linear(pixels)
    kept = keep_clipped_light(photo, predict(photo, transmission)).change
    assert (kept[LAMP] == 0).all()
    np.testing.assert_array_equal(kept[16:28, 60:74], (transmission - photo)[16:28, 60:74])


def marked(photo, *strokes, channel=0):
    hints = np.zeros((*photo.shape[:2], 2), np.float32)
    for stroke in strokes:
        hints[(*stroke, channel)] = 1
    return np.concatenate([photo, hints], axis=2)


GLINT = np.s_[20:26, 30:36]


def test_a_marked_glint_is_released_but_a_glint_marked_as_scene_is_not():
    photo = linear(lamp_photo(size=(120, 160), lamp=GLINT))
    prediction = predict(photo, 0.5 * photo)
    stroke = np.s_[18:28, 26:40]
    released, kept = (
        keep_clipped_light(marked(photo, stroke, channel=channel), prediction).change
        for channel in (0, 1)
    )
    np.testing.assert_array_equal(released[GLINT], prediction.change[GLINT])
    assert (kept[GLINT] == 0).all()


@pytest.mark.parametrize(
    "stroke", [np.s_[20:24, 10:50], np.s_[10:34, 14:40]], ids=["across", "over it"]
)
def test_a_stroke_across_a_lamp_or_over_a_wide_window_leaves_it(stroke):
    photo = linear(lamp_photo())
    kept = keep_clipped_light(marked(photo, stroke), predict(photo, 0.5 * photo)).change
    assert (kept[LAMP] == 0).all()


@pytest.mark.parametrize("keeps", [0.0, 0.06])
@pytest.mark.parametrize("size", [(120, 160), (500, 640)])
def test_under_a_stroke_a_clipped_glint_is_not_darker_than_its_surroundings(keeps, size):
    height, width = size
    top, left = height // 2, width // 3
    glint = np.s_[top : top + height // 25, left : left + width // 30]
    pixels = lamp_photo((255, 255, 255), (110, 100, 90), size, glint)
    hints = np.zeros_like(pixels)
    hints[top - height // 20 : top + height // 12, left - width // 20 : left + width // 12, 0] = 255

    def model(tile, hints=None):
        """Subtracts light where the photo is brighter than the wall, as much as if it were not
        clipped.
        """
        is_bright = tile.max(axis=2, keepdims=True) > 0.2
        transmission = np.where(is_bright, np.float32(keeps) * tile, tile)
        return transmission, tile - transmission

    model.takes_hints = True
    photo = Photo.from_array(pixels, encoding="srgb")
    transmission = Separator(model)(photo, hints=hints).transmission.pixels
    assert (transmission.astype(int) >= pixels.min(axis=(0, 1)) - 3).all()


def test_a_reflection_under_a_stroke_that_is_not_clipped_is_removed_as_predicted():
    photo = linear(lamp_photo((225, 220, 210)))
    prediction = predict(photo, 0.5 * photo)
    kept = keep_clipped_light(marked(photo, np.s_[18:26, 22:32]), prediction).change
    np.testing.assert_array_equal(kept, prediction.change)


@settings(deadline=None)
@given(st.floats(0, 1), st.integers(0, 2**32 - 1), st.sampled_from(list(COLOURS.values())))
def test_a_bright_region_is_changed_in_all_of_its_pixels_or_in_none(keeps, seed, colour):
    random = np.random.default_rng(seed)
    photo = linear(lamp_photo(colour))
    transmission = photo.copy()
    transmission[LAMP] *= np.float32(keeps) * random.uniform(0.9, 1.0, (12, 14, 1)).astype(
        np.float32
    )
    prediction = predict(photo, transmission)
    kept = keep_clipped_light(photo, prediction)
    is_visible = (
        np.abs(np.subtract(*map(to_encoded, (photo, transmission)))).max(axis=2)[LAMP] > 0.021
    )
    changes = kept.change[LAMP][is_visible]
    predicted = prediction.change[LAMP][is_visible]
    assert (changes == 0).all() or (changes == predicted).all()
    assert (np.abs(kept.change) <= np.abs(prediction.change)).all()
    assert (kept.change * prediction.change >= 0).all()
    np.testing.assert_array_equal(kept.change, -kept.reflection)


@given(st.floats(0, 1), st.floats(0, 1))
def test_a_photo_without_bright_light_keeps_its_prediction(photo_level, transmission_level):
    photo = to_linear(np.full((6, 8, 3), 0.75 * photo_level, np.float32))
    prediction = predict(photo, np.full_like(photo, transmission_level))
    np.testing.assert_array_equal(keep_clipped_light(photo, prediction).change, prediction.change)


def test_a_veil_over_a_wide_white_wall_is_removed_but_over_a_clipped_one_it_is_left():
    for level, is_kept in ((0.85, False), (1.0, True)):
        photo = to_linear(np.full((40, 40, 3), level, np.float32))
        kept = keep_clipped_light(photo, predict(photo, photo * np.float32(0.8)))
        assert (kept.change == 0).all() == is_kept


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_two_pixels_have_the_same_label_if_a_path_connects_them(height, width, seed):
    mask = np.random.default_rng(seed).random((height, width)) < 0.6
    labels = label_regions(mask)
    assert ((labels > 0) == mask).all()
    for axis in (0, 1):
        one, other = (np.delete(labels, end, axis) for end in (0, -1))
        assert (one == other)[(one > 0) & (other > 0)].all()
    padded = np.pad(mask, 1)
    expected = set()  # the regions, by flood fill
    for start in zip(*np.nonzero(mask), strict=True):
        region = set()
        open_pixels = [tuple(map(int, start))]
        while open_pixels:
            row, column = open_pixels.pop()
            if (row, column) in region or not padded[row + 1, column + 1]:
                continue
            region.add((row, column))
            open_pixels += [
                (row + 1, column),
                (row - 1, column),
                (row, column + 1),
                (row, column - 1),
            ]
        expected.add(frozenset(region))
    assert len(np.unique(labels[mask])) == len(expected)


@pytest.mark.parametrize("strength", [0.3, 1.0])
@pytest.mark.parametrize("quality", ["draft", "standard"])
def test_a_lamp_is_kept_at_any_strength_and_quality_level_and_with_a_mask(strength, quality):
    pixels = lamp_photo(size=(400, 600), lamp=np.s_[100:160, 200:270])
    pixels[200:] = 150  # a grey floor from which the model removes light
    mask = np.full((400, 600), 255, np.uint8)
    mask[:, 300:] = 0
    separation = separate(pixels, 0.6, strength=strength, quality=quality, mask=mask)
    transmission = separation.transmission.pixels
    difference = np.abs(transmission[:190].astype(int) - pixels[:190])
    assert difference.max() <= 8  # no rim: reduced photos have pixels between lamp and wall
    assert difference[102:158, 202:268].max() == 0
    np.testing.assert_array_equal(transmission[:, 302:], pixels[:, 302:])
    assert (transmission[210:, :290] < 150).all()


def test_a_lamp_at_the_edge_of_two_tiles_is_kept(monkeypatch):
    pixels = lamp_photo(size=(64, 160), lamp=np.s_[20:44, 60:100])
    original = tiles.run_tiled
    monkeypatch.setattr(
        "brewster.separation.predictor.run_tiled",
        lambda backend, image, **_: original(backend, image, tile_px=96, overlap_px=32),
    )
    np.testing.assert_array_equal(separate(pixels, 0.6).transmission.pixels, pixels)


def test_a_lamp_keeps_16_bits_and_values_above_white():
    deep = lamp_photo((253, 254, 178)).astype(np.uint16) * 257
    np.testing.assert_array_equal(separate(deep, 0.6).transmission.pixels, deep)
    light = linear(lamp_photo())
    light[LAMP] = 12.0  # an HDR photo: the 99th percentile becomes white
    separation = Separator(lambda tile: (0.6 * tile, 0.4 * tile))(
        Photo.from_array(light, encoding="linear")
    )
    np.testing.assert_allclose(separation.transmission.linear()[LAMP], 12.0, rtol=1e-5)
