"""Damaged pixels are refused where their format shows the damage, and readable files are not."""

import io
import logging
from pathlib import Path

import numpy as np
import pytest
import pyvips
from PIL import Image

from brewster.errors import UnreadablePhoto
from brewster.photo import Photo
from brewster.photo.blocks import tiff_tags
from picture_files import file_of, tiff_with

PICTURES = Path(__file__).parent / "pictures"
FIELD = Path(__file__).parent / "field_files"
PHOTO = np.asarray(Image.open(PICTURES / "mixture-coffee-rocket.jpg").convert("RGB"))[:160, :240]
PHOTO_16 = (PHOTO.astype(np.uint16) << 8) + np.random.default_rng(0).integers(
    0, 256, PHOTO.shape, np.uint16
)
KINDS_OF_JPEG = [
    {}, {"subsampling": 0}, {"optimize": True}, {"progressive": True}, {"restart_marker_rows": 1},
]  # fmt: skip


def refused(data: bytes | Path) -> bool:
    try:
        Photo.open(data)
    except UnreadablePhoto as error:
        return str(error).count("; ") == 2
    return False


@pytest.mark.parametrize("path", sorted(FIELD.glob("damaged-*")), ids=lambda path: path.stem)
def test_the_damaged_files_of_users_are_refused(path):
    assert refused(path)


def tiff_parts(data):
    tags = tiff_tags.read_tags(data)
    kind = (324, 325) if 324 in tags else (273, 279)
    return list(zip(*(tiff_tags.numbers(tags, tag) for tag in kind), strict=True))


def tiff_of(array, compression, *, tile):
    image = pyvips.Image.new_from_array(
        array, interpretation="srgb" if array.dtype == np.uint8 else "rgb16"
    )
    predictor = "horizontal" if compression in ("deflate", "lzw") else "none"
    layout = {"tile": True, "tile_width": 64, "tile_height": 64} if tile else {}
    return bytes(image.tiffsave_buffer(compression=compression, predictor=predictor, **layout))


