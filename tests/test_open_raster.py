"""Layered files for image editors: the layers add up to the photo, as an independent reader sees
them.
"""

import io
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.errors import PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import FileInfo, read_size
from cli_helpers import image_bytes, list_files
from picture_files import P3, smooth

SEPARATOR = Separator(lambda tile: (0.7 * tile, 0.3 * tile))


def opened(data):
    return zipfile.ZipFile(io.BytesIO(data))


def blend(operator, upper, lower):
    """Composites premultiplied colour and alpha in 0..1 (W3C Compositing and Blending, section
    9.1).
    """
    (colour, alpha), (below, alpha_below) = upper, lower
    if operator == "svg:plus":
        return np.minimum(1, colour + below), np.minimum(1, alpha + alpha_below)
    if operator == "svg:src-atop":
        return colour * alpha_below + below * (1 - alpha), alpha_below
    assert operator == "svg:src-over"
    return colour + below * (1 - alpha), alpha + alpha_below * (1 - alpha)


def composite_stack(archive, stack):
    """The premultiplied colour and the alpha (H, W, 1) of the layers and groups of a stack, from
    bottom to top.
    """
    canvas = 0.0, 0.0
    for item in reversed(stack):
        if item.tag == "stack":
            upper = composite_stack(archive, item)
        else:
            layer = Photo.open(archive.read(item.get("src")))
            white = np.iinfo(layer.pixels.dtype).max
            alpha = np.ones(layer.pixels.shape[:2]) if layer.alpha is None else layer.alpha / white
            upper = layer.pixels / white * alpha[..., None], alpha[..., None]
        canvas = blend(item.get("composite-op"), upper, canvas)
    return canvas


def composite(data):
    """Returns the image that an editor shows, (H, W, 1|3) in stored values. Where alpha is 0, it is
    black.
    """
    archive = opened(data)
    colour, alpha = composite_stack(
        archive, ElementTree.fromstring(archive.read("stack.xml")).find("stack")
    )
    white = np.iinfo(Photo.open(data).pixels.dtype).max
    return np.rint(
        white * np.divide(colour, alpha, where=alpha > 0, out=np.zeros_like(colour))
    ).astype(int)


@pytest.mark.parametrize("icc", [None, P3], ids=["srgb", "p3"])
@pytest.mark.parametrize("additive", [False, True])
def test_the_layers_add_up_to_the_photo_and_the_lower_layer_is_the_transmission(icc, additive):
    photo = Photo(smooth(), None, FileInfo(icc=icc))
    separation = SEPARATOR(photo, additive=additive)
    data = separation.layered.encode()
    assert np.array_equal(composite(data), photo.pixels)
    layers = [
        Photo.open(opened(data).read(f"data/{name}.png")) for name in ("transmission", "reflection")
    ]
    assert [layer.file_info.icc for layer in layers] == [icc, icc]
    # Additive layers may have colours outside the gamut of the photo.
    in_gamut = (layers[0].pixels > 0).all(axis=2)
    difference = np.abs(layers[0].linear() - separation.transmission.linear())
    assert difference[in_gamut].max() < 0.01
    assert layers[1].pixels.mean() > 10
    assert np.array_equal(Photo.open(data).pixels, photo.pixels)
    assert read_size(data) == photo.size


def test_additive_layers_of_a_float_photo_with_a_profile_have_its_colours():
    photo = Photo(np.float32(1 / 255) * smooth(), None, FileInfo("tiff", icc=P3))
    separation = SEPARATOR(photo, additive=True)
    lower = Photo.open(opened(separation.layered.encode()).read("data/transmission.png"))
    in_gamut = ((lower.pixels > 0) & (lower.pixels < 65535)).all(axis=2)
    assert np.abs(lower.linear() - separation.transmission.linear())[in_gamut].max() < 0.01


def test_a_transmission_brighter_than_the_photo_is_the_photo():
    data = Separator(lambda tile: (np.minimum(1.5 * tile, 1), 0 * tile))(
        smooth(), encoding="srgb"
    ).layered.encode()
    assert np.array_equal(composite(data), smooth())
    assert Photo.open(opened(data).read("data/reflection.png")).pixels.max() == 0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("is_binary", [True, False])
