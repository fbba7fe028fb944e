import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster.metrics import psnr
from brewster.separation.guided_upsampling import GeneratedOverride, GuidedUpsampler, upsample_rows


def downsample(image, factor):
    height, width, channels = image.shape
    return image.reshape(height // factor, factor, width // factor, factor, channels).mean((1, 3))


@pytest.fixture
def sharp_scene_and_soft_reflection(rng):
    scene = np.kron(rng.random((40, 60, 3)), np.ones((4, 4, 1))).astype(np.float32) * 0.5
    y, x = np.mgrid[0:1:160j, 0:1:240j]
    soft = 0.3 * np.exp(-((x - 0.4) ** 2 + (y - 0.5) ** 2) * 12)[..., None].astype(np.float32)
    return scene, np.broadcast_to(soft, scene.shape)


def fit(photo, transmission, reflection):
    return GuidedUpsampler.fit(photo, transmission - photo, reflection)


def as_bytes(layer):
    return np.rint(np.clip(layer, 0, 1) * 255).astype(np.uint8)


def test_a_soft_reflection_is_removed_and_sharp_detail_is_kept(sharp_scene_and_soft_reflection):
    scene, reflection = sharp_scene_and_soft_reflection
    photo = scene + reflection
    upsampler = fit(*(downsample(layer, 8) for layer in (photo, scene, reflection)))
    transmission, reflected = upsampler.apply(photo, 0, 160)
    upsampled = upsample_rows(downsample(scene, 8), 0, 160, (160, 240))
    assert (
        psnr(as_bytes(transmission), as_bytes(scene))
        > psnr(as_bytes(upsampled), as_bytes(scene)) + 15
    )
    assert psnr(as_bytes(reflected), as_bytes(reflection)) > 35


@pytest.mark.parametrize("gain", [0.7, 1.25])
def test_without_a_reflection_the_scene_does_not_appear_in_the_reflection(rng, gain):
    photo = np.kron(rng.random((20, 30, 3)), np.ones((8, 8, 1))).astype(np.float32) * 0.7
    small = downsample(photo, 4)
    transmission, reflected = fit(small, gain * small, np.zeros_like(small)).apply(photo, 0, 160)
    assert not reflected.any()
    assert psnr(as_bytes(transmission), as_bytes(gain * photo)) > 38


def test_without_upsampling_the_prediction_is_unchanged(rng):
    photo, transmission, fraction = (rng.random((33, 47, 3), np.float32) for _ in range(3))
    reflection = fraction * photo
    layers = fit(photo, transmission, reflection).apply(photo, 0, 33)
    np.testing.assert_allclose(layers, (transmission, reflection), atol=1e-5)


def test_an_unchanged_photo_is_kept_bit_equal_even_where_its_light_is_negative(rng):
    photo = rng.random((64, 48, 3), np.float32) * 3 - 0.5
    small = np.clip(downsample(photo, 4), 0, 1)
    transmission, reflection = fit(small, small, np.zeros_like(small)).apply(photo, 0, 64)
    assert (transmission == photo).all()
    assert (reflection == 0).all()


def test_no_reflection_is_brighter_than_the_photo(rng):
    photo = rng.random((20, 20, 3), np.float32)
    photo[:5] = 0
    _, reflection = fit(photo, photo, np.full_like(photo, 0.2)).apply(photo, 0, 20)
    assert (reflection <= photo).all()


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 40), st.integers(1, 40))
def test_rows_computed_one_at_a_time_equal_all_rows_at_once(
    small_height, small_width, height, width
):
    map_ = np.random.default_rng(1).random((small_height, small_width, 2), np.float32)
    whole = upsample_rows(map_, 0, height, (height, width))
    rows = [upsample_rows(map_, top, 1, (height, width)) for top in range(height)]
    assert (np.concatenate(rows) == whole).all()


def test_a_ramp_stays_a_ramp_when_upsampled():
    ramp = np.arange(8, dtype=np.float32).reshape(1, 8, 1)
    upsampled = upsample_rows(ramp, 0, 1, (1, 32))[0, :, 0]
    np.testing.assert_allclose(np.diff(upsampled[2:-2]), 0.25, atol=1e-6)
    assert upsampled.mean() == pytest.approx(ramp.mean())


