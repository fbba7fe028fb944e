"""The images of a TIFF: pages, thumbnails, pyramids, missing pixels, and kinds of pixels that are
not supported.
"""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import tifffile

from brewster.errors import UnreadablePhoto, UnsupportedPhoto
from brewster.photo import Photo, read_size
from brewster.photo.blocks.tiff_tags import full_pages, is_raw, rationals, read_tags
from picture_files import dng_file, mosaic, pil, random_image, smooth, tiff_with

FULL = smooth()
SMALL = smooth()[::4, ::4]
CAMERA = [(271, 2, 0, "Sextant", True)]


def tiff_of(*pages, byte_order="<", is_big=False):
    """Returns a TIFF with pages (array, NewSubfileType or None for no tag)."""
    file = io.BytesIO()
    with tifffile.TiffWriter(file, byteorder=byte_order, bigtiff=is_big) as writer:
        for number, (array, kind) in enumerate(pages):
            options = {"subfiletype": kind} if kind is not None else {}
            extra = CAMERA if number == 0 else []
            writer.write(array, photometric="rgb", metadata=None, extratags=extra, **options)
    return file.getvalue()


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize("is_big", [False, True])
@pytest.mark.parametrize("pages", [
    [(FULL, 0), (SMALL, 1)], [(SMALL, 1), (FULL, 0)], [(SMALL, 1), (FULL, None)],
    [(FULL, None), (FULL[::2, ::2], 1), (SMALL, 1)], [(SMALL, 1), (FULL, 0), (FULL[::2, ::2], 1)],
], ids=["main first", "thumbnail first", "no type", "pyramid", "in the middle"])  # fmt: skip
def test_a_tiff_with_thumbnails_is_a_photo_of_one_page(pages, byte_order, is_big):
    data = tiff_of(*pages, byte_order=byte_order, is_big=is_big)
    photo = Photo.open(data)
    assert np.array_equal(photo.pixels, FULL)
    assert read_size(data) == photo.size
    assert read_tags(photo.encode())[271][2] == b"Sextant\0"


@pytest.mark.parametrize("kind", [1, 2])  # the full image, a reduced one
def test_the_old_tag_of_a_thumbnail_is_known(kind):
    """Until TIFF 5.0, SubfileType (255) told what NewSubfileType (254) tells."""
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        for array, value in ((FULL, 1), (SMALL, kind)):
            tags = [(255, 3, 1, value, True)]
            writer.write(array, photometric="rgb", metadata=None, extratags=tags)
    if kind == 2:
        assert np.array_equal(Photo.open(file.getvalue()).pixels, FULL)
    else:
        with pytest.raises(UnsupportedPhoto, match="several pages"):
            Photo.open(file.getvalue())


@pytest.mark.parametrize("pages", [[(FULL, 0), (FULL, 0)], [(FULL, 2), (SMALL, 1), (FULL, 2)]])
def test_several_pages_are_refused_also_next_to_a_thumbnail(pages):
    with pytest.raises(UnsupportedPhoto, match="several pages"):
        Photo.open(tiff_of(*pages))
    with pytest.raises(UnsupportedPhoto, match="several pages"):
        read_size(tiff_of(*pages))


def with_sub_directories(first, kind, *subs):
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(first, photometric="rgb", subfiletype=kind, subifds=len(subs), metadata=None)
        for array, sub_kind in subs:
            writer.write(array, photometric="rgb", subfiletype=sub_kind, metadata=None)
    return file.getvalue()


def test_subdirectories_with_thumbnails_are_ignored_and_one_with_the_full_image_is_read():
    for data in (
        with_sub_directories(FULL, 0, (SMALL, 1)),
        with_sub_directories(SMALL, 1, (FULL[::2, ::2], 1), (FULL, 0)),
    ):
        assert np.array_equal(Photo.open(data).pixels, FULL)


