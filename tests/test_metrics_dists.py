"""DISTS with random convolutions agrees with its definition; its weights are found and checked."""

import hashlib
import itertools

import numpy as np
import pytest
import torch
from torch.nn import functional

from brewster.download import Downloader, RemoteFile
from brewster.errors import DownloadError, ModelError
from brewster.metrics.dists import STAGES, Dists, read_channel_weights
from brewster.metrics.weights import VGG16_FILE, VGG16_TENSORS, load_vgg16
from file_server import loopback_only, unused_address

CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)


@pytest.fixture(autouse=True)
def _network_off(monkeypatch):
    loopback_only(monkeypatch)


@pytest.fixture(scope="module")
def metric():
    """The published weights of the channels and random convolutions, for properties that hold for any weights."""
    noise = torch.Generator().manual_seed(7)
    convolutions = tuple(
        (torch.randn(out, into, 3, 3, generator=noise) / (4.5 * into) ** 0.5, torch.zeros(out))
        for into, out in itertools.pairwise(CHANNELS)
    )
    texture, structure = (tuple(map(torch.from_numpy, part)) for part in read_channel_weights())
    return Dists(convolutions, texture, structure)


@pytest.fixture
def images(rng):
    first = rng.integers(0, 256, (37, 50, 3)).astype(np.uint8)
    change = rng.integers(-60, 60, first.shape)
    return first, np.clip(first + change, 0, 255).astype(np.uint8)


def reference(metric, *images):
    """The definition of Ding et al. 2022 with plain operations, in float64."""
    all_maps = []
    for image in images:
        values = torch.from_numpy(image.astype(float) / 255).permute(2, 0, 1)[None]
        mean, std = (
            torch.tensor(numbers, dtype=float).view(3, 1, 1)
            for numbers in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
        )
        maps, values, at = [values[0]], (values - mean) / std, 0
        for stage, count in enumerate(STAGES):
            if stage:
                hann = torch.tensor([0.25, 0.5, 0.25], dtype=float)
                kernel = torch.outer(hann, hann)[None, None].repeat(values.shape[1], 1, 1, 1)
                means = functional.conv2d(values**2, kernel, stride=2, padding=1, groups=values.shape[1])
                values = torch.sqrt(means + 1e-12)
            for weight, bias in metric.convolutions[at : at + count]:
                values = functional.conv2d(values, weight.double(), bias.double(), padding=1).clamp(min=0)
            at += count
            maps.append(values[0])
        all_maps.append([map_.flatten(1).numpy() for map_ in maps])
    similarity = 0
    for x, y, texture, structure in zip(*all_maps, metric.texture, metric.structure, strict=True):
        mean_x, mean_y = x.mean(axis=1), y.mean(axis=1)
        covariance = (x * y).mean(axis=1) - mean_x * mean_y
        same_texture = (2 * mean_x * mean_y + 1e-6) / (mean_x**2 + mean_y**2 + 1e-6)
        same_structure = (2 * covariance + 1e-6) / (x.var(axis=1) + y.var(axis=1) + 1e-6)
        similarity += (texture.numpy() * same_texture + structure.numpy() * same_structure).sum()
    return 1 - similarity


def test_the_distance_agrees_with_its_definition(metric, images):
    first, second = map(metric.features, images)
    assert metric.distance(first, second) == pytest.approx(reference(metric, *images), abs=1e-4)


def test_equal_images_have_no_distance_and_the_order_does_not_matter(metric, images):
    first, second = map(metric.features, images)
    assert metric.distance(first, first) == pytest.approx(0, abs=1e-5)
    assert metric.distance(first, second) == pytest.approx(metric.distance(second, first), abs=1e-6)
    assert 0 < metric.distance(first, second) < 1


def test_the_weights_of_the_channels_sum_to_one():
    texture, structure = read_channel_weights()
    assert [len(part) for part in texture] == [3, 64, 128, 256, 512, 512]
    assert all((part >= 0).all() for part in (*texture, *structure))
    assert sum(float(part.sum()) for part in (*texture, *structure)) == pytest.approx(1, abs=1e-5)


def test_images_that_are_too_small_or_differ_in_size_are_an_error(metric, images):
    with pytest.raises(ValueError, match="at least 16x16"):
        metric.features(images[0][:15])
    with pytest.raises(ValueError, match="differ in size"):
        metric.distance(metric.features(images[0]), metric.features(images[0][:30]))


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """The folder of weights in BREWSTER_DATA; the cache is empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path))
    (tmp_path / "weights").mkdir()
    return tmp_path / "weights"


def test_the_network_is_read_from_its_file_if_the_digest_is_right(folder):
    state = {name: torch.full((2,), float(i)) for i, name in enumerate(VGG16_TENSORS)}
    torch.save(state | {"classifier.0.bias": torch.zeros(3)}, folder / VGG16_FILE)
    data = (folder / VGG16_FILE).read_bytes()
    remote = RemoteFile("http://localhost/x", len(data), "sha256", hashlib.sha256(data).hexdigest())
    assert [float(tensor[0]) for tensor in load_vgg16(remote)] == list(range(26))
    with pytest.raises(ModelError, match=r"vgg16.* has the sha256 .*expected 397923af8e79"):
        load_vgg16()


def test_without_a_file_and_a_network_the_error_names_the_file(folder):
    remote = RemoteFile(f"{unused_address()}/vgg16.pth", 100, "sha256", "0" * 64)
    with pytest.raises(
        DownloadError, match=r"VGG16's weights for DISTS.*vgg16-397923af.pth in the folder weights"
    ):
        load_vgg16(remote, downloader=Downloader(retry_delays_s=()))
