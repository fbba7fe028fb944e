import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from brewster.training.data import effects
from brewster.training.data.sample_rng import SampleRng
from picture_files import file_of, pil


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


@given(st.integers(0, 10**6), st.sampled_from(["smooth_attenuation_mask", "edge", "window", "shadow"]))
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