@pytest.mark.parametrize("photometric", [32803, 34892])  # a mosaic; linear
def test_raw_files_are_recognised_by_their_version_or_the_data_of_their_sensor(photometric):
    assert is_raw(dng_file(mosaic()))
    assert is_raw(tiff_of((SMALL, 1)))  # only a preview
    file = io.BytesIO()
    data = mosaic() if photometric == 32803 else np.stack([mosaic()] * 3, -1)
    with tifffile.TiffWriter(file) as writer:
        writer.write(SMALL, photometric="rgb", subfiletype=1, subifds=1, metadata=None)
        writer.write(data, photometric=photometric, subfiletype=0, metadata=None)
    assert is_raw(file.getvalue())
    assert not is_raw(tiff_of((SMALL, 1), (FULL, 0)))
    assert not is_raw(b"MM\0*")


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize(("kind", "code", "values"), [
    (1, "2B", (1, 200)), (3, "2H", (1, 40_000)), (4, "2I", (1, 3_000_000_000)),
    (5, "4I", (1, 2, 3_000_000_000, 1)), (10, "4i", (-1, 2, 5, -4)), (13, "2I", (1, 3_000_000_000)),
    (16, "2Q", (1, 1 << 40)),
])  # fmt: skip
def test_every_type_of_number_is_read_in_both_byte_orders(byte_order, kind, code, values):
    order = {"<": b"II*\0", ">": b"MM\0*"}[byte_order]
    value = struct.pack(byte_order + code, *values)
    field = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(f"{byte_order}I", 26)
    entry = struct.pack(f"{byte_order}HHI", 282, kind, 2) + field
    block = order + struct.pack(f"{byte_order}IH", 8, 1) + entry + bytes(4) + value
    tops, bottoms = (values[::2], values[1::2]) if kind in {5, 10} else (values, (1, 1))
    expected = [top / bottom for top, bottom in zip(tops, bottoms, strict=True)]
    assert rationals(read_tags(block), 282) == expected


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize("is_big", [False, True])
def test_layers_keep_numbers_of_every_type(byte_order, is_big):
    """Also those of 8 bytes, which EXIF does not have. Pillow reads them."""
    kept = {
        60000: (1, b"\1\xc8", b"\1\xc8"),
        60001: (2, "text", "text"),
        60002: (3, (1, 40_000), (1, 40_000)),
        60003: (4, (1, 3_000_000_000), (1, 3_000_000_000)),
        60004: (5, (1, 2, 5, 4), (0.5, 1.25)),
        60005: (8, (-1, 30_000), (-1, 30_000)),
        60006: (9, (-1, 2_000_000_000), (-1, 2_000_000_000)),
        60007: (10, (-1, 2, 5, -4), (-0.5, -1.25)),
        60008: (11, (0.5, 2.0), (0.5, 2.0)),
        60009: (12, (0.1, 2.0), (0.1, 2.0)),
        60010: (16, (1, 3_000_000_000), (1, 3_000_000_000)),
        60011: (17, (-1, 2_000_000_000), (-1, 2_000_000_000)),
    }
    tags = [(tag, kind, 0 if kind == 2 else 2, value) for tag, (kind, value, _) in kept.items()]
    photo = Photo.open(tiff_with(FULL, *tags, byteorder=byte_order, bigtiff=is_big))
    exif = pil(photo.encode("jpeg")).getexif()
    assert {tag: exif[tag] for tag in kept} == {tag: values for tag, (_, _, values) in kept.items()}


def test_a_loop_of_directories_ends():
    data = bytearray(tiff_of((FULL, 0)))
    (first,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, first)
    struct.pack_into("<I", data, first + 2 + 12 * count, first)
    assert len(full_pages(bytes(data))) == 1


@pytest.mark.parametrize("byte_order", "<>")
@pytest.mark.parametrize("is_big", [False, True])
@pytest.mark.parametrize(
    "layout",
    [{"tile": (16, 16)}, {"rowsperstrip": 8}, {"tile": (16, 16), "compression": "deflate"}],
)
def test_missing_pixels_are_found_in_every_kind_of_tiff(byte_order, is_big, layout):
    noise = random_image(96, 96)
    data = tiff_with(noise, byteorder=byte_order, bigtiff=is_big, **layout)
    assert np.array_equal(Photo.open(data).pixels, noise)
    with pytest.raises(UnreadablePhoto, match="read completely"):
        Photo.open(data[: int(0.7 * len(data))])


@pytest.mark.parametrize(("array", "options", "message"), [
    (FULL.astype(np.float64), {}, "64-bit floats"),
    (FULL.astype(np.uint32), {}, "32-bit unsigned integers"),
    (FULL.astype(np.int16), {}, "16-bit signed integers"),
    (FULL.astype(np.complex64), {}, "complex floats"),
    (FULL, {"photometric": "cielab"}, "CIELAB colours"),
    (FULL, {"compression": "lzma"}, "compressed with LZMA"),
])  # fmt: skip
def test_kinds_of_pixels_that_are_not_supported_are_named_and_not_called_damaged(
    array, options, message
):
    with pytest.raises(UnsupportedPhoto, match=message) as raised:
        Photo.open(tiff_with(array, **options))
    assert "copy" not in raised.value.cure
