import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster.photo.srgb import to_linear
from brewster.training.data import effects
from brewster.training.data.data_recipe import MixRecipe
from brewster.training.data.mixtures import InterleavedStream, Mixtures, Pairs, rotated_crop
from brewster.training.data.sample_rng import SampleRng
from picture_files import file_of, pil
from training_helpers import same

NO_EFFECTS = MixRecipe(
    crop=(1, 1),
    temperature=(0, 0),
    background_map_probability=0,
    background_level=(0.1, 0.1),
    highlight_boost=(0, 0),
    shadow_probability=0,
    background_blur_probability=0,
    no_glass_probability=0,
    partial_probability=0,
    transmittance=(1, 1),
    veil_probability=0,
    reflection_map_probability=0,
    reflection_ratio=(0.5, 0.5),
    reflection_contrast=(1, 1),
    lamp_probability=0,
    sign_probability=0,
    reflection_sharp_probability=1,
    ghost_probability=0,
    falloff_probability=0,
    edge_probability=0,
    camera_blur_probability=0,
    target_luminance=(1, 1),
    overexposed_probability=0,
    gamma=(1, 1),
    contrast=(0, 0),
    noise=(0, 0),
    jpeg_probability=0,
)
MANY_EFFECTS = MixRecipe(
    background_map_probability=0.5,
    shadow_probability=0.5,
    partial_probability=0.5,
    veil_probability=0.5,
    reflection_map_probability=0.5,
    lamp_probability=0.5,
    sign_probability=0.5,
    reflection_sharp_probability=0.3,
    ghost_probability=0.5,
    falloff_probability=0.5,
    edge_probability=0.5,
    overexposed_probability=0.5,
    jpeg_probability=0.5,
)


@pytest.fixture
def photos(rng):
    coarse = [np.kron(rng.integers(20, 200, (6, 8, 3)), np.ones((16, 16, 1))) for _ in range(4)]
    return [torch.from_numpy(image.astype(np.uint8)) for image in coarse]


@pytest.fixture
def maps(rng):
    return [torch.from_numpy(rng.random((3, 32, 64), np.float32) * 4).half() for _ in range(2)]


def test_the_reflection_has_the_strength_of_the_recipe(photos):
    recipe = NO_EFFECTS.model_copy(update={"reflection_ratio": (0.25, 0.25)})
    batch = Mixtures(photos, [], recipe, seed=1)(0, 8, 64)
    ratio = (
        to_linear(batch.reflection_encoded).mean() / to_linear(batch.transmission_encoded).mean()
    )
    assert ratio.item() == pytest.approx(0.25, rel=0.15)


def test_a_rotated_crop_turns_the_photo_by_at_most_25_degrees():
    ramp = (
        np.broadcast_to(np.linspace(100, 200, 300)[None, :, None], (300, 300, 3))
        .round()
        .astype(np.uint8)
    )
    angles = []
    for seed in range(40):
        crop = rotated_crop(SampleRng(seed, 0, 0), torch.from_numpy(ramp.copy()), (0.5, 0.9), 64)
        assert crop.shape == (3, 64, 64)
        across, down = (crop[:, 4:-4, 4:-4].diff(dim=axis).mean().item() for axis in (2, 1))
        angles.append(math.degrees(math.atan2(abs(down), abs(across))))
    assert max(angles) == pytest.approx(25, abs=5)
    assert max(angles) < 27


def test_a_veil_is_only_on_the_glass_of_a_partial_pane(photos):
    changes = {"partial_probability": 1.0, "veil_probability": 1.0, "veil": (0.3, 0.3)}
    batch = Mixtures(photos, [], NO_EFFECTS.model_copy(update=changes), seed=1)(0, 8, 64)
    photo, transmission, reflection = map(
        to_linear, (batch.photo_encoded, batch.transmission_encoded, batch.reflection_encoded)
    )
    outside = (reflection < 1e-4).all(dim=1, keepdim=True).expand_as(photo) & (photo < 0.95)
    assert 0.02 < outside.float().mean() < 0.98
    torch.testing.assert_close(photo[outside], transmission[outside], atol=0.02, rtol=0)


def layers_of(photos, maps=(), **changes):
    """Returns photo, transmission and reflection of four samples, encoded. Random numbers do not
    depend on changes.
    """
    batch = Mixtures(photos, list(maps), NO_EFFECTS.model_copy(update=changes), seed=1)(0, 4, 64)
    return batch.photo_encoded, batch.transmission_encoded, batch.reflection_encoded


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_light_adds_up_in_linear_light_and_a_veil_is_uniform(photos, share):
    """The veil is relative to the mean of each channel of the photo."""
    photo, *layers = map(to_linear, layers_of(photos, veil_probability=1.0, veil=(share, share)))
    both = sum(layers)
    veil = share * both.mean(dim=(2, 3), keepdim=True).expand_as(photo)
    unclipped = photo < 0.95
    torch.testing.assert_close((photo - both)[unclipped], veil[unclipped], atol=0.02, rtol=0)


