import shutil

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import brewster.training.data.rendered as rendered_module
from brewster.errors import RecipeError
from brewster.photo import Photo
from brewster.render.camera_response import encode_jpeg
from brewster.render.dataset.store import read_dataset, read_scene_of
from brewster.training.data.rendered import RenderedDatasets, blend, blended_layers
from set_folders import render_set
from training_helpers import same


@pytest.fixture
def folder(tmp_path):
    render_set(tmp_path / "set", count=3)
    return tmp_path / "set"


def pixels(data):
    return torch.from_numpy(Photo.open(data).pixels.copy())


def test_a_sample_is_its_photo_its_target_and_its_reflection(folder):
    for target in ("background", "transmission"):
        stream = RenderedDatasets([folder], seed=1, target=target)
        for number, entry in enumerate(read_dataset(folder)):
            pictures = [
                pixels(entry.read(f"{name}.jpg")) for name in ("photo", target, "reflection")
            ]
            assert torch.equal(stream.sample(number), torch.cat(pictures, dim=2))


def test_an_8_bit_sample_is_the_blend_of_its_own_background_and_mirror(folder):
    stream = RenderedDatasets([folder], seed=1, blend_space="srgb")
    for number, entry in enumerate(read_dataset(folder)):
        scene = read_scene_of(entry)
        layers = [pixels(entry.read(f"{name}.jpg")) for name in ("background", "mirror")]
        behind, mirror = (layer.permute(2, 0, 1) / 255 for layer in layers)
        photo, *layers = blended_layers(behind, mirror, scene)
        found = stream.sample(number).permute(2, 0, 1) / 255
        torch.testing.assert_close(found[3:], torch.cat(layers))
        seen = pixels(encode_jpeg(photo, scene.camera_response.jpeg_quality)).permute(2, 0, 1) / 255
        torch.testing.assert_close(found[:3], seen)


def test_crops_of_photo_and_ground_truth_are_aligned(folder):
    for sample in folder.glob("0*"):
        for name in ("background", "reflection"):
            shutil.copy(sample / "photo.jpg", sample / f"{name}.jpg")
    batch = RenderedDatasets([folder], seed=1)(0, 8, 32)
    assert torch.equal(batch.photo_encoded, batch.transmission_encoded)
    assert torch.equal(batch.photo_encoded, batch.reflection_encoded)
    assert (batch.reflection_weight == 1).all()
    assert batch.photo_encoded.shape == (8, 3, 32, 32)


def test_a_batch_from_disk_depends_on_seed_and_step_alone(folder):
    one = RenderedDatasets([folder], seed=1)
    other = RenderedDatasets([folder], seed=1)
    batch = one(7, 4, 32)
    other(0, 2, 64)
    assert same(batch, other(7, 4, 32))
    assert not torch.equal(batch.photo_encoded, one(8, 4, 32).photo_encoded)
    assert not torch.equal(
        batch.photo_encoded, RenderedDatasets([folder], seed=2)(7, 4, 32).photo_encoded
    )


def test_only_the_first_samples_are_used_where_a_count_is_given(folder):
    shutil.rmtree(folder / "000002")
    (folder / "000002").mkdir()
    stream = RenderedDatasets([folder], seed=1, count=2)
    assert len(stream) == 2
    stream(0, 20, 32)


def test_the_samples_of_several_datasets_are_joined_in_order(folder, tmp_path):
    render_set(tmp_path / "more", count=2, seed=8)
    both = RenderedDatasets([folder, tmp_path / "more"], seed=1)
    assert len(both) == 5
    assert torch.equal(both.sample(3), RenderedDatasets([tmp_path / "more"], seed=1).sample(0))


def test_a_count_above_the_number_of_samples_is_refused(folder):
    with pytest.raises(
        RecipeError, match=r"set: 3 rendered samples; expected at least 4, .*; .* lower"
    ):
        RenderedDatasets([folder], seed=1, count=4)


def test_samples_that_were_read_are_cached_within_the_memory_limit(folder, monkeypatch):
    large = RenderedDatasets([folder], seed=1)
    monkeypatch.setattr(rendered_module, "CACHE_BYTES", 16 * 24 * 9)
    small = RenderedDatasets([folder], seed=1)
    first = [stream(0, 20, 32) for stream in (large, small)]
    assert same(*first)
    shutil.rmtree(folder)
    assert same(large(0, 20, 32), first[0])
    with pytest.raises(RecipeError):
        small(0, 20, 32)


BYTES = st.integers(0, 255)


def constant_image(value):
    return torch.full((3, 2, 2), value / 255)


@given(BYTES, BYTES, st.floats(0.8, 1), st.floats(0.4, 1))
def test_a_blend_is_the_formula_in_eight_bits(t, r, alpha, beta):
    exact = alpha * t / 255 + beta * r / 255 - t * r / 255**2
    found = blend(constant_image(t), constant_image(r), alpha, beta)
    assert abs(found[0, 0, 0].item() - min(max(exact, 0), 1)) <= 0.5 / 255 + 1e-6
