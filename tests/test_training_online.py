from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from brewster.environments.assets import Assets
from brewster.environments.catalog import builtin_catalog
from brewster.photo import Photo
from brewster.render.camera_response import encode_jpeg
from brewster.scene.recipe import read_scene_recipe
from brewster.scene.sampler import draw
from brewster.training.data.rendered import OnlineRendered
from training_helpers import same


@pytest.fixture(scope="module")
def assets():
    return Assets()


def tiny_catalog():
    return builtin_catalog().model_copy(update={"maps": builtin_catalog().maps[:2]})


def stream(assets, **options):
    return OnlineRendered(read_scene_recipe("tiny"), tiny_catalog(), assets, seed=7, **options)


def test_a_batch_is_a_function_of_seed_and_step_alone(assets):
    one = stream(assets)
    second = one(1, 2, 32)
    assert same(second, stream(assets)(1, 2, 32))
    assert not torch.equal(second.photo_encoded, one(0, 2, 32).photo_encoded)


@pytest.mark.parametrize("blend_space", ["linear", "srgb"])
def test_the_photo_has_jpeg_artefacts_and_the_ground_truth_has_none(assets, blend_space):
    """A second JPEG of the same quality changes the image hardly at all."""
    photo, background, _ = stream(assets, blend_space=blend_space).layers(0, 96).split(3)
    scene = draw(read_scene_recipe("tiny"), tiny_catalog(), 7, 0)

    def change(encoded):
        decoded = Photo.open(encode_jpeg(encoded, scene.camera_response.jpeg_quality)).pixels.copy()
        return (torch.from_numpy(decoded).permute(2, 0, 1) / 255 - encoded).abs().mean()

    assert change(photo) < change(background) / 10


def test_the_target_is_the_background_or_the_transmission(assets):
    background = stream(assets)(0, 1, 32).transmission_encoded
    transmission = stream(assets, target="transmission")(0, 1, 32).transmission_encoded
    assert transmission.mean() < background.mean()


def test_both_kinds_of_mixing_have_the_same_background(assets):
    light = stream(assets).layers(3, 64)
    mixed = stream(assets, blend_space="srgb", target="transmission").layers(3, 64)
    assert (light[3:6] - mixed[3:6]).abs().max() <= 0.5 / 255 + 1e-6
    assert not torch.equal(light[:3], mixed[:3])


def test_threads_that_share_a_stream_get_the_same_batches(assets):
    alone = [stream(assets)(step, 1, 32) for step in range(4)]
    shared = stream(Assets())
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda step: shared(step, 1, 32), range(4)))
    assert all(map(same, alone, together))
