"""Invalid images. Each raises an error with three parts, before a pixel is decoded where
possible.
"""

from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path

import numpy as np
import pytest
import pyvips
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import picture_files
from brewster.errors import PhotoError, PhotoTooLarge, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import Photo
from brewster.photo.blocks import tiff_tags
from picture_files import exr_of, png_chunk, png_with

NOISE = np.random.default_rng(0).integers(0, 256, (40, 64, 3), np.uint8)


def file_of(kind, array=NOISE, **options):
    return picture_files.file_of(array, kind, **options)


def tiff_of(array, **options):
    height, width, bands = array.shape
    kind = {"uint8": "uchar", "uint32": "uint", "float64": "double"}[array.dtype.name]
    image = pyvips.Image.new_from_memory(
        np.ascontiguousarray(array).data, width, height, bands, kind
    )
    return bytes(image.tiffsave_buffer(**options))


def assert_refused(source, error, message, **options):
    with pytest.raises(error, match=message) as raised:
        Photo.open(source, **options)
    assert str(raised.value).count("; ") >= 2  # what happened, what was expected, what to do


OWN_MESSAGE = r"^the \w+ cannot be read completely( \(pixels are (missing|damaged)\))?; expected "
"""The message for a damaged file, which does not have the message of the library that reads it."""


@pytest.mark.parametrize("fraction", [0.03, 0.3, 0.6, 0.9])
@pytest.mark.parametrize(("kind", "options"), [
    ("JPEG", {}), ("JPEG", {"progressive": True}), ("PNG", {}), ("TIFF", {}),
    ("TIFF", {"compression": "tiff_lzw"}), ("WEBP", {}), ("WEBP", {"lossless": True}), ("AVIF", {}),
    ("GIF", {}),
])  # fmt: skip
def test_a_truncated_image_is_refused(kind, options, fraction):
    data = file_of(kind, **options)
    assert_refused(data[: int(len(data) * fraction)], UnreadablePhoto, OWN_MESSAGE)


@pytest.mark.parametrize(
    ("offset", "value", "reason"), [(4, 12, "precision 12"), (1, 0xC5, "SOF type 0xc5")]
)
def test_kinds_of_jpeg_that_are_not_supported_are_not_called_damaged(offset, value, reason):
    data = bytearray(file_of("JPEG"))
    data[data.index(b"\xff\xc0") + offset] = value
    message = f"^the jpeg is of a kind that brewster does not support .*{reason}"
    assert_refused(bytes(data), UnsupportedPhoto, message)


def test_a_tiff_shorter_than_its_header_or_without_its_tiles_is_refused():
    for size in (4, 7):
        assert_refused(b"II*\0\x08\0\0"[:size], UnreadablePhoto, "read completely")
    data = tiff_of(NOISE, tile=True, tile_width=16, tile_height=16)
    assert np.array_equal(Photo.open(data).pixels, NOISE)
    last = tiff_tags.numbers(tiff_tags.read_tags(data), 324)[-1]
    missing_tile = data.replace(struct.pack("<I", last), struct.pack("<I", last + len(data)))
    assert_refused(missing_tile, UnreadablePhoto, "pixels are missing")


@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.99])
@pytest.mark.parametrize("format_name", ["exr", "hdr"])
def test_truncated_floats_are_refused(format_name, fraction):
    data = Photo.from_array(NOISE, encoding="srgb").encode(format_name)
    message = {"exr": OWN_MESSAGE, "hdr": "; "}[format_name]
    assert_refused(data[: int(len(data) * fraction)], PhotoError, message)


def test_a_heic_without_an_image_or_with_one_that_is_longer_than_the_file_is_refused():
    data = bytearray(Photo.from_array(NOISE, encoding="srgb").encode("heic"))
    without_image = bytes(data).replace(b"hvcC", b"hvcX")
    assert_refused(without_image, UnreadablePhoto, "no image in the file can be decoded")
    data[data.index(b"mdat") + 4] = 0xFF  # the length of the first unit
    assert_refused(bytes(data), UnreadablePhoto, OWN_MESSAGE)


def test_an_empty_file_a_text_a_folder_and_files_that_cannot_be_opened_are_refused(
    tmp_path, monkeypatch
):
    for name, data, message in (
        ("a.jpg", b"", "empty"),
        ("b.jpg", b"a text, no image", "the file is text"),
    ):
        (tmp_path / name).write_bytes(data)
        assert_refused(tmp_path / name, UnreadablePhoto, message)
    assert_refused(tmp_path / "none.jpg", UnreadablePhoto, "No such file")
    assert_refused(tmp_path, UnreadablePhoto, "folder")

    def deny(path, mode):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", deny)
    assert_refused(tmp_path / "a.jpg", UnreadablePhoto, "Permission denied")


