"""LPIPS beside its definition, beside what the lpips package answers, and wherever its weights come from."""

import hashlib
import io
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch.nn import functional

from brewster.download import Downloader, RemoteFile
from brewster.errors import DownloadError, MissingExtra, ModelError
from brewster.metrics import Lpips, lpips, perceptual
from brewster.metrics.weights import FILE, NAMES, digest_of, load_backbone, read_backbone, read_heads
from file_server import loopback_only, served, unheard

SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
STEPS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))  # stride and padding; the second and third pool before


@pytest.fixture(autouse=True)
def _network_off(monkeypatch):
    loopback_only(monkeypatch)


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """An empty cache folder, no data, and nothing loaded yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("BREWSTER_DATA", raising=False)
    perceptual._load.cache_clear()
    yield tmp_path / "brewster" / "weights"
    perceptual._load.cache_clear()


@pytest.fixture(scope="module")
def metric():
    """LPIPS with the published heads on convolutions of noise: what holds for it holds for any weights."""
    noise = torch.Generator().manual_seed(7)
    convolutions = tuple(
        (torch.randn(out, into, side, side, generator=noise) / (into * side**2) ** 0.5, torch.zeros(out))
        for out, into, side in SHAPES
    )
    return Lpips(convolutions, tuple(map(torch.from_numpy, read_heads())))


@pytest.fixture
def published(data, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(data))
    return Lpips.load()


def pair(height, width):
    """A picture of ramps and squares, and the same with a veil over a part of it: its region."""
    y, x = np.mgrid[:height, :width]
    squares = (x // 8 + y // 8) % 2 * 160 + 40
    truth = np.stack([x * 255 // (width - 1), y * 255 // (height - 1), squares], 2).astype(np.uint8)
    region = np.zeros((height, width), bool)
    region[height // 4 : height // 2, width // 3 :] = True
    photo = np.where(region[..., None], truth // 2 + 100, truth).astype(np.uint8)
    return photo, truth, region


def by_definition(metric, one, other):
    """The five maps of weighted squared differences, in double precision and without torch's convolutions."""
    shift, scale = (np.array(v)[:, None, None] for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)))
    seen = [torch.from_numpy((p.transpose(2, 0, 1) / 127.5 - 1 - shift) / scale)[None] for p in (one, other)]
    maps = []
    for layer, ((stride, padding), (weight, bias)) in enumerate(zip(STEPS, metric.convolutions, strict=True)):
        for i in (0, 1):
            if layer in (1, 2):
                columns = functional.unfold(seen[i], 3, stride=2).unflatten(1, (-1, 9)).amax(2)
                side = [(n - 3) // 2 + 1 for n in seen[i].shape[2:]]
                seen[i] = columns.unflatten(2, side)
            k = weight.shape[-1]
            columns = functional.unfold(seen[i], k, padding=padding, stride=stride)
            side = [(n + 2 * padding - k) // stride + 1 for n in seen[i].shape[2:]]
            seen[i] = (
                (weight.double().flatten(1) @ columns + bias.double()[:, None]).relu().unflatten(2, side)
            )
        unit = [s / (s.pow(2).sum(1, keepdim=True).sqrt() + 1e-10) for s in seen]
        weighted = (unit[0] - unit[1]).pow(2) * metric.heads[layer].double()[:, None, None]
        maps.append(weighted.sum(1, keepdim=True))
    return maps


# --- the number


@pytest.mark.parametrize(
    ("size", "whole", "inside"),
    [
        ((31, 31), 0.007852918, 0.011608146),
        ((64, 96), 0.055010859, 0.111167808),
        ((97, 130), 0.093210354, 0.254545959),
    ],
)
def test_it_answers_what_the_lpips_package_answers(published, size, whole, inside):
    """Figures of lpips 0.1.4, net "alex", without and with spatial=True."""
    photo, truth, region = pair(*size)
    assert lpips(photo, truth) == pytest.approx(whole, abs=1e-6)
    assert lpips(photo, truth, region=region) == pytest.approx(inside, abs=1e-6)


@pytest.mark.parametrize("size", [(31, 31), (64, 96), (75, 58)])
def test_it_is_what_its_definition_says(metric, size):
    photo, truth, region = pair(*size)
    maps = by_definition(metric, photo, truth)
    one, other = metric.features(photo), metric.features(truth)
    assert metric.distance(one, other) == pytest.approx(sum(m.mean().item() for m in maps), rel=1e-5)
    full = sum(functional.interpolate(m, size, mode="bilinear", align_corners=False) for m in maps)[0, 0]
    expected = full.numpy()[region].mean()
    assert metric.distance(one, other, region=region) == pytest.approx(expected, rel=1e-5)


@settings(max_examples=10)
@given(arrays(np.uint8, (2, 31, 34, 3)))
def test_equal_pictures_are_at_no_distance_and_order_does_not_matter(metric, two):
    one, other = map(metric.features, two)
    assert metric.distance(one, one) == 0
    assert metric.distance(one, metric.features(two[0].copy())) == 0
    assert metric.distance(one, other) == metric.distance(other, one) >= 0


def test_features_are_of_unit_length(metric):
    found = metric.features(pair(64, 96)[0])
    assert [tuple(seen.shape) for seen in found.maps] == [
        (64, 15, 23),
        (192, 7, 11),
        (384, 3, 5),
        (256, 3, 5),
        (256, 3, 5),
    ]
    assert found.size == (64, 96)
    for seen in found.maps:
        lengths = seen.norm(dim=0)
        assert ((lengths - 1).abs() < 1e-5).logical_or(lengths == 0).all()


def test_a_uniform_difference_of_a_single_layer_is_its_head_in_every_region(metric):
    """Where all maps are even, enlarging changes nothing, and any region has the mean of the picture."""
    one = metric.features(np.full((40, 40, 3), 10, np.uint8))
    maps = [torch.zeros_like(seen) for seen in one.maps]
    other = perceptual.Features(
        tuple(seen.clone().index_fill_(0, torch.tensor(5), 0.5) for seen in maps), (40, 40)
    )
    none = perceptual.Features(tuple(maps), (40, 40))
    expected = sum(head[5].item() for head in metric.heads) / 4
    assert metric.distance(none, other) == pytest.approx(expected)
    region = np.zeros((40, 40), bool)
    region[3, 37] = True
    assert metric.distance(none, other, region=region) == pytest.approx(expected)


def test_threads_change_nothing(metric):
    photo, truth, _ = pair(97, 130)
    threads, answers = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            answers.append(metric.distance(metric.features(photo), metric.features(truth)))
    finally:
        torch.set_num_threads(threads)
    assert answers[0] == pytest.approx(answers[1], abs=1e-7)


def test_pictures_may_lie_in_memory_as_they_like(metric):
    photo = pair(64, 96)[0]
    photo.flags.writeable = False
    turned = photo[::-1, ::-1]
    assert metric.distance(metric.features(turned), metric.features(turned.copy())) == 0


def test_the_heads_are_the_published_ones():
    heads = read_heads()
    assert [head.shape for head in heads] == [(64,), (192,), (384,), (256,), (256,)]
    assert all(head.dtype == np.float32 and (head >= 0).all() for head in heads)
    sums = hashlib.sha256(b"".join(head.astype("<f4").tobytes() for head in heads)).hexdigest()
    assert sums == "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4"


# --- what is refused


@pytest.mark.parametrize("size", [(30, 90), (90, 30)])
def test_a_picture_that_alexnet_cannot_take_is_refused(metric, size):
    with pytest.raises(ValueError, match=f"at least 31x31 pixels, not {size[0]}x{size[1]}"):
        metric.features(np.zeros((*size, 3), np.uint8))


def test_unequal_sizes_and_wrong_regions_are_refused(metric):
    one, other = (metric.features(np.zeros((31, width, 3), np.uint8)) for width in (31, 32))
    with pytest.raises(ValueError, match="differ in size"):
        metric.distance(one, other)
    with pytest.raises(ValueError, match="empty"):
        metric.distance(one, one, region=np.zeros((31, 31), bool))
    with pytest.raises(ValueError, match="must be bool"):
        metric.distance(one, one, region=np.ones((31, 32), bool))
    with pytest.raises(ValueError, match="must be uint8"):
        metric.features(np.zeros((31, 31, 3)))


def test_shapes_are_compared_before_any_weights_are_asked_for():
    with pytest.raises(ValueError, match="shape"):
        lpips(np.zeros((31, 31, 3), np.uint8), np.zeros((31, 32, 3), np.uint8))


def test_without_torch_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtra, match=r"brewster\[evaluate\]"):
        Lpips.load()


# --- where the weights come from; small tensors of the right names stand for AlexNet


@pytest.fixture
def server():
    with served() as files:
        yield files


@pytest.fixture
def state():
    noise = torch.Generator().manual_seed(7)
    return {name: torch.randn(3, 2, generator=noise) for name in (*NAMES, "classifier.6.bias")}


def saved(state, path=None):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def promised(server, body):
    server.bodies["/whole.pth"] = body
    return RemoteFile(f"{server.url}/whole.pth", len(body), "sha256", hashlib.sha256(body).hexdigest())


def test_the_file_in_the_shared_data_has_the_pinned_digest(data):
    tensors = read_backbone(data / "weights" / FILE)
    assert [tuple(t.shape[:2]) for t in tensors.values() if t.ndim == 4] == [shape[:2] for shape in SHAPES]


def test_the_cache_comes_first_then_the_data_then_the_server(server, state, cache, monkeypatch, tmp_path):
    promise, digest = promised(server, saved(state)), digest_of(state)
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path / "data"))
    saved(state, tmp_path / "data" / "weights" / FILE)
    load_backbone(promise, digest)
    assert server.asked == []
    assert not cache.exists()
    saved({name: values + 1 for name, values in state.items()}, cache / FILE)
    with pytest.raises(ModelError, match=str(cache)):
        load_backbone(promise, digest)