@pytest.mark.parametrize(("changes", "changed"), [
    # In one of them alone, it would be the same in all photos
    ({"lamp_probability": 1.0}, (True, True)),
    ({"sign_probability": 1.0}, (True, True)),
    ({"ghost_probability": 1.0}, (False, True)),
    ({"reflection_contrast": (1.6, 1.6)}, (False, True)),
    ({"shadow_probability": 1.0}, (True, None)),
    ({"haze_probability": 1.0}, (True, None)),
    ({"highlight_boost": (5.0, 5.0)}, (True, None)),
    ({"augmentation_probability": 1.0}, (True, True)),
], ids=lambda value: next(iter(value)) if isinstance(value, dict) else "")  # fmt: skip
def test_each_effect_changes_its_own_layers(photos, changes, changed):
    bright = [photo + 55 for photo in photos]
    _, *plain = layers_of(bright)
    _, *after = layers_of(bright, **changes)
    for one, other, expected in zip(plain, after, changed, strict=True):
        if expected:
            assert (other - one).abs().mean() > 0.005
        elif expected is not None:
            assert (
                other - one
            ).abs().max() < 0.04  # the tint of the pane uses other random numbers


@pytest.mark.parametrize("effect", ["falloff_probability", "edge_probability"])
def test_a_reflection_that_fades_or_ends_is_darker_somewhere_and_brighter_nowhere(photos, effect):
    _, behind, mirrored = layers_of(photos)
    _, same, faded = layers_of(photos, **{effect: 1.0})
    assert (same - behind).abs().max() < 0.04  # the tint of the pane uses other random numbers
    assert (faded <= mirrored + 1e-6).all()
    assert faded.mean() < 0.95 * mirrored.mean()


def test_a_reflection_that_is_not_sharp_is_blurred_and_keeps_its_light(photos):
    _, _, mirrored = layers_of(photos)
    _, _, blurred = layers_of(
        photos, reflection_sharp_probability=0.0, reflection_blur_sigma_px=(4.0, 4.0)
    )
    edges = [layer.diff(dim=3).square().mean() for layer in (mirrored, blurred)]
    assert edges[1] < edges[0] / 2
    assert to_linear(blurred).mean().item() == pytest.approx(
        to_linear(mirrored).mean().item(), rel=0.1
    )


def test_a_soft_photo_is_blurred_like_its_layers(photos):
    sharp = layers_of(photos)
    soft = layers_of(photos, camera_blur_probability=1.0, camera_blur_sigma_px=(1.5, 1.5))
    for before, after in zip(sharp, soft, strict=True):
        assert after.diff(dim=3).abs().max() < before.diff(dim=3).abs().max() / 2
    photo, transmission, reflection = map(to_linear, soft)
    unclipped = photo < 0.95
    torch.testing.assert_close(
        (transmission + reflection)[unclipped], photo[unclipped], atol=0.02, rtol=0
    )


def test_a_background_out_of_focus_is_blurred_and_its_reflection_is_not(photos):
    _, behind, mirrored = layers_of(photos)
    _, blurred, same = layers_of(
        photos, background_blur_probability=1.0, background_blur_sigma_px=(8.0, 8.0)
    )
    assert blurred.diff(dim=3).abs().max() < behind.diff(dim=3).abs().max() / 2
    assert same.diff(dim=3).abs().max() > mirrored.diff(dim=3).abs().max() / 2


def test_a_warmer_light_has_more_red_and_less_blue(photos):
    _, plain, _ = layers_of(photos, reflection_ratio=(1e-6, 1e-6))
    _, warm, _ = layers_of(photos, reflection_ratio=(1e-6, 1e-6), temperature=(0.3, 0.3))
    unclipped = (warm < 0.95).all(dim=1) & (plain > 0.05).all(dim=1)
    for channel, gain in enumerate((math.exp(0.3), 1, math.exp(-0.3))):
        ratio = to_linear(warm[:, channel][unclipped]) / to_linear(plain[:, channel][unclipped])
        torch.testing.assert_close(ratio, torch.full_like(ratio, gain), atol=0.01, rtol=0)


