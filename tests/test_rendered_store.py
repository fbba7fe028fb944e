"""Rendered sets on disk: the files of a sample, folders and shards, the index, and the contact
sheet.
"""

import shutil
import tarfile

import numpy as np
import pytest
import torch
from pyarrow import parquet

from brewster import Photo
from brewster.errors import OutputError
from brewster.photo import read_exr_layers
from brewster.render.dataset import store
from brewster.render.dataset.generation import preview
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw
from brewster.render.scene.scene import read_scene
from fake_renderer import render
from set_folders import builtin_catalog, hashes, render_set


@pytest.fixture(scope="module")
def four_samples(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "four"
    render_set(out)
    return out


@pytest.fixture
def scene():
    return draw(read_scene_recipe("tiny"), builtin_catalog(), seed=7, index=3)


def test_a_sample_is_five_photographs_their_light_and_their_scene(four_samples, scene):
    folder = four_samples / "000003"
    assert {path.name for path in folder.iterdir()} == set(store.SAMPLE_FILES)
    assert all(Photo.open(folder / f"{layer}.jpg").size == (24, 16) for layer in SAMPLE_IMAGES)
    assert read_scene(folder / store.SCENE_FILE) == scene
    light = read_exr_layers((folder / store.LIGHT_FILE).read_bytes())
    sample = render(scene, None)
    for name, layer in sample.images().items():
        np.testing.assert_allclose(light[name], layer.permute(1, 2, 0).numpy(), rtol=1e-3)


def test_only_the_photo_has_the_quality_of_the_scene(scene):
    response = scene.camera_response.model_copy(update={"jpeg_quality": 1})
    coarse = scene.model_copy(update={"camera_response": response})
    fine, rough = (
        store.encode_sample(render(variant, None), "fake") for variant in (scene, coarse)
    )
    assert len(rough["photo.jpg"]) < len(fine["photo.jpg"])
    assert {name for name in fine if fine[name] != rough[name]} == {"photo.jpg", store.SCENE_FILE}


def test_statistics_compare_the_luminance_of_the_layers(scene):
    layers = {
        name: torch.full_like(layer, 0.5) for name, layer in render(scene, None).images().items()
    }
    mirrored = LinearSample(scene, **(layers | {"reflection": layers["reflection"] * 0.1}))
    found = store.statistics(mirrored, store.develop(mirrored))
    assert found["reflection_to_transmission"] == pytest.approx(0.1)
    assert found["overexposed_fraction"] == 0


def test_folders_and_shards_read_alike(four_samples, tmp_path):
    packed = tmp_path / "packed"
    shutil.copytree(four_samples, packed)
    store.pack(packed, 0)
    assert not list(packed.glob("0000*"))
    folders = list(store.read_dataset(four_samples))
    members = list(store.read_dataset(packed))
    assert [entry.index for entry in folders] == [entry.index for entry in members] == [0, 1, 2, 3]
    for one, other in zip(folders, members, strict=True):
        assert all(one.read(name) == other.read(name) for name in store.SAMPLE_FILES)


def test_a_shard_is_a_tar_file_for_webdataset_and_depends_on_its_samples_only(
    four_samples, tmp_path
):
    for name in ("one", "other"):
        shutil.copytree(four_samples, tmp_path / name)
    shutil.move(tmp_path / "other" / "000001", tmp_path / "moved")
    store.pack(tmp_path / "other", 0)
    shutil.move(tmp_path / "moved", tmp_path / "other" / "000001")
    for name in ("one", "other"):
        store.pack(tmp_path / name, 0)
    assert hashes(tmp_path / "one") == hashes(tmp_path / "other")
    with tarfile.open(tmp_path / "one" / "shard-000000.tar") as tar:
        members = tar.getmembers()
        names = [f"{index:06d}.{name}" for index in range(4) for name in store.SAMPLE_FILES]
        assert [member.name for member in members] == names
        owners = {(member.mtime, member.uid, member.gid, member.mode) for member in members}
        assert owners == {(0, 0, 0, 0o644)}
        photo = (four_samples / "000002" / "photo.jpg").read_bytes()
        assert tar.extractfile("000002.photo.jpg").read() == photo


def test_packing_removes_folders_of_samples_in_the_shard(four_samples, tmp_path):
    shutil.copytree(four_samples, tmp_path / "set")
    store.pack(tmp_path / "set", 0)
    shard = (tmp_path / "set" / "shard-000000.tar").read_bytes()
    shutil.copytree(four_samples / "000002", tmp_path / "set" / "000002")
    entries = list(store.read_dataset(tmp_path / "set"))
    assert [entry.index for entry in entries] == [0, 1, 2, 3]
    assert {entry.path.name for entry in entries} == {"shard-000000.tar"}
    store.pack(tmp_path / "set", 0)
    assert not (tmp_path / "set" / "000002").exists()
    assert (tmp_path / "set" / "shard-000000.tar").read_bytes() == shard


def test_a_sample_of_another_process_is_not_replaced(tmp_path):
    store.write_folder(tmp_path / "000000", {"a": b"first"})
    store.write_folder(tmp_path / "000000", {"a": b"second"})
    assert (tmp_path / "000000" / "a").read_bytes() == b"first"
    assert [path.name for path in tmp_path.iterdir()] == ["000000"]


def test_a_sample_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        store.write_folder(tmp_path / "file" / "000000", {"a": b""})
    with pytest.raises(OutputError):
        store.write_folder(tmp_path / "000000", {"a": b"", "x" * 300: b""})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_samples_beyond_a_million_keep_their_order(tmp_path):
    for index in (1_000_000, 999_999, 5):
        store.write_folder(tmp_path / store.key(index), {"a": b""})
    assert [entry.index for entry in store.read_dataset(tmp_path)] == [5, 999_999, 1_000_000]


def test_the_index_has_a_row_with_the_parameters_of_each_sample(four_samples, monkeypatch):
    table = parquet.read_table(four_samples / preview.INDEX_FILE).to_pylist()
    assert [row["index"] for row in table] == [0, 1, 2, 3]
    for row, entry in zip(table, store.read_dataset(four_samples), strict=True):
        scene = store.read_scene_of(entry)
        pane = scene.glass.panes[0]
        assert (row["thickness_mm"], row["refractive_index"]) == (
            pane.thickness_mm,
            pane.refractive_index,
        )
        assert row["panes"] == len(scene.glass.panes)
        assert row["absorption_blue_per_m"] == pane.absorption_per_m[2]
        assert row["front_map_file"] == (scene.front.map and scene.front.map.source.file)
        assert row["behind_plane_distance_mm"] == (
            scene.behind.plane and scene.behind.plane.distance_mm
        )
        assert (row["seed"], row["recipe"], row["renderer"]) == (7, "tiny", "fake_renderer:render")
        assert row["path"] == entry.path.name
        assert row["reflection_to_transmission"] == pytest.approx(1, abs=0.2)


def test_the_contact_sheet_has_a_row_for_each_sample_in_two_columns(four_samples, tmp_path):
    shutil.copytree(four_samples, tmp_path / "set")
    preview.write_preview(tmp_path / "set")
    assert Photo.open(tmp_path / "set" / preview.PREVIEW_FILE).size == (152, 4 * 20)
    for index in range(4, 23):
        shutil.copytree(four_samples / "000000", tmp_path / "set" / store.key(index))
    preview.write_preview(tmp_path / "set")
    sheet = Photo.open(tmp_path / "set" / preview.PREVIEW_FILE)
    assert sheet.size == (2 * 152 + 8, 20 * 20)
    assert (sheet.pixels[-20:, 152:] == 255).all()


def test_an_empty_set_has_an_empty_index_and_no_sheet(tmp_path):
    render_set(tmp_path / "set", count=0)
    preview.write_preview(tmp_path / "set")
    assert parquet.read_table(tmp_path / "set" / preview.INDEX_FILE).num_rows == 0
    assert not (tmp_path / "set" / preview.PREVIEW_FILE).exists()