def test_fine_detail_of_the_reflection_is_replaced_by_the_generated_transmission():
    """The reflection has fine lines and the background is smooth. At low resolution the lines merge
    to grey.
    """
    size = 240
    wall = np.broadcast_to(
        np.linspace(0.2, 0.4, size, dtype=np.float32)[:, None, None], (size, size, 3)
    )
    lines = np.zeros((size, size, 3), np.float32)
    lines[:, ::6] = lines[:, 1::6] = 0.3  # a period of two pixels at low resolution
    photo = wall + lines
    generated = downsample(wall, 3)
    reflected = downsample(lines, 3)
    override = GeneratedOverride.weighted_by_detail(generated, reflected)
    errors = []
    for candidate in (None, override):
        upsampler = GuidedUpsampler.fit(downsample(photo, 3), -reflected, reflected, candidate)
        errors.append(np.abs(upsampler.apply(photo, 0, size)[0] - wall).mean())
    assert errors[1] < errors[0] / 5
    assert override.weight[8:-8, 8:-8].min() > 0.9


def test_without_fine_reflections_the_photo_keeps_its_detail(rng):
    detail = rng.random((40, 60, 3), np.float32)
    soft = np.full_like(detail, 0.2)
    assert GeneratedOverride.weighted_by_detail(detail, soft).weight.max() < 1e-3


def test_the_slope_of_a_pixel_is_the_mean_of_all_windows_that_contain_it(rng):
    """He et al. 2013, eq. 8. A change of one pixel is in 5 x 5 windows, which reach 4 pixels
    far.
    """
    photo = rng.random((21, 21, 3), np.float32)
    change = np.zeros((21, 21, 3), np.float32)
    change[10, 10] = 1
    reached = GuidedUpsampler.fit(photo, change, None).change.slope.any(axis=2)
    expected = np.zeros_like(reached)
    expected[6:15, 6:15] = True
    assert (reached == expected).all()


@given(st.integers(0, 99), st.booleans(), st.floats(0.5, 20))
def test_the_layers_stay_within_the_light_of_the_photo_whatever_is_predicted(
    seed, is_derived, size
):
    rng = np.random.default_rng(seed)
    photo = rng.uniform(-0.2, 1, (24, 32, 3)).astype(np.float32)  # negative: outside of Rec.709
    change, reflection = (
        (size * rng.standard_normal((6, 8, 3))).astype(np.float32) for _ in range(2)
    )
    small = downsample(photo, 4).astype(np.float32)
    upsampler = GuidedUpsampler.fit(small, change, None if is_derived else reflection)
    transmission, reflected = upsampler.apply(photo, 0, 24)
    assert (transmission >= np.minimum(photo, 0)).all()
    assert (reflected >= 0).all()
    assert (reflected <= np.maximum(photo, 0)).all()
    if is_derived:
        rest = np.clip(photo - transmission, 0, np.maximum(photo, 0))
        np.testing.assert_array_equal(reflected, rest)


@pytest.mark.parametrize("is_derived", [False, True])
def test_a_mask_scales_the_change_and_the_reflection_of_each_pixel(rng, is_derived):
    photo = rng.uniform(0.3, 0.7, (24, 32, 3)).astype(np.float32)
    small = downsample(photo, 4).astype(np.float32)
    share = rng.uniform(0.1, 0.4, (6, 8, 3)).astype(np.float32)
    upsampler = fit(small, (1 - share) * small, None if is_derived else share * small)
    mask = rng.random((24, 32, 1), np.float32)
    whole, masked = (upsampler.apply(photo, 0, 24, weights) for weights in (None, mask))
    np.testing.assert_allclose(masked[0], photo + mask * (whole[0] - photo), atol=1e-6)
    np.testing.assert_allclose(masked[1], mask * whole[1], atol=1e-6)


@pytest.mark.parametrize("amplitude", [1e-4, 1e-3, 0.1])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.8, 1.0])
def test_generated_light_is_used_by_the_share_of_the_reflection_in_the_detail(amplitude, share):
    pattern = np.random.default_rng(0).standard_normal((40, 40, 3)).astype(np.float32)
    layers = (
        amplitude * np.sqrt(np.float32(part)) * pattern + np.float32(0.5)
        for part in (1 - share, share)
    )
    weight = GeneratedOverride.weighted_by_detail(*layers).weight
    assert weight.min() >= 0
    assert weight.max() <= share + 1e-3
    if amplitude == 0.1:
        np.testing.assert_allclose(weight, share, atol=1e-3)
