import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from brewster.errors import PhotoTooLarge, RecipeError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import Photo, read_size
from brewster.photo import decode as decoding
from brewster.render.environments.assets import builtin_catalog, read_catalog
from picture_files import exif_block, file_of, random_image, smooth

KINDS = ["JPEG", "PNG", "TIFF", "WEBP", "AVIF", "GIF"]


def encoded_map(rng, height=16, width=32):
    texels = rng.uniform(0.2, 1.8, (height, width, 3)).astype(np.float32)
    texels[3, 4] = 5  # the sun: a map whose maximum is in many texels is refused as clipped
    return Photo.from_array(texels, encoding="linear").encode("hdr")


@pytest.fixture
def maps(tmp_path, rng):
    folder = tmp_path / "maps"
    folder.mkdir()
    for name in ("b.hdr", "a.hdr", "c.HDR"):
        (folder / name).write_bytes(encoded_map(rng))
    return folder


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "wide.jpg").write_bytes(file_of(smooth(), "JPEG"))
    (folder / "turned.jpg").write_bytes(file_of(smooth(), "JPEG", exif=exif_block(6)))
    (folder / "note.txt").write_text("no picture")
    return folder


def test_without_folders_all_assets_are_built_in():
    catalog, refused = read_catalog([], [])
    assert catalog == builtin_catalog()
    assert not refused
    assert {asset.category for asset in catalog.maps} == {"outdoor", "indoor", "night"}
    assert len(catalog.pictures) >= 6
    assert all(asset.width == 2 * asset.height for asset in catalog.maps)


def test_a_folder_replaces_the_builtin_assets(maps, photos):
    catalog, refused = read_catalog([maps], [])
    assert [asset.source.file for asset in catalog.maps] == ["a.hdr", "b.hdr", "c.HDR"]
    assert catalog.pictures == builtin_catalog().pictures
    catalog, more = read_catalog([], [photos])
    assert catalog.maps == builtin_catalog().maps
    assert [asset.source.file for asset in catalog.pictures] == ["turned.jpg", "wide.jpg"]
    assert not refused + more


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_pipes_in_folders_of_maps_and_photos_are_not_opened(maps, photos):
    expected = read_catalog([maps], [photos])
    for path in (maps / "pipe.hdr", maps / "manifest.csv", photos / "pipe.jpg"):
        path.unlink(missing_ok=True)
        os.mkfifo(path)
    assert read_catalog([maps], [photos]) == expected


def test_an_asset_has_the_upright_size_and_the_sha256_of_its_file(maps, photos):
    catalog, _ = read_catalog([maps], [photos])
    assert {(asset.width, asset.height) for asset in catalog.maps} == {(32, 16)}
    assert [(asset.width, asset.height) for asset in catalog.pictures] == [(48, 64), (64, 48)]
    for folder, assets in ((maps, catalog.maps), (photos, catalog.pictures)):
        for asset in assets:
            data = (folder / asset.source.file).read_bytes()
            assert asset.source.sha256 == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # spreadsheet programs write utf-8-sig
def test_a_manifest_gives_categories(maps, encoding):
    rows = "file,licence,category\na.hdr,CC0,indoor\nc.HDR,CC0,\nelsewhere.hdr,CC0,night\n"
    (maps / "manifest.csv").write_text(rows, encoding=encoding)
    catalog, _ = read_catalog([maps], [])
    assert [asset.category for asset in catalog.maps] == ["indoor", "", ""]


@pytest.mark.parametrize("are_maps", [True, False])
def test_an_empty_folder_is_an_error(tmp_path, are_maps):
    (tmp_path / ".hidden.jpg").write_bytes(file_of(smooth(), "JPEG"))
    (tmp_path / ".hidden.hdr").write_bytes(b"")
    folders = ([tmp_path], []) if are_maps else ([], [tmp_path])
    with pytest.raises(
        RecipeError, match=f"no {'maps' if are_maps else 'photos'} in .*; .*; "
    ) as error:
        read_catalog(*folders)
    assert str(tmp_path) in str(error.value)


