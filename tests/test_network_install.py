"""`brewster models install`, with tiny networks in the form of XReflection's: conversion, failures,
and use everywhere.

bench/xreflection_twins.py does the same with XReflection's own code, at full size.
"""

import dataclasses
import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from brewster import Photo, Separator, separate_burst
from brewster.base.download import Downloader
from brewster.base.files import exclusive_lock
from brewster.errors import BrewsterError
from brewster.photo.srgb import to_encoded
from brewster.separation import registry
from brewster.separation.models import network_install, zoo
from brewster.separation.models.published_networks import COMMIT, PUBLISHED_NETWORKS
from brewster.separation.onnx_backend import OnnxBackend
from brewster.web.application import create_app
from brewster.web.job_queue import JobQueue
from brewster.web.middleware import AccessPolicy
from brewster.web.model_cache import ModelCache
from brewster.web.separation import separation_router
from cli_helpers import image_bytes, list_files
from file_server import served, unused_address
from other_processes import finished
from tiny_networks import (
    TINY_SOURCE,
    install_arguments,
    prepare_installation,
    tiny_checkpoint,
    tiny_module,
    tiny_python,
)  # fmt: skip
from web_servers import form, request

CONVERTER = network_install._CONVERTER
pytestmark = pytest.mark.timeout(
    300
)  # torch is imported, and networks are exported, in other processes
SIZES = ((64, 96), (301, 215), (75, 33))
"""(height, width); two are no multiples of 32."""


