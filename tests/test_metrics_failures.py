"""The failure metrics (removed content, remaining reflection) on scenes that these tests compute in
linear light.
"""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brewster.metrics import kept_reflection, removed_content, removed_white
from brewster.photo.srgb import to_encoded, to_linear

SIDE = 48
TRANSMITTANCE = 0.8
WHITE = (slice(4, 20), slice(4, 20))  # a white sheet behind the left half, which has no reflection
SCORES = (removed_content, removed_white, kept_reflection)

images = arrays(np.uint8, (16, 16, 3))


def encode(light):
    return (to_encoded(light.clip(0, 1)) * 255).round().astype(np.uint8)


def brighten(image, gain):
    return encode(to_linear(image / 255) * gain)


@pytest.fixture
def scene():
    """Background, photo and reflection; only the right half of the pane has a reflection."""
    rng = np.random.default_rng(7)
    background_light = rng.uniform(0.05, 0.4, (SIDE, SIDE, 3))
    background_light[WHITE] = 0.8
    reflection_light = np.zeros_like(background_light)
    reflection_light[:, SIDE // 2 :] = rng.uniform(0.1, 0.3, (SIDE, SIDE // 2, 3))
    photo_light = TRANSMITTANCE * background_light + reflection_light
    return tuple(map(encode, (background_light, photo_light, reflection_light)))


@pytest.mark.parametrize("gain", [TRANSMITTANCE, 0.64, 0.5])
def test_a_prediction_that_does_not_restore_absorbed_light_scores_zero(scene, gain):
    background, photo, reflection = scene
    scores = [score(brighten(background, gain), background, photo, reflection) for score in SCORES]
    assert scores == pytest.approx([0, 0, 0], abs=0.01)


def test_the_unprocessed_photo_contains_all_of_the_reflection_and_all_content(scene):
    background, photo, reflection = scene
    content, white, remaining = (score(photo, background, photo, reflection) for score in SCORES)
    assert (content, white) == pytest.approx((0, 0), abs=0.01)
    assert remaining == pytest.approx(1, abs=0.01)


def test_a_prediction_with_half_of_the_reflection_scores_one_half(scene):
    background, photo, reflection = scene
    light = [to_linear(image / 255) for image in (background, reflection)]
    prediction = encode(light[0] + light[1] / 2)
    assert kept_reflection(prediction, background, photo, reflection) == pytest.approx(
        0.5, abs=0.01
    )


def test_a_removed_white_sheet_counts_as_removed_white(scene):
    background, photo, reflection = scene
    prediction = background.copy()
    prediction[WHITE] = 0
    left = np.s_[:, : SIDE // 2]
    sheet = to_linear(background[WHITE] / 255).sum() / to_linear(background[left] / 255).sum()
    assert removed_white(prediction, background, photo, reflection) == 1
    assert removed_content(prediction, background, photo, reflection) == pytest.approx(
        sheet, abs=0.01
    )
    assert kept_reflection(prediction, background, photo, reflection) == 0


def test_a_black_prediction_removes_all_content_and_all_reflection(scene):
    background, photo, reflection = scene
    assert [score(np.zeros_like(photo), background, photo, reflection) for score in SCORES] == [
        1,
        1,
        0,
    ]


def test_a_third_of_the_pixels_at_half_their_light_does_not_change_the_gain(scene):
    """The gain is a median: the correct two thirds determine it, and half of the light of the
    others is missing.
    """
    background, photo, reflection = scene
    third = np.s_[: SIDE // 3]
    light = to_linear(background / 255)
    prediction = light * 0.7
    prediction[third] /= 2
    unreflected = np.s_[:, : SIDE // 2]
    lost = light[third][unreflected].sum() / 2 / light[unreflected].sum()
    assert removed_content(encode(prediction), background, photo, reflection) == pytest.approx(
        lost, abs=0.01
    )


def scene_with_share(share):
    """Returns background, photo and reflection. In the right half, this share of the photo's light
    is reflection.
    """
    background_light = np.full((SIDE, SIDE, 3), 0.3)
    reflection_light = np.zeros_like(background_light)
    reflection_light[:, SIDE // 2 :] = 0.3 * share / (1 - share)
    return (
        encode(background_light),
        encode(background_light + reflection_light),
        encode(reflection_light),
    )


@pytest.mark.parametrize(("share", "lost"), [(0.01, 0.5), (0.05, 0), (0.15, 0)])
def test_content_counts_where_the_reflection_is_less_than_two_percent(share, lost):
    background, photo, reflection = scene_with_share(share)
    prediction = background.copy()
    prediction[:, SIDE // 2 :] = 0
    assert removed_content(prediction, background, photo, reflection) == pytest.approx(
        lost, abs=0.01
    )


def test_a_reflection_counts_if_it_is_at_least_a_tenth_of_the_photo():
    assert kept_reflection(scene_with_share(0.12)[1], *scene_with_share(0.12)) == pytest.approx(
        1, abs=0.05
    )
    with pytest.raises(ValueError, match="0 pixels have R >= 10%"):
        kept_reflection(scene_with_share(0.08)[1], *scene_with_share(0.08))


def test_pixels_where_the_photo_is_clipped_do_not_count_for_the_reflection():
    background = np.full((SIDE, SIDE, 3), 0.5)
    reflection_light = np.zeros((SIDE, SIDE, 3))
    reflection_light[:, SIDE // 2 :] = 0.6
    layers = [
        encode(layer) for layer in (background, background + reflection_light, reflection_light)
    ]
    with pytest.raises(ValueError, match=r"0 pixels have .* not clipped"):
        kept_reflection(layers[1], *layers)


@pytest.mark.parametrize(
    ("sheet", "is_white"),
    [
        ((200, 200, 200), True),
        ((185, 185, 185), False),
        ((250, 250, 225), True),
        ((250, 250, 200), False),
    ],
)
def test_white_is_bright_in_all_channels_and_without_colour(scene, sheet, is_white):
    """Encoded channels above 0.75 x 255 = 191 that differ by less than 0.12 x 255 = 31."""
    background, photo, reflection = scene
    background = background.copy()
    background[30:46, 4:20] = sheet
    prediction = background.copy()
    prediction[30:46, 4:20] = 0
    assert (removed_white(prediction, background, photo, reflection) > 0.1) == is_white


@pytest.mark.parametrize("gain", [0.8, 1.1])
def test_scores_hardly_depend_on_the_brightness_of_a_prediction(scene, gain):
    background, photo, reflection = scene
    prediction = encode(to_linear(background / 255) * 0.7 + to_linear(reflection / 255) * 0.4)
    prediction[WHITE] //= 2
    for score in SCORES:
        expected = pytest.approx(score(prediction, background, photo, reflection), abs=0.02)
        assert score(brighten(prediction, gain), background, photo, reflection) == expected


def test_clipped_values_do_not_change_the_gain(scene):
    background, photo, reflection = scene
    background = background.copy()
    background[:, :20] = (
        255  # most of the pixels without reflection, where the prediction is too dark
    )
    prediction = brighten(background, 0.5)
    prediction[:, :20] = 255
    assert kept_reflection(prediction, background, photo, reflection) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("channel", range(3))
@pytest.mark.parametrize("clipped", ["prediction", "background"])
def test_a_pixel_that_is_clipped_in_one_channel_does_not_change_the_gain(scene, clipped, channel):
    """Most of the pixels without reflection are clipped, where the ratio of light is no half."""
    background, photo, reflection = scene
    background = background.copy()
    light = to_linear(background / 255) + to_linear(reflection / 255) / 2
    prediction = encode(light / 2)
    if clipped == "background":
        background[:, :20, channel] = 255
        prediction[:, :20] = brighten(background[:, :20], 0.25)
    else:
        prediction[:, :20] = 0
        prediction[:, :20, channel] = 255
    remaining = kept_reflection(prediction, background, photo, reflection)
    assert remaining == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("channel", range(3))
def test_a_pixel_that_is_clipped_in_one_channel_does_not_count_for_the_reflection(channel):
    background, photo, reflection = scene_with_share(0.3)
    photo = photo.copy()
    photo[:, :, channel] = 254
    with pytest.raises(ValueError, match=r"0 pixels have .* not clipped"):
        kept_reflection(photo, background, photo, reflection)


@pytest.mark.parametrize("score", SCORES)
def test_too_few_pixels_for_the_gain_are_refused(scene, score):
    """The reflection covers all but 63 pixels, too few for the gain."""
    background, photo, reflection = scene
    reflection = np.maximum(reflection, 60)
    reflection.reshape(-1, 3)[:63] = 0
    with pytest.raises(ValueError, match="63 pixels have R"):
        score(photo // 2, background, photo, reflection)


def test_sixty_four_pixels_are_enough():
    white = np.full((8, 8, 3), 220, np.uint8)
    none = np.zeros((8, 8, 3), np.uint8)
    assert removed_white(white, white, white, none) == 0
    with pytest.raises(ValueError, match="63 pixels"):
        removed_white(*(image.reshape(1, 64, 3)[:, 1:] for image in (white, white, white, none)))


@given(images, images, images, images, st.integers(0, 16), st.sampled_from(SCORES))
def test_scores_of_any_images_are_0_to_1(
    prediction, background, photo, reflection, unreflected, score
):
    reflection = reflection.copy()
    reflection[:unreflected] = 0
    if score is removed_white:
        background = background // 16 + np.uint8(220)
    with contextlib.suppress(ValueError):  # too few pixels for a score
        assert 0 <= score(prediction, background, photo, reflection) <= 1