def test_exposure_limits_the_photos_mean(photos):
    photo, behind, mirrored = layers_of(photos, target_luminance=(0.05, 0.05))
    plain = layers_of(photos)
    assert to_linear(photo).mean(dim=(1, 2, 3)).tolist() == pytest.approx([0.05] * 4, rel=0.03)
    for dark, layer in zip((behind, mirrored), plain[1:], strict=True):
        ratio = to_linear(dark).sum(dim=(1, 2, 3)) / to_linear(layer).sum(dim=(1, 2, 3))
        torch.testing.assert_close(
            ratio, 0.05 / to_linear(plain[0]).mean(dim=(1, 2, 3)), atol=0.02, rtol=0
        )


def test_the_tone_curve_is_a_power_then_an_s_and_the_same_for_all_layers(photos):
    power = layers_of(photos, gamma=(1.2, 1.2))
    s_shaped = layers_of(photos, contrast=(0.4, 0.4))
    for plain, by_power, by_s in zip(layers_of(photos)[1:], power[1:], s_shaped[1:], strict=True):
        torch.testing.assert_close(by_power, plain**1.2, atol=1e-5, rtol=0)
        s_curve = plain + 0.4 * (3 * plain**2 - 2 * plain**3 - plain)
        torch.testing.assert_close(by_s, s_curve, atol=1e-5, rtol=0)


def test_noise_and_jpeg_are_in_the_photo_alone(photos):
    plain = layers_of(photos)
    for changes, low, high in (
        ({"noise": (0.02, 0.02)}, 0.018, 0.022),
        ({"jpeg_probability": 1.0}, 0.002, 0.05),
    ):
        changed = layers_of(photos, **changes)
        assert low < (changed[0] - plain[0]).std() < high
        assert all(
            torch.equal(one, other) for one, other in zip(plain[1:], changed[1:], strict=True)
        )


def test_maps_are_drawn_as_often_as_the_recipe_states(photos):
    red = torch.zeros(3, 32, 64)
    red[0] = 1
    for layer, name in ((1, "background"), (2, "reflection")):
        changes = {f"{name}_map_probability": 1.0}
        seen = layers_of(photos, [red.half()], **changes)[layer]
        assert seen[:, 0].min() > 0
        assert not seen[:, 1:].any()
        assert layers_of(photos, [red.half()])[layer][:, 1:].any()


def test_the_target_is_the_transmission_or_the_background(photos):
    transmission, background = (
        to_linear(layers_of(photos, transmittance=(0.8, 0.8), target=target)[1]).mean().item()
        for target in ("transmission", "background")
    )
    assert transmission / background == pytest.approx(0.8, rel=0.05)


def test_an_overexposed_background_is_white_in_photo_and_target(photos):
    recipe = NO_EFFECTS.model_copy(
        update={"overexposed_probability": 1.0, "overexposed_share": (0.2, 0.2)}
    )
    batch = Mixtures(photos, [], recipe, seed=1)(0, 8, 64)
    white = batch.transmission_encoded.amax(dim=1) > 0.99
    assert white.float().mean().item() == pytest.approx(0.2, abs=0.07)
    assert (batch.photo_encoded.amax(dim=1)[white] > 0.99).all()


def test_photos_are_drawn_in_proportion_to_their_weights(photos):
    stream = Mixtures(photos, [], NO_EFFECTS, seed=1, weights=[0, 1, 0, 3])
    drawn = [stream._choose_photo(SampleRng(1, 0, slot)) for slot in range(400)]
    assert set(drawn) == {1, 3}
    assert drawn.count(3) == pytest.approx(300, abs=40)


def test_samples_without_glass_have_no_reflection(photos):
    recipe = NO_EFFECTS.model_copy(update={"no_glass_probability": 1.0})
    batch = Mixtures(photos, [], recipe, seed=1)(0, 4, 64)
    assert not batch.reflection_encoded.any()
    rounding = 0.5 / 255 + 1e-6
    torch.testing.assert_close(
        batch.photo_encoded, batch.transmission_encoded, atol=rounding, rtol=0
    )


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.sampled_from([32, 64, 96]))
def test_every_sample_has_values_in_0_to_1_and_depends_on_seed_and_step_only(step, size):
    generator = np.random.default_rng(3)
    photos = [torch.from_numpy(generator.integers(0, 256, (70, 90, 3), np.uint8)) for _ in range(3)]
    maps = [torch.from_numpy(generator.random((3, 16, 32), np.float32) * 50).half()]
    first, again = (Mixtures(photos, maps, MANY_EFFECTS, seed=5)(step, 3, size) for _ in range(2))
    assert same(first, again)
    for values in first.tensors().values():
        assert values.isfinite().all()
        assert 0 <= values.min() <= values.max() <= 1
    other = Mixtures(photos, maps, MANY_EFFECTS, seed=5)(step + 1, 3, size)
    assert not torch.equal(first.photo_encoded, other.photo_encoded)