def install_tiny(name, folder, *, half_limit=0.015):
    """Installs a tiny network into this cache folder, as the command does."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(network_install._LIMITS, "half", half_limit)
        patched.setenv("XDG_CACHE_HOME", str(folder))
        patched.setattr(network_install, "CODE_DIGEST", network_install.code_digest(TINY_SOURCE))
        prepare_installation()
        checkpoint = tiny_checkpoint(name, folder / f"{name}.ckpt")
        network_install.install(PUBLISHED_NETWORKS[name], checkpoint=checkpoint)


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """A cache folder in which a tiny rdnet is installed."""
    folder = tmp_path_factory.mktemp("cache")
    install_tiny("rdnet", folder)
    return folder


@pytest.fixture
def installed(cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(network_install, "CODE_DIGEST", network_install.code_digest(TINY_SOURCE))
    return tmp_path / "cache" / "brewster" / "models"


def authors_layers(name, pixels):
    """Returns T and R, encoded, as the authors' loop computes them from 8-bit pixels, with sides of
    multiples of 32.
    """
    network, features = tiny_module(name)
    photo = torch.tensor(pixels / 255, dtype=torch.float32).permute(2, 0, 1)[None]
    with torch.no_grad():
        outputs = (
            network(photo, features(photo)) if features else network(photo)[1][-1].chunk(2, dim=1)
        )
    return [layer[0].permute(1, 2, 0).clamp(0, 1).numpy() for layer in outputs[:2]]


@pytest.mark.parametrize("name", [
    "rdnet",
    pytest.param("dsrnet", marks=pytest.mark.slow),  # VGG is exported with it, twice: 17 s
])  # fmt: skip
def test_the_converted_network_computes_the_layers_of_its_authors(
    installed, cache, rng, name, tmp_path
):
    """The file with full weights, and the installed one within brewster at quality draft, which is
    one pass.
    """
    if not registry.installed().get(name):
        install_tiny(name, cache)
    kind = PUBLISHED_NETWORKS[name].kind
    checkpoint = cache / f"{name}.ckpt"
    converter = [tiny_python(tmp_path / "python"), "-I", CONVERTER]
    process = finished([*converter, TINY_SOURCE, checkpoint, kind, tmp_path])
    assert process.returncode == 0, process.stderr
    full = OnnxBackend(tmp_path / "full.onnx", "cpu", is_large=True)
    for size in SIZES:
        pixels = rng.integers(
            0, 200, (*size, 3), np.uint8
        )  # brewster has a rule of its own for clipped light
        padded = np.pad(pixels, [(0, -side % 32) for side in size] + [(0, 0)], mode="symmetric")
        expected = [layer[: size[0], : size[1]] for layer in authors_layers(name, padded)]
        photo = Photo.from_array(pixels, encoding="srgb")
        _, prediction, _ = Separator.load(name).fit(photo, quality="draft")
        within = (photo.linear() + prediction.change, prediction.reflection)
        for layers, limit in ((full(photo.linear()), 1e-3), (within, 2e-2)):
            encoded = [to_encoded(np.maximum(layer, 0)) for layer in layers]
            assert max(np.abs(a - b).max() for a, b in zip(encoded, expected, strict=True)) < limit
            assert np.abs(encoded[0] - expected[1]).max() > 0.1


def test_installing_prints_source_and_licence_and_asks(
    run_without_model, empty_cache, tmp_path, monkeypatch
):
    arguments = [
        argument for argument in install_arguments("rdnet", tmp_path) if argument != "--yes"
    ]
    for given, source in ((arguments, arguments[-1]), (arguments[:3], "rdnet-26.4849.ckpt")):
        code, out, err = run_without_model(*given)
        assert (code, out) == (130, b"")
        assert str(source) in err
        assert "there is no LICENSE file, and weights are not mentioned" in err
    assert not empty_cache.exists()


def test_the_unfinished_download_of_another_network_is_kept(empty_cache):
    work = network_install.work_folder()
    (work / "environment").mkdir(parents=True)
    for name in ("rdnet.ckpt", "rdnet.sha256", "dsit.ckpt.part"):
        (work / name).write_bytes(b"")
    network_install.clean(["rdnet"])
    assert sorted(path.name for path in work.iterdir()) == ["dsit.ckpt.part", "environment"]
    network_install.clean(["dsit"])
    assert not work.exists()


def test_the_card_and_the_list_tell_what_was_installed(run_without_model, installed):
    out = run_without_model("models", "list")[1].decode()
    assert "brewster models install dsit" in out
    rows = {
        row["name"]: row for row in json.loads(run_without_model("models", "list", "--json")[1])
    }
    assert [rows[name]["is_installed"] for name in ("rdnet", "dsit")] == [True, False]
    assert (rows["rdnet"]["measured"], rows["dsit"]["measured"]) == (
        "measured here",
        "estimated for two cores",
    )
    assert COMMIT in run_without_model("models", "card", "rdnet")[1].decode()
    assert run_without_model("models", "verify", "rdnet")[0] == 0


def test_full_weights_are_kept_where_half_ones_differ_too_much(installed, tmp_path, monkeypatch):
    half = zoo.model_file("rdnet").path.stat().st_size
    install_tiny("rdnet", tmp_path, half_limit=0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model = zoo.model_file("rdnet")
    model.verify()
    assert {path.name for path in model.path.parent.glob("*.onnx")} == {model.path.name}
    assert model.path.stat().st_size > 1.5 * half


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_measured_memory_is_not_that_of_the_installer(installed):
    np.ones(3 << 29, np.uint8)
    _, peak_gib = network_install._run(
        Path(sys.executable), "-c", network_install._TRIAL, "rdnet"
    ).split()
    assert 0.1 < float(peak_gib) < 1.5


@pytest.mark.loopback
@pytest.mark.parametrize(("failure", "message"), [
    ("cut", "is no complete checkpoint"), ("other network", "is a checkpoint of another network"),
    ("other weights", "does not match RDNet"), ("other commit", f"at commit {COMMIT}"),
    ("no such file", "is no complete checkpoint"), ("full disk", "of free space"),
    ("small memory", "of memory"), ("no packages", "failed: "), ("no network", ("check the "
                                                                               "connection")),
])  # fmt: skip
def test_a_failure_installs_nothing(
    run_without_model, empty_cache, tmp_path, monkeypatch, failure, message
):
    arguments = install_arguments("rdnet", tmp_path)
    checkpoint = tmp_path / "rdnet.ckpt"
    python = prepare_installation()
    if failure == "cut":
        checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
        shutil.rmtree(network_install.work_folder())  # it is checked before anything is downloaded
    elif failure == "other network":
        tiny_checkpoint("dsrnet", checkpoint)
    elif failure == "other weights":
        saved = torch.load(checkpoint)
        del saved["state_dict"]["net_g.decoder.bias"]
        torch.save(saved, checkpoint)
    elif failure == "other commit":
        monkeypatch.setattr(network_install, "CODE_DIGEST", "0" * 64)
    elif failure == "no such file":
        checkpoint.unlink()
    elif failure == "full disk":
        shutil.rmtree(network_install.work_folder())
        monkeypatch.setattr(network_install, "DISK_GIB", 1e9)
    elif failure == "small memory":
        monkeypatch.setattr(os, "sysconf", lambda _: 1 << 15)
    elif failure == "no packages":
        python.write_text("#!/bin/sh\necho No module named torch >&2\nexit 1\n")
    else:
        shutil.rmtree(network_install.work_folder())
        arguments = arguments[:4]
        monkeypatch.setattr(network_install, "Downloader", quick_downloader)
        monkeypatch.setattr(network_install, "ARCHIVE_URL", unused_address())
    code, _, err = run_without_model(*arguments)
    assert code == 1
    assert message in err
    assert not (empty_cache / "rdnet").exists()
    with pytest.raises(BrewsterError, match="brewster models install rdnet"):
        Separator.load("rdnet")


def test_a_second_installation_and_a_changed_download_are_refused(
    run_without_model, empty_cache, tmp_path
):
    arguments = install_arguments("rdnet", tmp_path)
    work = empty_cache / "installing"
    prepare_installation()
    with exclusive_lock(work):
        code, _, err = run_without_model(*arguments)
    assert (code, "another run is writing" in err) == (1, True)
    shutil.move(tmp_path / "rdnet.ckpt", work / "rdnet.ckpt")
    (work / "rdnet.sha256").write_text("0" * 64)
    code, _, err = run_without_model(*arguments[:4])
    assert (code, "another SHA-256 than when it was downloaded" in err) == (1, True)


def quick_downloader(**options):
    return Downloader(retry_delays_s=(0.0,), sleep=lambda _: None, **options)


@pytest.mark.loopback
def test_an_interrupted_download_is_resumed_by_the_command(
    run_without_model, empty_cache, tmp_path, monkeypatch
):
    arguments = install_arguments("rdnet", tmp_path)
    prepare_installation()
    body = (tmp_path / "rdnet.ckpt").read_bytes()
    monkeypatch.setattr(network_install, "Downloader", quick_downloader)
    with served() as files:
        files.bodies["/rdnet.ckpt"] = body
        files.faults["/rdnet.ckpt"] = [
            None,
            "cut",
            404,
        ]  # the size, half of the file, and then nothing
        network = dataclasses.replace(PUBLISHED_NETWORKS["rdnet"], url=f"{files.url}/rdnet.ckpt")
        monkeypatch.setitem(PUBLISHED_NETWORKS, "rdnet", network)
        without_checkpoint = arguments[:4]
        code, _, err = run_without_model(*without_checkpoint)
        assert (code, (empty_cache / "rdnet").exists()) == (1, False)
        assert "refused the request" in err
        code, _, err = run_without_model(*without_checkpoint)
        assert code == 0, err
        assert files.requests[-1][1] == f"bytes={len(body) // 2}-"
    assert "is installed" in err
    assert list_files(empty_cache) == ["rdnet/install.json", "rdnet/model.md", "rdnet/model.onnx"]
    assert run_without_model("models", "remove", "rdnet")[0] == 0
    assert list_files(empty_cache) == []


def test_a_folder_is_separated_one_photo_at_a_time_and_announced(
    run_without_model, installed, tmp_path
):
    for index in range(3):
        (tmp_path / f"{index}.jpg").write_bytes(image_bytes(700, 500, seed=index))
    options = ("--model", "rdnet", "-o", tmp_path / "out")
    photos = [tmp_path / f"{index}.jpg" for index in range(3)]
    code, out, err = run_without_model(*photos[:2], *options, "--workers", "2", "--json")
    assert code == 0, err
    assert "one photo at a time" in err
    assert "2 photos, about " in err
    results = [json.loads(line) for line in out.splitlines()]
    assert {result["model"] for result in results} == {"rdnet"}
    assert not any(result["assessment"]["verdict"] == "removed" for result in results)
    assert (
        "1 photo, about "
        in run_without_model(photos[0], photos[2], *options, "--quality", "draft")[2]
    )


def test_large_networks_have_their_own_inputs(installed):
    separator = Separator.load("rdnet")
    assert separator._predictor.input_sizes((600, 400), "standard") == [(600, 400)]
    assert separator._predictor.input_sizes((4000, 3000), "draft") == [(577, 433)]
    pixels = np.full((40, 50, 3), 90, np.uint8)
    draft, standard = (separator(pixels, quality=quality) for quality in ("draft", "standard"))
    assert float(draft.confidence_map.max()) == 0.0  # one pass does not estimate it
    assert float(standard.confidence_map.max()) > 0.0


def test_many_photos_share_one_session_one_at_a_time(installed, monkeypatch):
    running = []
    most = []
    separator = Separator.load("rdnet")
    session = separator._predictor._backend._session

    class Recording:
        def run(self, *arguments):
            running.append(1)
            most.append(len(running))
            outputs = session.run(*arguments)
            running.pop()
            return outputs

    monkeypatch.setattr(separator._predictor._backend, "_session", Recording())
    photos = [np.full((64, 64, 3), value, np.uint8) for value in range(6)]
    assert len(list(separator.many(photos, threads=3))) == 6
    assert (max(most), len(most)) == (1, 12)


def test_the_server_offers_installed_networks_with_their_time(installed):
    router = separation_router(ModelCache(device="cpu"), JobQueue(), max_pixels=1_000_000)
    app = create_app(
        router, policy=AccessPolicy.for_host("127.0.0.1", token=None, max_bytes=1_000_000)
    )
    rows = {row["name"]: row for row in request(app, "GET", "/models").json()}
    assert {"compact", "rdnet"} <= set(rows)
    assert rows["compact"]["seconds"] is None
    assert rows["rdnet"]["seconds"] > 0
    response = request(app, "POST", "/separate", **form(image_bytes(), model="rdnet"))
    assert (response.status_code, response.headers["Brewster-Model"]) == (200, "rdnet")


def test_evaluation_scores_a_network_beside_ours(run_without_model, installed, tmp_path):
    for folder, seed in (("blended", 1), ("transmission_layer", 2)):
        (tmp_path / "pairs" / folder).mkdir(parents=True)
        pixels = Photo.open(image_bytes(100, 70, "png", seed)).pixels // 4 * 3  # no clipped light
        Photo.from_array(pixels, encoding="srgb").save(tmp_path / "pairs" / folder / "a.png")
    models = (
        "--model",
        "rdnet",
        "--model",
        "compact",
        "--quality",
        "draft",
        "--protocol",
        "xreflection",
    )
    pairs = f"pairs={tmp_path / 'pairs'}"
    code, _, err = run_without_model(
        "evaluate", "--benchmark", pairs, *models, "-o", tmp_path / "out", "--json"
    )
    assert code == 0, err
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(results["methods"]) == ["input (unprocessed)", "rdnet", "compact"]
    # exactly what the authors' loop computes from the resized picture
    resized = Photo.open(next((tmp_path / "out" / "inputs").rglob("a.png"))).pixels
    written = Photo.open(
        next((tmp_path / "out/predictions/rdnet").rglob("a.transmission.png"))
    ).pixels
    expected, _ = authors_layers("rdnet", resized)
    assert np.abs(written / 255 - expected).max() < 6e-3  # half weights, and 8 bits


def test_a_burst_takes_the_network_as_its_prior(installed, rng):
    scene = rng.integers(0, 200, (160, 224, 3)).astype(np.uint8)
    photos = [np.roll(scene, shift, axis=1) for shift in (0, 3, 6)]
    separation = separate_burst(photos, separator=Separator.load("rdnet"), method="single")
    assert separation.model.endswith("rdnet")
    assert separation.assessment.verdict != "removed"
