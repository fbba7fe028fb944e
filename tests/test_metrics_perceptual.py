"""LPIPS compared with the lpips package, and its laws; the search and download of its weights."""

import hashlib
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from brewster.base.download import RemoteFile
from brewster.errors import ModelError
from brewster.metrics import Lpips, lpips
from brewster.metrics.weights import (
    ALEXNET_FILE,
    ALEXNET_TENSORS,
    alexnet_digest,
    load_alexnet,
    read_lpips_channel_weights,
)
from file_server import served

pytestmark = pytest.mark.loopback

SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """An empty folder for cached weights. BREWSTER_DATA is not set, and no weights are in
    memory.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("BREWSTER_DATA", raising=False)
    Lpips.load.cache_clear()
    yield tmp_path / "brewster" / "weights"
    Lpips.load.cache_clear()


@pytest.fixture(scope="module")
def metric():
    """LPIPS with the published channel weights and random convolutions, for properties that hold
    for any weights.
    """
    noise = torch.Generator().manual_seed(7)
    convolutions = tuple(
        (
            torch.randn(out, into, side, side, generator=noise) / (into * side**2) ** 0.5,
            torch.zeros(out),
        )
        for out, into, side in SHAPES
    )
    return Lpips(convolutions, tuple(map(torch.from_numpy, read_lpips_channel_weights())))


@pytest.fixture
def published_metric(data, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(data))
    return Lpips.load()


def make_pair(height, width):
    """Photo, ground truth and region. The ground truth has ramps and squares; the photo also has
    haze in the region.
    """
    y, x = np.mgrid[:height, :width]
    squares = (x // 8 + y // 8) % 2 * 160 + 40
    truth = np.stack([x * 255 // (width - 1), y * 255 // (height - 1), squares], 2).astype(np.uint8)
    region = np.zeros((height, width), bool)
    region[height // 4 : height // 2, width // 3 :] = True
    photo = np.where(region[..., None], truth // 2 + 100, truth).astype(np.uint8)
    return photo, truth, region


@pytest.mark.parametrize(("size", "whole", "inside"), [
    ((31, 31), 0.007852918, 0.011608146), ((64, 96), 0.055010859, 0.111167808),
    ((97, 130), 0.093210354, 0.254545959),
])  # fmt: skip
def test_distances_equal_those_of_the_lpips_package(published_metric, size, whole, inside):
    """The expected values are those of lpips 0.1.4, net "alex", without and with spatial=True."""
    photo, truth, region = make_pair(*size)
    assert lpips(photo, truth) == pytest.approx(whole, abs=1e-6)
    assert lpips(photo, truth, region=region) == pytest.approx(inside, abs=1e-6)


@settings(max_examples=10)
@given(arrays(np.uint8, (2, 31, 34, 3)))
def test_the_distance_of_equal_images_is_zero_and_distances_are_symmetric(metric, two):
    one, other = map(metric.features, two)
    assert metric.difference(one, one).mean() == 0
    assert metric.difference(one, metric.features(two[0].copy())).mean() == 0
    assert metric.difference(one, other).mean() == metric.difference(other, one).mean() >= 0


def test_the_number_of_threads_does_not_change_the_distance(metric):
    photo, truth, _ = make_pair(97, 130)
    threads = torch.get_num_threads()
    distances = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            distances.append(
                metric.difference(metric.features(photo), metric.features(truth)).mean()
            )
    finally:
        torch.set_num_threads(threads)
    assert distances[0] == pytest.approx(distances[1], abs=1e-7)


def test_the_channel_weights_are_the_published_ones():
    channel_weights = read_lpips_channel_weights()
    assert [weights.shape for weights in channel_weights] == [(64,), (192,), (384,), (256,), (256,)]
    assert all(weights.dtype == np.float32 and (weights >= 0).all() for weights in channel_weights)
    data = b"".join(weights.astype("<f4").tobytes() for weights in channel_weights)
    digest = "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4"
    assert hashlib.sha256(data).hexdigest() == digest


@pytest.fixture
def server():
    with served() as files:
        yield files


@pytest.fixture
def state():
    noise = torch.Generator().manual_seed(7)
    return {
        name: torch.randn(3, 2, generator=noise) for name in (*ALEXNET_TENSORS, "classifier.6.bias")
    }


def serialise(state, path=None):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def remote_file(server, body):
    server.bodies["/alexnet.pth"] = body
    return RemoteFile(
        f"{server.url}/alexnet.pth", len(body), "sha256", hashlib.sha256(body).hexdigest()
    )


def test_the_cache_is_searched_then_the_data_folder_then_the_server(
    server, state, cache, monkeypatch, tmp_path
):
    remote = remote_file(server, serialise(state))
    digest = alexnet_digest(state)
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    serialise(state, tmp_path / "data" / "weights" / ALEXNET_FILE)
    load_alexnet(remote, digest)
    assert server.requests == []
    assert not cache.exists()
    serialise({name: values + 1 for name, values in state.items()}, cache / ALEXNET_FILE)
    with pytest.raises(ModelError, match=str(cache)):
        load_alexnet(remote, digest)


def test_a_download_is_stored_without_the_rest_of_the_network(server, state, cache, capsys):
    remote = remote_file(server, serialise(state))
    digest = alexnet_digest(state)
    first, second = (load_alexnet(remote, digest) for _ in range(2))
    (line,) = capsys.readouterr().err.splitlines()  # only the first call downloads
    assert "licence: BSD-3-Clause" in line
    assert [path for path, _ in server.requests] == ["/alexnet.pth"]
    assert [path.name for path in cache.iterdir()] == [ALEXNET_FILE]
    for state in (first, second, torch.load(cache / ALEXNET_FILE, weights_only=True)):
        assert list(state) == list(ALEXNET_TENSORS)
    assert all(torch.equal(first[name], second[name]) for name in ALEXNET_TENSORS)


def test_other_weights_in_the_downloaded_file_are_deleted(server, state, cache):
    remote = remote_file(server, serialise(state))
    with pytest.raises(
        ModelError, match=r"alexnet\.pth does not contain the AlexNet weights of LPIPS"
    ):
        load_alexnet(remote, "0" * 64)
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize("damage", [
    lambda body: b"not a weights file",
    lambda body: body[: len(body) // 2],
    lambda body: body.replace(b"features.0.weight", b"features.9.weight"),
    lambda body: serialise(dict.fromkeys(ALEXNET_TENSORS, "text")),
    lambda body: serialise({"model": Path("code")}),
])  # fmt: skip
def test_a_damaged_file_is_named_and_never_executed(state, cache, damage):
    cache.mkdir(parents=True)
    (cache / ALEXNET_FILE).write_bytes(damage(serialise(state)))
    with pytest.raises(ModelError, match=rf"{cache / ALEXNET_FILE} does not contain the AlexNet"):
        load_alexnet(digest=alexnet_digest(state))