@pytest.mark.parametrize("tile", [False, True], ids=["strips", "tiles"])
@pytest.mark.parametrize("array", [PHOTO, PHOTO_16], ids=["8 bits", "16 bits"])
@pytest.mark.parametrize("compression", ["deflate", "lzw", "packbits", "jpeg"])
def test_a_hole_in_a_strip_or_tile_is_found_and_the_whole_file_is_read(compression, array, tile):
    if compression == "jpeg" and array.dtype != np.uint8:
        pytest.skip("JPEG has 8 bits")
    data = tiff_of(array, compression, tile=tile)
    whole = Photo.open(data).pixels
    assert compression == "jpeg" or np.array_equal(whole, array)
    for start, size in tiff_parts(data):
        hole = slice(start + size // 3, start + 2 * size // 3)
        damaged = bytearray(data)
        damaged[hole] = bytes(hole.stop - hole.start)
        assert refused(bytes(damaged))
        if compression != "jpeg":  # Huffman codes have no redundancy
            noise = np.random.default_rng(start).integers(0, 256, hole.stop - hole.start, np.uint8)
            damaged[hole] = noise.tobytes()
            assert refused(bytes(damaged))


@pytest.mark.parametrize("position", np.linspace(0.02, 0.98, 9))
def test_each_changed_bit_of_a_deflate_strip_is_found(position):
    data = bytearray(tiff_of(PHOTO, "deflate", tile=False))
    start, size = tiff_parts(bytes(data))[0]
    data[start + int(position * size)] ^= 0x10
    assert refused(bytes(data))


@pytest.mark.parametrize(
    "compression", [None, "tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg"]
)
@pytest.mark.parametrize(
    ("mode", "size"), [("RGB", (1, 1)), ("L", (3, 9)), ("RGB", (160, 240)), ("CMYK", (40, 60))]
)
def test_whole_tiffs_of_other_programs_are_read(compression, mode, size):
    image = Image.fromarray(PHOTO[: size[0], : size[1]]).convert(mode)
    options = {"compression": compression} if compression else {}
    assert Photo.open(file_of(image, "TIFF", **options)).size == size[::-1]


def test_a_full_lzw_table_is_read():
    noise = np.random.default_rng(0).integers(0, 256, (300, 400, 3), np.uint8)
    flat = np.full((300, 400, 3), 7, np.uint8)
    for array in (noise, flat):
        data = file_of(array, "TIFF", compression="tiff_lzw")
        assert np.array_equal(Photo.open(data).pixels, array)


def test_a_warning_of_libtiff_is_no_damage():
    data = bytearray(tiff_with(PHOTO))
    start = int.from_bytes(data[4:8], "little") + 2
    rows = [bytes(data[start + 12 * i : start + 12 * i + 12]) for i in (0, 3)]
    data[start : start + 12], data[start + 36 : start + 48] = rows[1], rows[0]  # unsorted tags
    with pytest.raises(pyvips.Error):
        pyvips.Image.tiffload_buffer(bytes(data), fail_on="warning").write_to_memory()
    assert np.array_equal(Photo.open(bytes(data)).pixels, PHOTO)


def jpeg_of(array=PHOTO, **options):
    return file_of(array, "JPEG", quality=90, **options)


def scan_of(data):
    """Returns the start and the end of the pixels of a JPEG with one scan."""
    return data.index(b"\xff\xda") + 14, len(data) - 2


@pytest.mark.parametrize("options", KINDS_OF_JPEG, ids=str)
@pytest.mark.parametrize("part", [0.4, 0.8, 0.99])
def test_a_jpeg_that_ends_in_its_scan_is_refused_with_an_end_marker_and_without(options, part):
    data = jpeg_of(**options)
    start, end = scan_of(data)
    cut = data[: start + int(part * (end - start))]
    endings = [b"", b"\xff\xd9", bytes(2000), bytes(2000) + b"\xff\xd9"]
    if "progressive" in options:
        del endings[-1]  # with few missing data, the zeros can be padding
    assert all(refused(cut + ending) for ending in endings)


@pytest.mark.parametrize("options", KINDS_OF_JPEG, ids=str)
@pytest.mark.parametrize("lost", [1, 2])
def test_a_jpeg_that_lacks_only_its_end_marker_is_read_with_a_note(options, lost):
    data = jpeg_of(**options)
    whole = Photo.open(data)
    assert whole.file_info.note is None
    photo = Photo.open(data[:-lost])
    assert np.array_equal(photo.pixels, whole.pixels)
    assert "end marker" in photo.file_info.note


def test_the_jpeg_of_a_user_without_an_end_marker_is_read_with_a_note():
    assert "end marker" in Photo.open(FIELD / "missing-eoi.jpg").file_info.note


@pytest.mark.parametrize("options", KINDS_OF_JPEG, ids=str)
@pytest.mark.parametrize("array", [PHOTO, PHOTO[..., 0]], ids=["RGB", "grey"])
def test_a_hole_of_zeros_in_a_jpeg_is_refused_and_most_others_are(options, array):
    data = jpeg_of(array, **options)
    start, end = scan_of(data)
    random = np.random.default_rng(1)
    others = 0
    for at in random.integers(start, start + (end - start) * 3 // 4, 8):
        is_found = refused(data[:at] + bytes(600) + data[at + 600 :])
        assert is_found or "progressive" in options
        noise = random.integers(0, 255, 600, np.uint8).tobytes()
        others += refused(data[:at] + noise + data[at + 600 :])
        others += refused(data[:at] + data[at + 600 :])
    assert others >= 10


def test_a_progressive_jpeg_without_its_last_scans_is_read_with_a_note_or_refused_without_an_end():
    data = jpeg_of(progressive=True)
    last_scan = data.rindex(b"\xff\xda")
    head = data[:last_scan]
    assert "last scans" in Photo.open(head + b"\xff\xd9").file_info.note
    assert refused(head)


def with_odd_header(data, kind):
    if kind == "JFIF version":
        return data.replace(b"JFIF\0\1", b"JFIF\0\3", 1)
    if kind == "Adobe transform":
        return data[:2] + b"\xff\xee\0\x0eAdobe\0\x64\0\0\0\0\x07" + data[2:]
    if kind == "scan parameters":
        start, _ = scan_of(data)
        return data[: start - 3] + bytes((0, 0, 0)) + data[start:]
    if kind == "bytes between segments":
        return data.replace(b"\xff\xdb", b"\0\0\0\xff\xdb", 1)
    if kind == "fill bytes":
        return data[:-2] + b"\xff\xff\xff\xff\xd9"
    if kind == "padding":
        return data[:-2] + bytes(500) + b"\xff\xd9"
    return data + bytes(5000)


@pytest.mark.parametrize("kind", [
    "JFIF version", "Adobe transform", "scan parameters", "bytes between segments", "fill bytes",
    "padding", "data after the end",
])  # fmt: skip
def test_unusual_headers_and_padding_are_no_damage(kind):
    data = jpeg_of()
    assert np.array_equal(Photo.open(with_odd_header(data, kind)).pixels, Photo.open(data).pixels)


@pytest.mark.parametrize("quality", [1, 100])
@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("size", [(1, 1), (80, 120)])
@pytest.mark.parametrize("options", KINDS_OF_JPEG, ids=str)
def test_flat_and_tiny_jpegs_whose_scans_are_zeros_are_read(quality, mode, size, options):
    for level in (0, 128, 255):
        image = Image.new("L", size, level).convert(mode)
        data = file_of(image, "JPEG", quality=quality, **options)
        assert Photo.open(data).size == size


def test_what_cannot_be_detected_is_what_the_page_on_formats_says():
    whole = io.BytesIO()
    Image.fromarray(PHOTO).save(whole, "WEBP", quality=80)
    data = bytearray(whole.getvalue())
    data[len(data) // 2 : len(data) // 2 + 500] = bytes(500)
    logging.getLogger("pyvips").setLevel(logging.CRITICAL)
    assert not np.array_equal(Photo.open(bytes(data)).pixels, Photo.open(whole.getvalue()).pixels)
