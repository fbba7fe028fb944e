"""The camera response: one exposure, white balance and tone curve for all layers, recorded with the
sample.
"""

import tomllib

import numpy as np
import pytest
import tomli_w
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from brewster.photo import Photo
from brewster.photo.srgb import REC709_LUMINANCE, to_encoded, to_linear
from brewster.render.camera_response import develop, encode_jpeg, to_uint8
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.scene import CameraResponse, Scene

some = settings(max_examples=60, deadline=None, database=None)
SHAPE = st.tuples(st.just(3), st.integers(1, 9), st.integers(1, 9))
LIGHT = st.one_of(
    st.just(0.0), st.floats(-25, 25).map(lambda ev: 2.0**ev), st.floats(0, 1, width=32)
)
VARIED = arrays.arrays(np.float32, SHAPE, elements=LIGHT, fill=st.nothing())
PICTURES = VARIED | arrays.arrays(np.float32, SHAPE, elements=LIGHT)
BALANCES = ["grey-world", "white-patch", "grey-edge"]
RESPONSES = st.builds(
    CameraResponse,
    target_luminance=st.floats(0.01, 1),
    white_balance=st.sampled_from(["none", *BALANCES]),
    white_balance_strength=st.floats(0, 1),
    contrast=st.floats(-0.5, 0.9),
)


def sample_of(photo, reflection=None, mirror=None, seed=0, index=0, **response):
    photo = torch.as_tensor(photo, dtype=torch.float32)
    reflection = photo * 0.25 if reflection is None else torch.as_tensor(reflection)
    scene = Scene(seed=seed, index=index, camera_response=CameraResponse(**response))
    behind = photo - reflection
    layers = {
        "photo": photo,
        "transmission": behind,
        "background": behind / 0.9,
        "reflection": reflection,
    }
    return LinearSample(scene, **layers, mirror=photo * 8 if mirror is None else mirror)


def random_image(shape=(3, 40, 56), low=0.02, high=0.5):
    return torch.rand(shape, generator=torch.Generator().manual_seed(3)) * (high - low) + low


def exposed(light, developed, ev=None):
    """Returns light with the recorded exposure and white balance, before clipping."""
    gains = torch.tensor(developed.white_balance_gains).view(3, 1, 1)
    return light * gains * 2 ** (developed.exposure_ev if ev is None else ev)


def mean_luminance(light):
    return float(light.double().clamp(0, 1).mean((1, 2)) @ torch.tensor(REC709_LUMINANCE).double())


@some
@given(PICTURES, st.floats(0.01, 1), st.sampled_from(["none", *BALANCES]))
def test_the_mean_of_any_image_is_the_target_if_it_is_reachable(picture, target, balance):
    sample = sample_of(picture, target_luminance=target, white_balance=balance)
    developed = develop(sample)
    for name, ev in (("photo", developed.exposure_ev), ("mirror", developed.mirror_exposure_ev)):
        light = getattr(sample, name)
        max_mean = mean_luminance(exposed(light, developed, 32))
        assert mean_luminance(exposed(light, developed, ev)) == pytest.approx(
            min(target, max_mean), rel=0.01
        )


def test_a_black_image_stays_black_and_is_not_exposed():
    for balance in ("none", *BALANCES):
        developed = develop(sample_of(torch.zeros(3, 4, 5), white_balance=balance))
        assert (
            developed.exposure_ev
            == developed.mirror_exposure_ev
            == developed.overexposed_fraction
            == 0
        )
        assert developed.white_balance_gains == (1, 1, 1)
        assert not any(layer.any() for layer in developed.images().values())


@some
@given(PICTURES, RESPONSES)
def test_the_recorded_settings_reproduce_the_pictures(picture, response):
    sample = sample_of(picture, **response.model_dump())
    developed = develop(sample)
    recorded = tomllib.loads(tomli_w.dumps(developed.camera_settings()))
    assert recorded["white_balance_gains"] == list(developed.white_balance_gains)
    for name in SAMPLE_IMAGES:
        ev = recorded["mirror_exposure_ev" if name == "mirror" else "exposure_ev"]
        encoded = to_encoded(exposed(getattr(sample, name), developed, ev).clamp(0, 1))
        smooth = encoded**2 * (3 - 2 * encoded)
        expected = encoded + response.contrast * (smooth - encoded)
        torch.testing.assert_close(developed.images()[name], expected, atol=2e-6, rtol=0)
    overexposed = (exposed(sample.photo, developed) >= 1).any(0).float().mean().item()
    assert recorded["overexposed_fraction"] == pytest.approx(overexposed, abs=1e-6)


@some
@given(PICTURES, st.floats(0, 1), st.sampled_from(["none", *BALANCES]))
def test_the_layers_of_a_photograph_add_up_where_nothing_clips(picture, share, balance):
    sample = sample_of(picture, reflection=picture * np.float32(share), white_balance=balance)
    developed = develop(sample)
    photo, transmission, reflection = (
        to_linear(getattr(developed, f"{name}_encoded"))
        for name in ("photo", "transmission", "reflection")
    )
    inside = exposed(sample.photo, developed) < 1
    torch.testing.assert_close(
        (transmission + reflection)[inside], photo[inside], atol=1e-5, rtol=0
    )