def test_real_pairs_stay_aligned(photos):
    shadowed = [(photo, photo // 2) for photo in photos]
    batch = Pairs(shadowed, (0.4, 0.9), seed=3)(0, 8, 48)
    torch.testing.assert_close(
        batch.transmission_encoded, batch.photo_encoded / 2, atol=0.03, rtol=0
    )
    assert (batch.reflection_weight < 1).all()


def test_an_interleaved_stream_takes_its_share_of_each_stream(photos):
    mixtures = Mixtures(photos, [], NO_EFFECTS, seed=1)
    pairs = Pairs([(photos[0], photos[0])], (1, 1), seed=1)
    batch = InterleavedStream(pairs, mixtures, 0.25)(0, 8, 32)
    assert (batch.reflection_weight < 1).sum() == 2
    assert batch.photo_encoded.shape == (8, 3, 32, 32)


def test_an_interleaved_stream_does_not_call_a_stream_without_samples(photos):
    def fail_if_called(step, count, size):
        raise AssertionError

    batch = InterleavedStream(fail_if_called, Mixtures(photos, [], NO_EFFECTS, seed=1), 0.25)(
        0, 1, 32
    )
    assert batch.photo_encoded.shape == (1, 3, 32, 32)


@pytest.fixture
def scene(rng):
    """Returns an encoded image of smooth blobs and a hard edge, (3, 64, 64)."""
    coarse = torch.from_numpy(rng.random((1, 3, 5, 5), np.float32))
    smooth = torch.nn.functional.interpolate(coarse, (64, 64), mode="bicubic")[0].clamp(0, 1)
    smooth[:, :, 40:] *= 0.4
    return (smooth * 255).round() / 255


@pytest.mark.parametrize("quality", [30, 60, 90])
def test_the_simulated_jpeg_has_the_loss_of_a_codec(scene, quality):
    levels = (scene * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    file = file_of(levels, "JPEG", quality=quality, subsampling=0)
    decoded = torch.from_numpy(np.array(pil(file))).permute(2, 0, 1) / 255
    simulated = effects.jpeg(scene, quality)
    codec_error = (decoded - scene).abs().mean()
    assert (simulated - scene).abs().mean().item() == pytest.approx(codec_error.item(), rel=0.1)
    assert (simulated - decoded).abs().mean() < 0.5 * codec_error


@given(
    st.integers(0, 10**6), st.sampled_from(["smooth_attenuation_mask", "edge", "window", "shadow"])
)
def test_every_mask_is_between_zero_and_one(slot, name):
    mask = getattr(effects, name)(SampleRng(1, 2, slot), 48)
    assert mask.shape == (1, 48, 48)
    assert 0 <= mask.min() <= mask.max() <= 1


@given(st.integers(0, 10**6))
def test_haze_reduces_the_contrast_and_adds_light_to_black(slot):
    stripes = torch.tensor([0.0, 1.0]).repeat(24).expand(3, 48, 48)
    black, white = effects.haze(SampleRng(1, 3, slot), stripes).unflatten(2, (24, 2)).unbind(3)
    contrast = white - black
    assert black.min() >= 0
    assert black.mean() > 0
    assert contrast.min() > 0
    assert contrast.mean() < 1


def test_a_ghost_keeps_the_mean_of_a_flat_image():
    flat = torch.full((3, 32, 32), 0.3)
    torch.testing.assert_close(effects.ghost(SampleRng(1, 0, 0), flat, 0.7, 5.0), flat)


@pytest.mark.parametrize("sigma_px", [2.0, 7.0])
def test_blur_keeps_light_and_removes_detail(scene, sigma_px):
    for disc in (False, True):
        soft = effects.blur(scene, sigma_px, disc=disc)
        assert soft.shape == scene.shape
        assert soft.mean().item() == pytest.approx(scene.mean().item(), rel=0.03)
        assert soft.diff(dim=2).abs().max() < 0.5 * scene.diff(dim=2).abs().max()


def test_blur_has_the_standard_deviation_asked_for():
    point = torch.zeros(3, 96, 96)
    point[:, 48, 48] = 1
    distance = torch.arange(96) - 48.0
    for sigma_px in (1.0, 4.0, 7.0, 9.0):
        for disc in (False, True):
            row = effects.blur(point, sigma_px, disc=disc)[0].sum(dim=0)
            centre = (row * distance).sum() / row.sum()
            deviation = ((row * (distance - centre).square()).sum() / row.sum()).sqrt().item()
            assert deviation == pytest.approx(sigma_px, rel=0.2)