def test_unusable_files_are_skipped_and_reported(maps, photos, rng):
    complete = encoded_map(rng)
    (maps / "cut.hdr").write_bytes(complete[:-100])
    (maps / "square.hdr").write_bytes(encoded_map(rng, 16, 16))
    (photos / "empty.jpg").write_bytes(b"")
    (photos / "page.png").write_bytes(b"<html>")
    (photos / "folder.webp").mkdir()
    catalog, refused = read_catalog([maps], [photos])
    assert [asset.source.file for asset in catalog.maps] == ["a.hdr", "b.hdr", "c.HDR"]
    assert [asset.source.file for asset in catalog.pictures] == ["turned.jpg", "wide.jpg"]
    paths = [maps / "cut.hdr", maps / "square.hdr"]
    paths += [photos / name for name in ("empty.jpg", "folder.webp", "page.png")]
    for path, error in zip(paths, refused, strict=True):
        assert str(path) in str(error)
        assert str(error).count("; ") >= 2


def test_a_name_that_is_not_text_is_refused(maps, photos):
    (photos / "wide.jpg").rename(photos / os.fsdecode(b"\xff.jpg"))
    catalog, (error,) = read_catalog([maps], [photos])
    assert [asset.source.file for asset in catalog.pictures] == ["turned.jpg"]
    assert r"\udcff.jpg" in str(error)
    catalog.model_dump_json()


def test_an_unusable_map_is_no_reason_for_a_folder_without_photos(maps, tmp_path):
    (maps / "cut.hdr").write_bytes(b"")
    with pytest.raises(RecipeError, match=r"no photos in .*; choose another folder"):
        read_catalog([maps], [tmp_path / "maps"])


def test_the_order_of_the_file_system_does_not_matter(maps, photos, monkeypatch):
    (maps / "bad.hdr").write_bytes(b"")
    (maps / "worse.hdr").write_bytes(b"")
    entries = Path.iterdir
    found = []
    for backwards in (False, True):

        def listed(folder, backwards=backwards):
            return iter(sorted(entries(folder), reverse=backwards))

        monkeypatch.setattr(Path, "iterdir", listed)
        catalog, refused = read_catalog([maps], [photos])
        found.append((catalog, [str(error) for error in refused]))
    assert found[0] == found[1]


def test_if_two_files_have_the_same_name_the_first_folder_is_used(maps, tmp_path, rng):
    other = tmp_path / "other"
    other.mkdir()
    (other / "a.hdr").write_bytes(encoded_map(rng, 32, 64))
    (other / "d.hdr").write_bytes(encoded_map(rng, 32, 64))
    widths = {
        folders: [asset.width for asset in read_catalog(folders, [])[0].maps]
        for folders in ((maps, other), (other, maps))
    }
    assert widths == {(maps, other): [32, 32, 32, 64], (other, maps): [64, 32, 32, 64]}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", KINDS)
def test_the_size_is_that_of_the_upright_picture(kind, orientation):
    options = {} if kind == "GIF" else {"exif": exif_block(orientation)}
    data = file_of(smooth(), kind, **options)
    assert read_size(data) == Photo.open(data).size
    if kind == "JPEG":
        assert read_size(data) == ((48, 64) if orientation > 4 else (64, 48))


def test_the_size_of_a_jpeg_or_png_needs_the_header_only():
    for kind in ("JPEG", "PNG"):
        data = file_of(random_image(48, 64), kind)
        assert read_size(data[: len(data) * 9 // 10]) == (64, 48)
    for format_name in ("exr", "hdr"):
        assert read_size(Photo.from_array(smooth(), encoding="srgb").encode(format_name)) == (
            64,
            48,
        )


def test_a_missing_or_refused_header_has_no_size(monkeypatch):
    for kind in ("JPEG", "PNG", "TIFF", "WEBP"):
        with pytest.raises(UnreadablePhoto):
            read_size(file_of(smooth(), kind)[:9])
    with pytest.raises(UnsupportedPhoto, match="animation"):
        read_size(
            file_of(smooth(), "GIF", save_all=True, append_images=[Image.fromarray(smooth() // 2)])
        )
    monkeypatch.setattr(decoding, "DEFAULT_MAX_PIXELS", 1000)
    with pytest.raises(PhotoTooLarge, match="64 x 48"):
        read_size(file_of(smooth(), "PNG"))
    with pytest.raises(UnreadablePhoto, match="empty"):
        read_size(b"")