CAST = torch.tensor([1.4, 1.0, 0.6]).view(3, 1, 1)


@some
@given(st.floats(0.5, 1.9), st.floats(0.5, 1.9), st.integers(0, 99))
def test_grey_world_makes_the_means_equal_and_keeps_luminance(red, blue, seed):
    picture = torch.rand((3, 12, 12), generator=torch.Generator().manual_seed(seed)) * 0.5 + 0.25
    picture *= torch.tensor([red, 1, blue]).view(3, 1, 1)
    sample = sample_of(picture, white_balance="grey-world", target_luminance=0.1)
    developed = develop(sample)
    assert max(developed.white_balance_gains) < 3
    balanced = to_linear(developed.photo_encoded).mean((1, 2))
    torch.testing.assert_close(balanced, balanced.mean().expand(3), atol=0, rtol=1e-3)
    gains = torch.tensor(developed.white_balance_gains).view(3, 1, 1)
    assert mean_luminance(picture / 4 * gains) == pytest.approx(
        mean_luminance(picture / 4), rel=1e-3
    )


@pytest.mark.parametrize("balance", BALANCES)
def test_every_white_balance_removes_a_colour_cast(balance):
    grey = random_image((1, 40, 56)).expand(3, 40, 56)
    developed = develop(sample_of(grey * CAST, white_balance=balance, target_luminance=0.2))
    gains = torch.tensor(developed.white_balance_gains).view(3, 1, 1)
    torch.testing.assert_close(
        gains * CAST / (gains * CAST)[1], torch.ones(3, 1, 1), atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("balance", BALANCES)
def test_half_the_strength_is_half_the_correction_in_stops(balance):
    response = {"white_balance": balance}
    samples = (
        sample_of(random_image() * CAST, white_balance_strength=s, **response) for s in (1, 0.5, 0)
    )
    full, half, none = (np.log2(develop(sample).white_balance_gains) for sample in samples)
    assert not none.any()
    assert np.abs(full).max() > 0.1
    np.testing.assert_allclose(2 * np.diff(half), np.diff(full), atol=2e-3)


@pytest.mark.parametrize("balance", BALANCES)
def test_clipped_lamps_do_not_affect_the_white_balance(balance):
    picture = random_image()
    lit = picture.clone()
    lit[2, 3:5, 3:5] = 1e5
    lit[:, 10:14, 10:20] = 1e5
    plain, with_lamps = (
        develop(sample_of(each, white_balance=balance, target_luminance=0.3)).white_balance_gains
        for each in (picture, lit)
    )
    assert plain == pytest.approx(with_lamps, abs=0.01)


@some
@given(PICTURES, st.sampled_from(BALANCES), st.floats(0, 1))
@example(np.array([0.001, 0.1, 0.1], np.float32).reshape(3, 1, 1), "grey-world", 1.0)
def test_gains_are_between_a_third_and_three(picture, balance, strength):
    developed = develop(sample_of(picture, white_balance=balance, white_balance_strength=strength))
    assert all(0.3333 <= gain <= 3 for gain in developed.white_balance_gains)


def flat(level, **response):
    return sample_of(torch.full((3, 200, 200), level), target_luminance=level, **response)


@pytest.mark.parametrize("level", [0.2, 0.6])
def test_noise_has_the_requested_deviation_and_is_in_the_photo_only(level):
    developed = develop(flat(level, shot_noise=0.03, read_noise=0.01))
    quiet = develop(flat(level))
    deviation = (to_linear(developed.photo_encoded) - level).std().item()
    assert deviation == pytest.approx((0.03**2 * level + 0.01**2) ** 0.5, rel=0.02)
    for name in SAMPLE_IMAGES[1:]:
        assert torch.equal(developed.images()[name], quiet.images()[name])


def test_noise_depends_on_seed_and_index():
    first, again, other_seed, other_index, swapped = (
        develop(flat(0.3, seed=seed, index=index, read_noise=0.05)).photo_encoded
        for seed, index in [(5, 9), (5, 9), (6, 9), (5, 9 + 2**32), (9, 5)]
    )
    assert torch.equal(first, again)
    for other in (other_seed, other_index, swapped):
        assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02


@some
@given(arrays.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))))
def test_eight_bits_survive_the_conversion_to_a_tensor_and_back(pixels):
    assert np.array_equal(to_uint8(torch.from_numpy(pixels).permute(2, 0, 1) / 255), pixels)


def test_a_jpeg_has_its_quality_full_chroma_and_no_metadata():
    photo = Photo.open(encode_jpeg(random_image(), 83))
    assert (photo.file_info.format_name, photo.file_info.jpeg_quality) == ("jpeg", 83)
    assert photo.file_info.subsampling == "4:4:4"
    assert photo.size == (56, 40)
    assert {
        photo.file_info.icc,
        photo.file_info.exif,
        photo.file_info.xmp,
        photo.file_info.iptc,
    } == {None}