VIDEO_HEADS = [
    b"\0\0\0\x18ftypisom",
    b"\0\0\0\x18ftypdash",
    b"\0\0\0\x18ftypM4VP",
    b"\0\0\0\x08wide\0\0\0\0mdat",
    b"RIFF\0\0\0\0AVI LIST",
    b"\x1aE\xdf\xa3",
    b"\0\0\x01\xb3",
]


@pytest.mark.parametrize("head", VIDEO_HEADS)
def test_a_video_is_refused_by_its_content(head):
    assert_refused(head + bytes(100), UnsupportedPhoto, "^the file is a video; expected a photo; ")


@pytest.mark.parametrize("content", [b"", b"damaged", file_of("JPEG")[:100]])
@pytest.mark.parametrize("name", ["a.mp4", "a.MOV", "a.wmv"])
def test_a_damaged_video_is_refused_by_its_suffix(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert_refused(tmp_path / name, UnsupportedPhoto, f"{name} is a video; expected a photo; ")
    assert_refused(tmp_path / f"no-{name}", UnreadablePhoto, "No such file")


@pytest.mark.parametrize("kind", ["BMP", "JPEG2000", "PPM", "ICO"])
def test_unknown_formats_are_refused(kind):
    assert_refused(file_of(kind), UnreadablePhoto, "no known image format")


@pytest.mark.parametrize("kind", ["GIF", "WEBP", "PNG", "AVIF", "TIFF"])
def test_animations_and_pages_are_refused_also_as_pil_images_and_the_copy_of_one_frame_is_not(kind):
    data = file_of(kind, save_all=True, append_images=[Image.fromarray(255 - NOISE)])
    assert_refused(data, UnsupportedPhoto, "expected a single image")
    image = Image.open(io.BytesIO(data))
    assert_refused(image, UnsupportedPhoto, "2 frames")
    assert Photo.open(image.copy()).size == (64, 40)


@pytest.mark.parametrize("bands", [5, 6])
def test_five_channels_and_more_are_refused(bands):
    assert_refused(
        tiff_of(np.zeros((4, 4, bands), np.uint8)), UnsupportedPhoto, f"{bands} channels"
    )


@pytest.mark.parametrize("kind", [np.uint32, np.float64])
def test_unsupported_dtypes_are_refused(kind):
    message = "the tiff has (32-bit unsigned integers|64-bit floats); expected .*32-bit floats"
    assert_refused(tiff_of(np.zeros((4, 4, 3), kind)), PhotoError, message)


def test_a_raw_file_is_never_read_as_its_preview():
    pytest.importorskip("rawpy")
    for tags in ({50706: b"\1\4\0\0"}, {254: 1}):  # LibRaw finds only the preview
        assert_refused(file_of("TIFF", tiffinfo=tags), UnreadablePhoto, "the RAW file")


def png_with_cicp(primaries, transfer):
    return png_with((b"cICP", bytes((primaries, transfer, 0, 1))), array=NOISE)


@pytest.mark.parametrize(
    ("primaries", "transfer"), [(9, 16), (9, 13), (1, 16), (1, 8), (1, 4), (12, 8)]
)
def test_other_primaries_and_transfer_functions_are_refused(primaries, transfer):
    message = f"the png has the primaries {primaries} and the transfer function {transfer}"
    assert_refused(png_with_cicp(primaries, transfer), UnsupportedPhoto, message)


@pytest.mark.parametrize("transfer", [1, 2, 6, 13, 14, 15])
def test_transfer_functions_like_that_of_srgb_are_read_as_srgb(transfer):
    photo = Photo.open(png_with_cicp(1, transfer))
    assert photo.file_info.icc is None
    assert np.array_equal(photo.pixels, NOISE)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("format_name", ["exr", "tiff"])
def test_floats_that_are_not_finite_are_refused(format_name, value):
    pixels = np.zeros((4, 4, 3), np.float32)
    whole = Photo.from_array(pixels, encoding="linear")
    broken = pixels.copy()
    broken[2, 1, 0] = value
    bad = Photo(broken, None, whole.file_info)
    if format_name == "tiff" or np.isnan(value):
        assert_refused(
            bad.encode(format_name, depth=32), UnsupportedPhoto, "^1 pixel is infinite or NaN"
        )
    with pytest.raises(UnsupportedPhoto, match="finite"):
        Photo.from_array(broken, encoding="linear")


def test_an_exr_without_colour_channels_is_refused():
    for names, message in (
        (["Z"], "channels Z"),
        (["Y", "RY", "BY"], "channels BY, RY, Y; expected"),
    ):
        channels = {name: np.zeros((4, 4), np.float32) for name in names}
        assert_refused(exr_of(channels), UnsupportedPhoto, message)


def test_a_radiance_image_with_xyz_or_rotated_lines_is_refused():
    for head, message in (
        (b"FORMAT=32-bit_rle_xyze\n\n-Y 1", "XYZ colours .*; expected RGBE colours; "),
        (
            b"FORMAT=32-bit_rle_rgbe\n\n+Y 1",
            "mirrored or rotated .*; expected scan lines from top to bottom",
        ),
    ):
        assert_refused(b"#?RADIANCE\n" + head + b" +X 1\n" + bytes(4), UnsupportedPhoto, message)


@pytest.mark.parametrize(("height", "width"), [(0, 8), (8, 0), (0, 0)])
def test_a_radiance_image_without_pixels_is_refused(height, width):
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    assert_refused(
        head, UnreadablePhoto, f"{width} x {height} pixels; expected at least one pixel; "
    )


@pytest.mark.parametrize(
    ("width", "message"),
    [("70000", "is truncated"), ("999999999", "at most 200 million"), ("9" * 5000, "RGBE")],
)
def test_a_radiance_image_with_a_wrong_size_is_refused(width, message):
    assert_refused(f"#?RADIANCE\n\n-Y 1 +X {width}\n".encode(), PhotoError, message)


@settings(max_examples=60, deadline=None, database=None)
@given(
    st.sampled_from(["JPEG", "PNG", "TIFF", "WEBP", "AVIF", "GIF", "heic", "exr", "hdr"]),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), min_size=1, max_size=5),
    st.integers(0, 200),
)
def test_damaged_files_give_finite_light_or_a_photo_error(kind, damage, lost):
    small = NOISE[:16, :16]
    whole = (
        Photo.from_array(small, encoding="srgb").encode(kind)
        if kind.islower()
        else file_of(kind, small)
    )
    data = bytearray(whole[: len(whole) - max(0, lost - 100)])
    for position, value in damage:
        data[position % len(data)] = value
    with contextlib.suppress(PhotoError):
        light = Photo.open(bytes(data), max_pixels=10_000).linear()
        assert np.isfinite(light).all()