def test_what_was_downloaded_is_kept_without_the_rest_of_the_network(server, state, cache):
    promise, digest = promised(server, saved(state)), digest_of(state)
    first, second = (load_backbone(promise, digest) for _ in range(2))
    assert [path for path, _ in server.asked] == ["/whole.pth"]
    assert [path.name for path in cache.iterdir()] == [FILE]
    assert list(first) == list(second) == list(torch.load(cache / FILE, weights_only=True)) == list(NAMES)
    assert all(torch.equal(first[name], second[name]) for name in NAMES)


def test_half_a_download_is_taken_up_and_none_is_taken_for_whole(server, state, cache):
    body = saved(state)
    promise, digest = promised(server, body), digest_of(state)
    server.faults = ["cut"]
    with pytest.raises(DownloadError, match="ended after"):
        load_backbone(promise, digest, line=Downloader(retry_delays_s=()))
    assert [path.name for path in cache.iterdir()] == ["whole.pth.part"]
    load_backbone(promise, digest, line=Downloader(retry_delays_s=()))
    assert server.asked[-1] == ("/whole.pth", f"bytes={len(body) // 2}-")


def test_a_server_that_is_not_there_is_explained():
    promise = RemoteFile(f"{unheard()}/whole.pth", 9, "sha256", "0")
    with pytest.raises(DownloadError, match="check the connection"):
        load_backbone(promise, line=Downloader(retry_delays_s=()))


