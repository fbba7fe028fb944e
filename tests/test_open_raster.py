"""Layered files for image editors: the layers add up to the photo, as an independent reader sees them."""

import io
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.errors import PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import FileInfo, read_size
from cli_helpers import image_bytes, list_files
from picture_files import smooth
from test_photo_metadata import P3

SEPARATOR = Separator(lambda tile: (0.7 * tile, 0.3 * tile))


def opened(data):
    return zipfile.ZipFile(io.BytesIO(data))


def composite(data):
    """Returns the image that an editor shows: the layers of stack.xml from bottom to top. svg:plus adds the stored values."""
    archive = opened(data)
    image = ElementTree.fromstring(archive.read("stack.xml"))
    canvas = 0
    for layer in reversed(image.findall("stack/layer")):
        pixels = Photo.open(archive.read(layer.get("src"))).pixels.astype(int)
        assert pixels.shape[:2] == (int(image.get("h")), int(image.get("w")))
        canvas = {"svg:plus": canvas + pixels, "svg:src-over": pixels}[layer.get("composite-op")]
    return canvas


@pytest.mark.parametrize("icc", [None, P3], ids=["srgb", "p3"])
@pytest.mark.parametrize("additive", [False, True])
def test_the_layers_add_up_to_the_photo_and_the_lower_layer_is_the_transmission(icc, additive):
    photo = Photo(smooth(), None, FileInfo(icc=icc))
    separation = SEPARATOR(photo, additive=additive)
    data = separation.layered.encode()
    assert np.array_equal(composite(data), photo.pixels)
    layers = [Photo.open(opened(data).read(f"data/{name}.png")) for name in ("transmission", "reflection")]
    assert [layer.file_info.icc for layer in layers] == [icc, icc]
    # Additive layers may have colours outside the gamut of the photo.
    in_gamut = (layers[0].pixels > 0).all(axis=2)
    difference = np.abs(layers[0].linear() - separation.transmission.linear())
    assert difference[in_gamut].max() < 0.01
    assert layers[1].pixels.mean() > 10
    assert np.array_equal(Photo.open(data).pixels, photo.pixels)
    assert read_size(data) == photo.size


def test_a_transmission_brighter_than_the_photo_is_the_photo():
    data = Separator(lambda tile: (np.minimum(1.5 * tile, 1), 0 * tile))(
        smooth(), encoding="srgb"
    ).layered.encode()
    assert np.array_equal(composite(data), smooth())
    assert Photo.open(opened(data).read("data/reflection.png")).pixels.max() == 0


def test_the_archive_begins_with_its_mime_type_and_has_a_thumbnail():
    data = SEPARATOR(image_bytes(600, 400)).layered.encode()
    assert data[30:54] == b"mimetypeimage/openraster"
    assert opened(data).infolist()[0].compress_type == zipfile.ZIP_STORED
    assert Photo.open(opened(data).read("Thumbnails/thumbnail.png")).size == (256, 171)
    assert data == SEPARATOR(image_bytes(600, 400)).layered.encode()


@pytest.mark.parametrize("channels", [1, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_grey_alpha_and_every_depth_become_layers(channels, dtype):
    array = np.full((8, 8, channels), 0.5 if dtype == np.float32 else np.iinfo(dtype).max // 2).astype(dtype)
    data = SEPARATOR(array, encoding="srgb", additive=True).layered.encode()
    merged = Photo.open(data)
    assert np.array_equal(composite(data), merged.pixels)
    assert merged.pixels.dtype == (np.uint8 if dtype == np.uint8 else np.uint16)
    assert merged.linear() == pytest.approx(Photo.from_array(array, encoding="srgb").linear(), abs=1e-4)
    layer = Photo.open(opened(data).read("data/reflection.png"))
    assert (layer.alpha is None) == (channels == 1)


def test_the_command_writes_a_layered_file(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg", "--layers", "layered")[0] == 0
    assert list_files(tmp_path) == ["a.jpg", "a.layered.ora"]
    assert run(".")[2].count("->") == 1  # the result is not a photo to separate
    assert run("a.jpg", "--layers", "layered", "-o", "b.ora")[0] == 0
    assert (tmp_path / "b.ora").read_bytes() == (tmp_path / "a.layered.ora").read_bytes()
    assert run("a.jpg", "-o", "c.ora")[0] == 2
    assert run("a.jpg", "--layers", "layered", "-o", "c.jpg")[0] == 2


def test_a_damaged_archive_is_refused():
    data = SEPARATOR(image_bytes()).layered.encode()
    for damaged in (data[:-100], data[: len(data) // 2], data.replace(b"mergedimage", b"nomergeimage")):
        with pytest.raises(UnreadablePhoto, match="ora"):
            Photo.open(damaged)
    with pytest.raises(PhotoError):
        Photo.open(data, max_pixels=10)
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("mimetype"), b"image/openraster")
        archive.writestr("mergedimage.png", bytes(1 << 22))
    with pytest.raises(UnreadablePhoto, match="too large"):
        Photo.open(bomb.getvalue(), max_pixels=1000)
    with pytest.raises(UnsupportedPhoto, match="requested as png"):
        SEPARATOR(image_bytes()).layered.encode("png")


def test_other_zip_archives_are_no_photos():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.txt", "text")
    with pytest.raises(UnreadablePhoto, match="no known image format"):
        Photo.open(file.getvalue())
