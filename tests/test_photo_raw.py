"""RAW files of cameras: light, colour, orientation, EXIF, and damaged files, on generated DNGs."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from brewster.base.image_formats import FORMATS, format_of
from brewster.errors import PhotoTooLarge, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import Photo, decode, read_size
from brewster.photo.blocks import tiff_tags
from brewster.photo.colour.spaces import colour_space_of
from brewster.photo.formats import raw
from picture_files import CAMERA_NEUTRAL, dng_file, exif_block, file_of, mosaic, pil, smooth

rawpy = pytest.importorskip("rawpy")
pytestmark = pytest.mark.filterwarnings(
    "ignore:rawpy is being used in a process:RuntimeWarning"
)  # mutmut forks


def developed(data, space):
    """The linear light that LibRaw computes, 0..1."""
    with rawpy.imread(io.BytesIO(data)) as file:
        options = {"gamma": (1, 1), "no_auto_bright": True, "use_camera_wb": True, "output_bps": 16}
        return file.postprocess(output_color=space, **options) / 65535


def test_the_light_of_a_raw_file_is_the_linear_output_of_libraw():
    data = dng_file(mosaic())
    photo = Photo.open(data)
    space = colour_space_of(photo.file_info.icc, None, is_float=False)
    stored = np.stack(
        [space.curves[i].decode(photo.pixels[..., i] / 65535) for i in range(3)], axis=2
    )
    assert np.abs(stored - developed(data, rawpy.ColorSpace.P3D65)).max() < 2 / 65535
    in_gamut = developed(data, rawpy.ColorSpace.sRGB)
    inside = (in_gamut > 0.001).all(axis=2) & (in_gamut < 0.99).all(axis=2)
    assert inside.mean() > 0.2
    assert np.abs(photo.linear() - in_gamut)[inside].max() < 2e-3  # two roundings of the primaries


def test_what_is_neutral_for_the_camera_is_neutral_in_the_photo():
    grey = np.empty((64, 64), np.uint16)
    grey[::2, ::2] = 40000 * CAMERA_NEUTRAL[0]
    grey[1::2, 1::2] = 40000 * CAMERA_NEUTRAL[2]
    grey[::2, 1::2] = grey[1::2, ::2] = 40000
    light = Photo.open(dng_file(grey)).linear()[8:-8, 8:-8]
    assert np.ptp(light, axis=2).max() < 0.003
    assert light.mean() == pytest.approx(40000 / 65535, rel=0.01)


def test_a_raw_file_gives_sixteen_bit_tiff_with_the_tags_of_the_camera():
    data = tiff_tags.with_tags(
        dng_file(mosaic()), tiff_tags.read_tags(exif_block(1).removeprefix(b"Exif\0\0"))
    )
    photo = Photo.open(data)
    assert (photo.file_info.format_name, photo.file_info.bits, photo.pixels.dtype) == (
        "tiff",
        16,
        np.uint16,
    )
    image = pil(photo.encode())
    assert image.format == "TIFF"
    exif = image.getexif()
    assert exif[271] == "Sextant"
    assert exif.get_ifd(34665)[33434] == (1, 125)
    assert 37500 not in exif.get_ifd(34665)  # the offsets in a maker note refer to the RAW file


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_raw_file_is_upright(orientation):
    upright = Photo.open(dng_file(mosaic()))
    turned = Photo.open(dng_file(mosaic(), orientation))
    turns = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
    assert np.array_equal(turned.pixels, np.rot90(upright.pixels, turns))
    assert turned.size == read_size(dng_file(mosaic(), orientation))
    assert tiff_tags.orientation_of(turned.file_info.exif) == 1


CROPS = [
    ((50719, 4, 2, (20, 10)), (50720, 4, 2, (80, 60))),
    ((50719, 5, 2, (40, 2, 10, 1)), (50720, 5, 2, (80, 1, 60, 1))),
]


@pytest.mark.parametrize("crop", CROPS, ids=["integers", "fractions"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_default_crop_of_a_dng_is_applied(crop, orientation):
    whole = Photo.open(dng_file(mosaic())).pixels
    data = dng_file(mosaic(), orientation, *crop)
    photo = Photo.open(data)
    turns = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
    assert np.array_equal(photo.pixels, np.rot90(whole[10:70, 20:100], turns))
    assert read_size(data) == photo.size


def test_the_default_crop_is_within_the_active_area_and_ignored_outside_of_the_image():
    active = (50829, 4, 4, (4, 8, 92, 124))  # top, left, bottom, right
    inside = Photo.open(dng_file(mosaic(), 1, active))
    assert inside.size == (116, 88)
    cropped = Photo.open(dng_file(mosaic(), 1, active, *CROPS[0]))
    assert np.array_equal(cropped.pixels, inside.pixels[10:70, 20:100])
    tags = (50719, 4, 2, (100, 10)), (50720, 4, 2, (80, 60))
    assert Photo.open(dng_file(mosaic(), 1, *tags)).size == (128, 96)


def test_a_dng_with_a_compression_that_libraw_does_not_support_is_named(data):
    message = r"^this DNG is compressed with JPEG XL, which LibRaw .* does not support"
    with pytest.raises(UnsupportedPhoto, match=message):
        Photo.open(data / "field" / "jpeg-xl.dng")


@pytest.mark.parametrize("fraction", [0.05, 0.5, 0.95])
def test_a_truncated_raw_file_is_refused(fraction):
    data = dng_file(mosaic())
    with pytest.raises(
        UnreadablePhoto, match=r"^the RAW file cannot be read completely; expected "
    ):
        Photo.open(data[: int(fraction * len(data))])


RAW_HEADS = (
    b"FUJIFILMCCD-RAW ",
    b"\0\0\0\x18ftypcrx ",
    b"II*\0\x10\0\0\0CR\2",
    b"IIRO\x08\0\0\0",
    b"IIU\0\x18\0\0\0",
)


@pytest.mark.parametrize("head", RAW_HEADS)
def test_a_damaged_raw_file_of_any_maker_is_named_as_raw(head):
    with pytest.raises(UnreadablePhoto, match="the RAW file"):
        Photo.open(head + bytes(4000))


def test_the_pixel_limit_is_that_of_the_image(monkeypatch):
    data = dng_file(mosaic(96, 128))
    assert Photo.open(data, max_pixels=96 * 128).size == (128, 96)
    with pytest.raises(PhotoTooLarge):
        Photo.open(data, max_pixels=96 * 128 - 1)
    monkeypatch.setattr(decode, "DEFAULT_MAX_PIXELS", 96 * 128 - 1)
    with pytest.raises(PhotoTooLarge):
        read_size(data)


def test_a_tiff_of_a_photo_is_not_raw():
    assert Photo.open(file_of(smooth(), "TIFF")).file_info.format_name == "tiff"
    assert format_of(Path("a.NEF")) == FORMATS["raw"]


def tiff_block(tags):
    exif = Image.Exif()
    exif.endian = "<"
    exif.update(tags)
    return exif.tobytes().removeprefix(b"Exif\0\0")


def box(name, content):
    return struct.pack(">I", len(content) + 8) + name + content


def test_the_tags_of_a_cr3_are_those_of_its_boxes():
    boxes = box(b"CMT1", tiff_block({271: "Sextant"})) + box(b"CMT2", tiff_block({33434: 0.5}))
    data = box(b"ftyp", b"crx \0\0\0\1") + box(b"moov", box(b"uuid", bytes(16) + boxes))
    tags = tiff_tags.read_tags(raw._exif(data))
    assert tags[271][2] == b"Sextant\0"
    assert 33434 in tags[34665]


def test_the_tags_of_a_raf_are_those_of_its_jpeg():
    preview = file_of(smooth(), "JPEG", exif=exif_block())
    header = (b"FUJIFILMCCD-RAW " + bytes(68) + struct.pack(">II", 160, len(preview))).ljust(
        160, b"\0"
    )
    tags = tiff_tags.read_tags(raw._exif(header + preview))
    assert tags[271][2] == b"Sextant\0"
    assert 33434 in tags[34665]


@pytest.mark.parametrize("magic", [b"IIRO", b"IIU\0", b"MMOR"])
def test_the_tags_of_an_orf_and_of_an_rw2_are_those_of_a_tiff(magic):
    block = (
        exif_block().removeprefix(b"Exif\0\0")
        if magic[:2] == b"MM"
        else tiff_block({271: "Sextant"})
    )
    assert tiff_tags.read_tags(raw._exif(magic + block[4:]))[271][2] == b"Sextant\0"


@pytest.mark.parametrize("is_installed", [True, False])
@pytest.mark.parametrize("data", [b"II*\0\x08\0\0\0", b"", b"no image"])
def test_a_damaged_file_with_a_suffix_of_raw_files_is_called_one(
    tmp_path, monkeypatch, data, is_installed
):
    if not is_installed:
        monkeypatch.setattr(raw.importlib.util, "find_spec", lambda _name: None)
    (tmp_path / "a.NEF").write_bytes(data)
    with pytest.raises(UnreadablePhoto, match=r"suffix \.NEF is that of a RAW file") as raised:
        Photo.open(tmp_path / "a.NEF")
    assert ("install the extra raw" in raised.value.cure) != is_installed
    (tmp_path / "a.tif").write_bytes(data)
    with pytest.raises(UnreadablePhoto) as raised:
        Photo.open(tmp_path / "a.tif")
    assert "RAW" not in str(raised.value).replace("raw", "")