def test_another_file_from_the_server_is_dropped(server, state, cache):
    promise = promised(server, saved(state))
    server.bodies["/whole.pth"] = bytes(promise.size)
    with pytest.raises(DownloadError, match="was dropped"):
        load_backbone(promise, digest_of(state))
    assert list(cache.iterdir()) == []


def test_another_network_in_the_promised_file_is_dropped(server, state, cache):
    promise = promised(server, saved(state))
    with pytest.raises(ModelError, match=r"whole\.pth is not the AlexNet of LPIPS \(its digest"):
        load_backbone(promise, "0" * 64)
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize(
    "damage",
    [
        lambda body: b"",
        lambda body: b"not a picture either",
        lambda body: body[: len(body) // 2],
        lambda body: body[:-30],
        lambda body: body.replace(b"features.0.weight", b"features.9.weight"),
        lambda body: saved([1, 2]),
        lambda body: saved(torch.zeros(3)),
        lambda body: saved(dict.fromkeys(NAMES, "words")),
        lambda body: saved({"model": Path("code")}),
    ],
)
def test_a_damaged_file_is_named_and_never_run(state, cache, damage):
    cache.mkdir(parents=True)
    (cache / FILE).write_bytes(damage(saved(state)))
    with pytest.raises(ModelError, match=rf"{cache / FILE} is not the AlexNet .* delete the file"):
        load_backbone(digest=digest_of(state))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@settings(max_examples=40)
@given(st.data())
def test_no_flipped_byte_goes_unnoticed(tmp_path_factory, data):
    state = {name: torch.arange(6.0).view(3, 2) for name in NAMES}
    body = bytearray(saved(state))
    place = data.draw(st.integers(0, len(body) - 1))
    body[place] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("weights") / FILE
    path.write_bytes(body)
    try:
        read = read_backbone(path, digest_of(state))
    except ModelError:
        return
    assert all(torch.equal(read[name], state[name]) for name in NAMES)  # it was a byte of no meaning


def test_shape_and_name_and_value_all_count_in_the_digest(state):
    turned = {name: values.reshape(2, 3) for name, values in state.items()}
    changed = state | {NAMES[9]: state[NAMES[9]] + 1e-6}
    swapped = state | {NAMES[0]: state[NAMES[2]], NAMES[2]: state[NAMES[0]]}
    assert len({digest_of(s) for s in (state, turned, changed, swapped)}) == 4