@pytest.mark.parametrize(
    "kind", ["JPEG", "PNG", "TIFF", "WEBP", "AVIF", "GIF", "exr", "hdr", "array", "PIL"]
)
def test_more_pixels_than_the_limit_are_refused(kind):
    options = {"encoding": "srgb"} if kind == "array" else {}
    if kind in ("array", "PIL"):
        source = NOISE if kind == "array" else Image.fromarray(NOISE)
    else:
        source = (
            Photo.from_array(NOISE, encoding="srgb").encode(kind)
            if kind.islower()
            else file_of(kind)
        )
    assert_refused(source, PhotoTooLarge, "64 x 40", max_pixels=64 * 40 - 1, **options)
    assert Photo.open(source, max_pixels=64 * 40, **options).size == (64, 40)


def test_a_decompression_bomb_is_refused_from_its_header():
    header = struct.pack(">2I5B", 60_000, 60_000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", b"\x78\x9c")
    assert_refused(data, PhotoTooLarge, "60000 x 60000")


SHAPES = [(4,), (4, 4, 2), (4, 4, 5), (0, 4, 3), (1, 4, 4, 3)]


OTHER_DTYPES = [((4, 4, 3), kind) for kind in (np.int8, np.int64, np.complex64, bool)]


@pytest.mark.parametrize(
    ("shape", "kind"), [*((shape, np.uint8) for shape in SHAPES), *OTHER_DTYPES]
)
def test_arrays_of_other_shapes_and_dtypes_are_refused(shape, kind):
    with pytest.raises(UnsupportedPhoto):
        Photo.from_array(np.zeros(shape, kind), encoding="srgb")


def test_new_pixels_must_fit_the_photo():
    photo = Photo.from_array(NOISE, encoding="srgb")
    for other in (NOISE[:-1], NOISE.astype(np.uint16)):
        with pytest.raises(PhotoError, match="with_linear"):
            photo.with_pixels(other)