def test_the_composite_of_a_transparent_photo_has_its_colours_and_its_alpha(dtype, is_binary):
    white = np.iinfo(dtype).max
    alpha = np.linspace(0, white, 48 * 64).reshape(48, 64, 1)
    alpha = (alpha > white / 2) * white if is_binary else alpha
    pixels = smooth().astype(float) / 255 * white
    data = SEPARATOR(np.dstack([pixels, alpha]).astype(dtype), encoding="srgb").layered.encode()
    photo = Photo.open(data)
    archive = opened(data)
    stack = ElementTree.fromstring(archive.read("stack.xml")).find("stack")
    colour, composite_alpha = composite_stack(archive, stack)
    expected_alpha = photo.alpha[..., None] / white
    np.testing.assert_allclose(composite_alpha, expected_alpha, atol=1e-12)
    np.testing.assert_allclose(colour, photo.pixels / white * expected_alpha, atol=1e-12)
    layers = [
        Photo.open(archive.read(f"data/{name}.png")) for name in ("transmission", "reflection")
    ]
    assert all(np.array_equal(layer.alpha > 0, photo.alpha > 0) for layer in layers)
    assert np.array_equal(layers[0].pixels + layers[1].pixels, photo.pixels)
    assert layers[1].pixels.mean() > 0.04 * white


def test_the_archive_begins_with_its_mime_type_and_has_a_thumbnail():
    data = SEPARATOR(image_bytes(600, 400)).layered.encode()
    assert data[30:54] == b"mimetypeimage/openraster"
    assert opened(data).infolist()[0].compress_type == zipfile.ZIP_STORED
    assert Photo.open(opened(data).read("Thumbnails/thumbnail.png")).size == (256, 171)
    assert data == SEPARATOR(image_bytes(600, 400)).layered.encode()


@pytest.mark.parametrize("channels", [1, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_grey_alpha_and_every_depth_become_layers(channels, dtype):
    array = np.full(
        (8, 8, channels), 0.5 if dtype == np.float32 else np.iinfo(dtype).max // 2
    ).astype(dtype)
    data = SEPARATOR(array, encoding="srgb", additive=True).layered.encode()
    merged = Photo.open(data)
    assert np.array_equal(composite(data), merged.pixels)
    assert merged.pixels.dtype == (np.uint8 if dtype == np.uint8 else np.uint16)
    assert merged.linear() == pytest.approx(
        Photo.from_array(array, encoding="srgb").linear(), abs=1e-4
    )
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


def test_a_damaged_archive_and_one_of_another_kind_are_refused():
    other = io.BytesIO()
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("a.txt", "text")
    with pytest.raises(UnreadablePhoto, match="no known image format"):
        Photo.open(other.getvalue())
    data = SEPARATOR(image_bytes()).layered.encode()
    for damaged in (
        data[:-100],
        data[: len(data) // 2],
        data.replace(b"mergedimage", b"nomergeimage"),
    ):
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


def test_an_encrypted_or_damaged_merged_image_is_refused():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr(zipfile.ZipInfo("mimetype"), b"image/openraster", zipfile.ZIP_STORED)
        archive.writestr("mergedimage.png", image_bytes())
    compressed = bytearray(file.getvalue())
    start = compressed.index(b"mergedimage.png") + len("mergedimage.png")
    compressed[start + 20 : start + 60] = b"\xff" * 40
    encrypted = bytearray(SEPARATOR(image_bytes()).layered.encode())
    for signature, flags in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        find = encrypted.rindex if flags == 8 else encrypted.index
        entry = encrypted.rindex(signature, 0, find(b"mergedimage.png"))
        encrypted[entry + flags] |= 1
    for data in (bytes(compressed), bytes(encrypted)):
        with pytest.raises(UnreadablePhoto, match="the ora cannot be read completely"):
            Photo.open(data)
