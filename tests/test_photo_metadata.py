"""Metadata of files: EXIF, profile, orientation, resolution, quality, compression."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ImageOps

from brewster.photo import FileInfo, Photo, metadata
from brewster.photo.blocks import tiff_tags
from picture_files import P3, exif_block, file_of, pil, png_with, random_image, smooth

quick = settings(max_examples=25, deadline=None, database=None)

XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf tiff:Orientation="6" note="kept"/></x:xmpmeta>'
UPRIGHT_XMP = XMP.replace(b'"6"', b'"1"')


@pytest.mark.parametrize("quality", [1, 30, 75, 92, 100])
@pytest.mark.parametrize(("subsampling", "name"), [(0, "4:4:4"), (1, "4:2:2"), (2, "4:2:0")])
def test_jpeg_quality_and_chroma_are_no_worse_than_the_source(quality, subsampling, name):
    source = file_of(smooth(), "JPEG", quality=quality, subsampling=subsampling)
    photo = Photo.open(source)
    written = photo.encode()
    assert (photo.file_info.jpeg_quality, photo.file_info.subsampling) == (quality, name)
    assert metadata.jpeg_subsampling(written) == ("4:2:0" if name == "4:2:0" else "4:4:4")
    source_tables = pil(source).quantization
    tables = pil(written).quantization
    assert all(sum(tables[number]) <= sum(source_tables[number]) for number in source_tables)


def test_unusual_quantization_tables_get_a_quality_that_is_at_least_as_fine():
    flat = [[10] * 64, [12] * 64]
    written = Photo.open(file_of(smooth(), "JPEG", qtables=flat)).encode()
    tables = pil(written).quantization
    assert tables.keys() == {0, 1}
    assert all(sum(tables[number]) <= sum(flat[number]) for number in tables)


def test_a_grey_jpeg_keeps_its_quality():
    photo = Photo.open(file_of(smooth()[..., 0], "JPEG", quality=81))
    assert photo.file_info.jpeg_quality == 81
    assert pil(photo.encode()).mode == "L"


@pytest.mark.parametrize("format_name", ["webp", "avif"])
def test_lossless_webp_and_avif_stay_lossless(format_name):
    pixels = random_image()
    photo = Photo.open(Photo(pixels, None, FileInfo(format_name, lossless=True)).encode())
    assert photo.file_info.lossless
    assert np.array_equal(photo.pixels, pixels)
    assert np.array_equal(Photo.open(photo.encode()).pixels, pixels)


def test_lossy_webp_and_avif_stay_lossy_and_close():
    for format_name in ("webp", "avif"):
        photo = Photo.open(file_of(smooth(), format_name))
        assert not photo.file_info.lossless
        assert np.abs(Photo.open(photo.encode()).pixels.astype(int) - photo.pixels).mean() < 2


def test_white_is_white_in_a_heic_of_10_bits():
    pytest.importorskip("pillow_heif")
    white = np.full((32, 32, 3), 65535, np.uint16)
    photo = Photo.open(Photo(white, None, FileInfo("heic", bits=10, lossless=True)).encode())
    assert np.array_equal(photo.pixels, white)
    assert photo.file_info.bits == 10


@pytest.mark.parametrize("bits", [10, 12])
def test_avif_keeps_10_and_12_bits_and_white(bits):
    levels = np.linspace(0, 2**bits - 1, 2**bits).round().astype(np.uint16)
    shifted = np.repeat((levels << (16 - bits)).reshape(32, -1, 1), 3, axis=2)
    photo = Photo.open(
        Photo(shifted, None, FileInfo(format_name="avif", bits=bits, lossless=True)).encode()
    )
    assert photo.file_info.bits == bits
    assert photo.pixels.max() == 65535
    assert np.array_equal(photo.pixels >> (16 - bits), shifted >> (16 - bits))
    assert np.array_equal(Photo.open(photo.encode()).pixels, photo.pixels)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp"])
def test_orientation_is_applied_once_as_pillow_does(format_name, orientation):
    data = file_of(
        smooth(24, 40), format_name, exif=exif_block(orientation), quality=95, lossless=True
    )
    expected = ImageOps.exif_transpose(pil(data))
    photo = Photo.open(data)
    assert photo.size == expected.size
    difference = np.abs(photo.pixels.astype(int) - np.asarray(expected)).max()
    assert difference <= (12 if format_name == "jpeg" else 0)
    written = pil(photo.encode())
    assert written.size == expected.size
    assert written.getexif()[274] == 1


@pytest.mark.parametrize("format_name", ["jpeg", "png", "webp", "avif"])
def test_exif_profile_and_xmp_are_kept_byte_for_byte(format_name):
    exif = exif_block()
    upright = exif_block(1)
    data = file_of(smooth(), format_name, exif=exif, icc_profile=P3)
    photo = Photo.open(data)
    photo = Photo(photo.pixels, None, FileInfo(**{**vars(photo.file_info), "xmp": UPRIGHT_XMP}))
    written = pil(photo.encode())
    found = written.info["exif"].removeprefix(b"Exif\0\0")
    if format_name != "avif":  # Pillow has removed the orientation from it
        assert found == upright.removeprefix(b"Exif\0\0")
    assert found == photo.file_info.exif
    assert written.info["icc_profile"] == P3
    again = Photo.open(photo.encode()).file_info
    assert (again.exif, again.icc, again.xmp) == (photo.file_info.exif, P3, UPRIGHT_XMP)


def test_a_tiff_keeps_its_camera_tags():
    data = file_of(smooth(), "TIFF", exif=exif_block(), icc_profile=P3)
    written = pil(Photo.open(data).encode()).getexif()
    assert (written[271], written[306], written[274]) == ("Sextant", "2020:01:02 03:04:05", 1)
    assert written.get_ifd(34665)[33434] == (1, 125)
    # A maker note of an unknown kind would lose its positions
    assert 37500 not in written.get_ifd(34665)
    assert written.get_ifd(34853)[2] == (48.0, 8.0, 0.0)
    assert Photo.open(Photo.open(data).encode()).file_info.icc == P3


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp", "avif"])
def test_the_camera_tags_survive_a_change_of_format(format_name):
    source = Photo.open(file_of(smooth(), "JPEG", exif=exif_block()))
    written = pil(source.encode(format_name)).getexif()
    assert written[271] == "Sextant"
    assert written.get_ifd(34665)[36867] == "2020:01:02 03:04:05"


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff"])
def test_resolution_is_kept(format_name):
    written = pil(Photo.open(file_of(smooth(), format_name, dpi=(300, 300))).encode())
    np.testing.assert_allclose(np.array(written.info["dpi"], float), 300, atol=0.01)


@pytest.mark.parametrize("is_lossless", [True, False])
@pytest.mark.parametrize("channels", [3, 4])
def test_the_header_of_a_webp_states_its_size_and_whether_it_has_alpha_and_exif(
    channels, is_lossless
):
    """RFC 9649, 2.7."""
    image = random_image(channels=channels)
    alpha = np.ascontiguousarray(image[..., 3]) if channels == 4 else None
    info = FileInfo("webp", exif=exif_block(1).removeprefix(b"Exif\0\0"), lossless=is_lossless)
    data = Photo(np.ascontiguousarray(image[..., :3]), alpha, info).encode()
    header = metadata.webp_chunks(data)[b"VP8X"]
    assert bool(header[0] & 0x10) == (channels == 4)
    assert header[0] & 0x08
    sides = [int.from_bytes(header[start : start + 3], "little") + 1 for start in (4, 7)]
    assert sides == [image.shape[1], image.shape[0]]
    assert Photo.open(data).file_info.exif is not None


@pytest.mark.parametrize("kind", ["raw", "tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg"])
def test_a_tiff_keeps_its_compression(kind):
    data = file_of(smooth(), "TIFF", compression=kind)
    assert pil(Photo.open(data).encode()).info["compression"] == kind


def test_xmp_orientation_is_reset_with_that_of_exif():
    photo = Photo.open(file_of(smooth(), "JPEG", xmp=XMP, exif=exif_block()))
    assert photo.file_info.xmp == UPRIGHT_XMP


@quick
@given(st.binary(max_size=60), st.sampled_from([b"II*\0", b"MM\0*", b""]), st.integers(0, 70))
def test_damaged_exif_does_not_prevent_reading_and_writing(garbage, byte_order, offset):
    exif = byte_order + struct.pack("<I", offset) + garbage
    photo = Photo.open(metadata.with_png_chunks(file_of(smooth(4, 4), "PNG"), FileInfo(exif=exif)))
    for format_name in ("png", "tiff", "jpeg"):
        assert Photo.open(photo.encode(format_name)).size == photo.size


@pytest.mark.parametrize("size", [4, 7])
def test_an_exif_block_shorter_than_its_header_does_not_prevent_writing(size):
    segment = b"Exif\0\0" + b"II*\0\x08\0\0"[:size]
    data = file_of(smooth(), "JPEG")
    data = data[:2] + struct.pack(">HH", 0xFFE1, len(segment) + 2) + segment + data[2:]
    assert Photo.open(Photo.open(data).encode("tiff")).size == (64, 48)


def test_a_png_with_the_cicp_chunk_of_display_p3_gets_its_profile():
    photo = Photo.open(png_with((b"cICP", bytes((12, 13, 0, 1)))))
    assert photo.file_info.icc == P3
    assert np.array_equal(photo.pixels, smooth())


@pytest.mark.parametrize("order", ["<", ">"])
def test_upright_exif_resets_the_orientation_unlinks_the_thumbnail_and_keeps_all_other_bytes(order):
    mark = b"II*\0" if order == "<" else b"MM\0*"
    entry = struct.pack(f"{order}HHIHH", 274, 3, 1, 8, 0)
    directory = struct.pack(f"{order}IH", 8, 1) + entry + struct.pack(f"{order}I", 26)
    block = mark + directory + b"second directory"
    upright = tiff_tags.upright_exif(block, (1, 1))
    assert upright[:18] == block[:18]
    assert struct.unpack_from(f"{order}HHI", upright, 18) == (1, 0, 0)
    assert upright[26:] == block[26:]
